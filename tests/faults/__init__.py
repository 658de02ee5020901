"""The fault matrix; what it shares with other tests is found as pytest finds it."""

import sys
from pathlib import Path

if (folder := str(Path(__file__).parents[1])) not in sys.path:
    sys.path.append(folder)
