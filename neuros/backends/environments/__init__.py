"""Pythons that nodes of the process back end run on.

A node whose container has a ``requirements.txt`` that this environment satisfies runs on this
Python. Every other container gets a virtual environment of its own, made once and kept in a cache:

- :mod:`~neuros.backends.environments.requirements` reads ``requirements.txt`` and compares;
- :mod:`~neuros.backends.environments.cache` knows what is whole, and who makes what;
- :mod:`~neuros.backends.environments.pythons` chooses, without changing anything, and makes those
  of a run, or says why that failed.
"""
