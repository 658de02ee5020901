"""Message packages of the user's own, built without a ROS distribution.

A ROS package in a ``workspace`` folder (``package.xml``, ``msg/*.msg``, ``srv/*.srv``,
``action/*.action``) becomes a Python package with its C libraries. What colcon and CMake do in a
ROS distribution is done here with rosidl's generators, which come with the wheels, and gcc:

- :mod:`~neuros.messages.package` finds packages, in workspaces and in ROS, and reads manifests;
- :mod:`~neuros.messages.workspace` knows all packages that a project sees: order and keys; and
  what is built, and by which process a package is built now;
- :mod:`~neuros.messages.checking` finds mistakes in them, line by line;
- :mod:`~neuros.messages.needed` builds what a run needs, with the generators in
  :mod:`~neuros.messages.generation` and a compiler.

**One build for every Python.** Of what the generators write only the conversion from and to Python
objects depends on Python. It is compiled against Python's stable ABI (``stable_abi.h``), and needs
no newer glibc than the wheels of ROS 2 do: one build serves Python 3.10 to 3.14, on this machine
and in containers. Nothing has to be compiled in an image, which mostly has no compiler.
"""
