"""Where nodes run, and what starts, watches and ends them."""
