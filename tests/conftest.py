"""For all tests: a run is on the back end that a test names, else on that of processes.

What ``auto`` would choose depends on the machine: it has tests of its own, which name it.
"""

import os

os.environ.setdefault("NEUROS_BACKEND", "process")
