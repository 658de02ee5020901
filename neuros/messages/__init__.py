"""Message packages of the user's own, built without a ROS distribution.

A ROS package in a ``workspace`` folder (``package.xml``, ``msg/*.msg``, ``srv/*.srv``,
``action/*.action``) becomes a Python package with its C libraries. rosidl's generators, which come
with the wheels, and gcc do what colcon and CMake do in a ROS distribution:

- :mod:`~neuros.messages.package` finds packages, in workspaces and in ROS, and reads manifests;
- :mod:`~neuros.messages.workspace` has the packages of a project, their order, and the cache of
  builds;
- :mod:`~neuros.messages.checking` finds mistakes in them, line by line;
- :mod:`~neuros.messages.needed` builds what a run needs, with the generators in
  :mod:`~neuros.messages.generation` and a compiler.

**One build for every Python.** Only the conversion from and to Python objects depends on Python. It
is compiled against Python's stable ABI (``stable_abi.h``), and needs no newer glibc than the wheels
of ROS 2 do: one build serves Python 3.10 to 3.14, on this machine and in containers, which mostly
have no compiler.
"""
