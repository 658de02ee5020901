"""Nodes in the thread that calls them."""
