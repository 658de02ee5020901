"""A run on several machines: agents there, reached by ``ssh``, run the nodes."""
