"""Projects: the model, and the functions that load, validate and split it."""
