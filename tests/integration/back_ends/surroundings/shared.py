"""A module beside the plugin."""

calls = []
