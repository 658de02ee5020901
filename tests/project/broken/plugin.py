"""The plugin of the broken projects; it is never loaded."""
