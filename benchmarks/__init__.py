"""What NeuROS costs, measured against the same thing without it: ``python -m benchmarks``."""
