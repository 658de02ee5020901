"""What NeuROS costs, measured against the same thing without it: ``neuros benchmark``."""
