"""Runs of projects, for Python programs; the command line is one of them."""
