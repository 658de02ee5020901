"""Launcher: the supervisor of a run, which starts, watches and ends its nodes through ports."""
