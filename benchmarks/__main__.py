"""``python -m benchmarks``: the same as ``neuros benchmark``."""

import sys

from neuros.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["benchmark", *sys.argv[1:]]))
