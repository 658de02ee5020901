"""Dashboard: a page in the browser that shows a run while it goes on."""
