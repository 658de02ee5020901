"""What tests of starts share: nodes that load or initialise slowly, and when their hooks ran."""

from __future__ import annotations

import json
from pathlib import Path

# The clock is the machine's, which processes share.
MOMENTS = """
import json
MOMENTS = {"loaded": time.monotonic()}
def moment(node, name):
    MOMENTS.setdefault(name, time.monotonic())
    (node.run_dir / "moments.json").write_text(json.dumps(MOMENTS))
"""
TICKS = """
@neuros_tick(seconds=0.05)
def tick(node):
    moment(node, "tick")
"""
INITIALISES_SLOWLY = """
@neuros_initialise()
def begin(node):
    moment(node, "initialising")
    time.sleep(1.5)
    moment(node, "initialised")
"""
LOADS_SLOWLY = "\nimport time; time.sleep(1.5)\n" + MOMENTS
PLUGINS = {
    "a": LOADS_SLOWLY + TICKS,
    "b": MOMENTS + INITIALISES_SLOWLY + TICKS,
    "c": MOMENTS + TICKS,
}
"""By node."""


def moments(folder: Path) -> dict[str, dict[str, float]]:
    """By node and name, on the clock of the machine."""
    found = folder.rglob("moments.json")
    return {file.parent.name: json.loads(file.read_text()) for file in found}


def assert_all_began_together(folder: Path) -> None:
    """The nodes of :data:`PLUGINS` have run in a run below this folder."""
    seen = moments(folder)
    assert seen.keys() == PLUGINS.keys()
    assert seen["b"]["initialising"] > seen["a"]["loaded"]
    assert all(each["tick"] > seen["b"]["initialised"] for each in seen.values())
