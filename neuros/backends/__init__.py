"""Back ends: nodes as processes, in one process, or in containers, and what runs beside them."""
