#!/usr/bin/env python3
"""Install NeuROS into .venv beside this file: ./install.py -y

Any Python reads this file, so that an old one can say what it lacks.
"""

import os
import sys

ROOT = os.path.dirname(os.path.realpath(__file__))


def newer_python():
    """The name of a Python on this machine that is new enough, or of one to install."""
    for name in ("python3.13", "python3.12", "python3.11", "python3.10"):
        for folder in os.environ.get("PATH", "").split(os.pathsep):
            if os.access(os.path.join(folder, name), os.X_OK):
                return name
    return "python3.12"


if __name__ == "__main__":
    if sys.version_info < (3, 10):
        sys.stderr.write(
            "install.py: NeuROS needs Python 3.10 to 3.14, and this is %d.%d: run %s %s\n"
            % (sys.version_info[0], sys.version_info[1], newer_python(), sys.argv[0])
        )
        sys.exit(4)
    sys.path.insert(0, ROOT)
    try:
        from neuros.installation.command import main

        sys.exit(main(sys.argv[1:], ROOT))
    except KeyboardInterrupt:
        sys.exit(130)
