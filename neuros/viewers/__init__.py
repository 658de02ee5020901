"""Viewers of other projects: RViz and Rerun."""
