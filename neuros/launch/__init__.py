"""Back ends that run nodes, and the supervisor that starts, watches and ends them."""
