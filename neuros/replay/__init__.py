"""One node of a recorded run, once more."""
