"""How packets travel: over ROS 2 topics between processes, or handed over within one."""
