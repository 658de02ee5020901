"""Viewers of a run: the dashboard, rqt_graph, RViz and Rerun."""
