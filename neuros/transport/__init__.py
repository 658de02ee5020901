"""Transports: ROS 2 topics between processes, memory within one."""
