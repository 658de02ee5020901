#!/usr/bin/env -S python3 -S
# PYTHON_ARGCOMPLETE_OK
"""Run a project: ./launch.py PROJECT (the same as: neuros launch PROJECT)

Finds the .venv beside this file by itself. Any Python reads this file: the one that was called
need not be the one in .venv. It is started without its packages (-S), which takes less than half as
long: what Ctrl+C interrupts before the first lines, Python answers with a traceback.
"""

import _signal

if hasattr(_signal, "pthread_sigmask"):
    # Ctrl+C waits, also across execve, until `neuros launch` can heed it.
    _signal.pthread_sigmask(_signal.SIG_BLOCK, [_signal.SIGINT])

import os
import sys

ROOT = os.path.dirname(os.path.realpath(__file__))
VENV = os.path.join(ROOT, ".venv")


def clean_environment():
    """This environment without the libraries of another ROS 2, which would be loaded before ours.

    There are two sorts: a sourced distribution (AMENT_PREFIX_PATH), and the parent's own .venv.
    The mark keeps the ROS wheels from starting Python once more for their libraries: launching
    needs none of them. Nodes get both anew (neuros/backends/node_command.py).
    """
    environment = dict(os.environ)
    if environment.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None):
        environment.pop("LD_LIBRARY_PATH", None)
    environment["_ROS_WHEELS_BOOTSTRAP_COMPLETE"] = "1"
    prefixes = [p for p in environment.pop("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    for key in ("PYTHONPATH", "LD_LIBRARY_PATH"):
        if prefixes and key in environment:
            parts = environment[key].split(os.pathsep)
            kept = [p for p in parts if not any((p + "/").startswith(x + "/") for x in prefixes)]
            environment[key] = os.pathsep.join(kept)
    return environment


def fail(reason):
    """One sentence, and the exit code for a machine that lacks something."""
    sys.stderr.write("launch.py: %s: run %s first\n" % (reason, os.path.join(ROOT, "install.py")))
    sys.exit(4)


def lacks():
    """The packages that this Python does not have, of those that every run needs."""
    from importlib.util import find_spec

    return [name for name in ("jsonschema", "rclpy") if find_spec(name) is None]


if __name__ == "__main__":
    python = os.path.join(VENV, "bin", "python")
    is_inside = os.path.realpath(sys.prefix) == os.path.realpath(VENV)
    if not is_inside and os.path.exists(python) and os.path.exists(VENV + "/pyvenv.cfg"):
        command = [python, os.path.join(ROOT, "launch.py")] + sys.argv[1:]
        try:
            os.execve(python, command, clean_environment())
        except OSError as error:
            fail("%s does not run (%s)" % (python, error.strerror))
    if sys.flags.no_site:
        import site

        site.main()
    if sys.version_info < (3, 10) or (lacks() and not is_inside):
        fail("NeuROS is not installed here")
    if lacks():
        fail(".venv is not whole (no %s)" % ", ".join(lacks()))
    sys.path.insert(0, ROOT)
    from neuros.cli.main import main

    sys.exit(main(["launch"] + sys.argv[1:]))
