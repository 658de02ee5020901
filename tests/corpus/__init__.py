"""Robots and messages of others: packages of registries, read by NeuROS and by something else."""
