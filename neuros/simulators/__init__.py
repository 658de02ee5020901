"""Simulators that run in a node: one :class:`neuros.ports.Simulator` per physics engine."""
