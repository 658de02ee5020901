"""Replays of one node of a recorded run."""
