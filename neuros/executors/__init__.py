"""Executors of sweeps: where the runs of a sweep are executed, each registered by its name."""
