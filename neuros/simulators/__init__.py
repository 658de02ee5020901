"""Simulators that live in a node: what :class:`neuros.ports.Simulator` asks for, per engine."""
