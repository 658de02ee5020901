"""Viewers of a run: the dashboard, Foxglove, rqt_graph, RViz and Rerun."""
