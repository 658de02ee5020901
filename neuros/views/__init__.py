"""What is seen of a project in other people's viewers: RViz and Rerun."""
