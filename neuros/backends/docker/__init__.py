"""Docker: the engine, the images that nodes run in, and how those are built.

The only place of NeuROS that knows the Docker SDK for Python.
"""
