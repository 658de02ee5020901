"""The page "Life of a run" lists functions in the order in which a run really calls them first."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
from launching import EXAMPLES, launch

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "life_of_a_run.md").read_text("utf-8")
ROW = re.compile(r"^\| `([\w.]+)` \| \[[\w.]+\]\(\.\./neuros/([\w/.]+)\)", re.MULTILINE)
# Python imports it before anything else, in the launcher and in each node process.
TRACER = """
import os, sys

package, folder, seen = os.environ["TRACED"], os.environ["TRACES"], set()

def note(frame, event, argument):
    code = frame.f_code
    if event == "call" and code not in seen and code.co_filename.startswith(package):
        seen.add(code)
        with open(os.path.join(folder, str(os.getpid())), "a") as file:
            file.write(f"{code.co_qualname} {code.co_filename[len(package) + 1:]}\\n")

sys.setprofile(note)
"""


def listed(title: str) -> list[tuple[str, str]]:
    """Functions and files of one table of the page."""
    return ROW.findall(PAGE.partition(f"## {title}\n")[2].partition("\n## ")[0])


@pytest.mark.skipif(sys.version_info < (3, 11), reason="code objects know no qualified name")
def test_a_run_calls_the_functions_that_the_page_lists_in_that_order(tmp_path: Path) -> None:
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(TRACER)
    (tmp_path / "traces").mkdir()
    run = launch(
        EXAMPLES / "1_tick/clock",
        *("--backend", "process", "--duration", "3"),  # the clock ticks once per second
        cwd=tmp_path,
        timeout_s=60.0,
        PYTHONPATH=str(tmp_path / "site"),
        TRACED=str(ROOT / "neuros"),
        TRACES=str(tmp_path / "traces"),
    )
    assert run.exit_code == 0, run.output
    traces = [
        [tuple(line.split()) for line in file.read_text().splitlines()]
        for file in (tmp_path / "traces").iterdir()
    ]
    launcher = next(each for each in traces if ("_launch", "cli/launch.py") in each)
    assert in_order(launcher, listed("In the launcher"))
    nodes = [each for each in traces if ("_run_node", "cli/node.py") in each]
    assert len(nodes) == 2
    # The display has no outputs: it waits for no receiver.
    sender = next(each for each in nodes if ("Engine.on_registered", "engine/engine.py") in each)
    assert in_order(sender, listed("In each node process"))


def in_order(trace: list[tuple[str, ...]], wanted: list[tuple[str, str]]) -> bool:
    """Whether all that is wanted was called, in that order."""
    places = [trace.index(each) if each in trace else each for each in wanted]
    assert [each for each in places if isinstance(each, tuple)] == []
    assert wanted == sorted(wanted, key=trace.index)
    return bool(wanted)
