"""The fault matrix; what it shares with other tests is found as pytest finds it."""

import sys
from pathlib import Path

_TESTS = Path(__file__).parents[1]
sys.path += [path for path in map(str, (_TESTS, _TESTS / "support")) if path not in sys.path]
