"""The engine of a node: events in, effects out. It knows no ROS, no process and no wall clock."""
