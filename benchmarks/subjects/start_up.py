"""From the command to the first hook: of any node, and of the last one.

A hook notes when it starts. It may run as soon as every receiver of its node has been found, so
discovery is part of this: the nodes are a ring. Of WhiskEye, each node gets one more initialise
hook, before its own, that does nothing but note the time.
"""

from __future__ import annotations

import functools
import shutil
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.graphs import STRING, lossless
from benchmarks.launching import PLUGINS, project_of_plugins
from benchmarks.live import live
from benchmarks.measure import Case, Figure, Group, Subject
from benchmarks.subjects.whiskeye import WHISKEYE

SIZES = (1, 3, 16, 64)
ROUNDS = {1: 5, 3: 5, 16: 5, 64: 3}
LABELS = {"process": "process", "in-process": "in process"}
FILE = "first_hook.txt"


def subject(is_quick: bool) -> Subject:
    """Small projects only, if quick."""
    sizes = SIZES[:2] if is_quick else SIZES
    groups = [_ring_of(nodes) for nodes in sizes]
    return Subject("launch to first hook", (_whiskeye(), *groups))


def _ring_of(nodes: int) -> Group:
    candidates = {
        label: functools.partial(ring_s, nodes, backend) for backend, label in LABELS.items()
    }
    cases = []
    for label in candidates:
        name = f"launch of {nodes} node{'s' if nodes > 1 else ''}, {label}"
        cases.append(Case(f"{name}, first hook of the last node", "s", Figure(label, "last")))
        cases.append(Case(f"{name}, first hook of any node", "s", Figure(label, "any")))
    return Group(candidates, tuple(cases), ROUNDS[nodes])


def _whiskeye() -> Group:
    candidates = {label: functools.partial(whiskeye_s, each) for each, label in LABELS.items()}
    bounds = {"process": "first-hook-process", "in process": "first-hook-in-process"}
    cases = []
    for label in candidates:
        name = f"launch of whiskeye, {label}, first hook"
        cases.append(Case(f"{name} of any node", "s", Figure(label, "any"), bound=bounds[label]))
        cases.append(Case(f"{name} of the last node", "s", Figure(label, "last")))
    return Group(candidates, tuple(cases))


def ring_s(nodes: int, backend: str) -> dict[str, float]:
    """Seconds to the first hook of ``any`` and of the ``last`` node of a ring; 1: a lone node."""
    names = [f"node{number}" for number in range(nodes)]
    project: dict[str, Any] = {
        "nodes": [_node(name) for name in names],
        "connections": [
            lossless(f"{source}.out", f"{destination}.in_")
            for source, destination in zip(names, [*names[1:], names[0]], strict=True)
        ],
    }
    with project_of_plugins(project) as folder:
        return _seconds(folder, names, backend)


def whiskeye_s(backend: str) -> dict[str, float]:
    """The same for WhiskEye as it is started by default, with hooks that note the time."""
    plugins = {"robot": "robot.py", "snn": "snn.py", "visualiser": "visualiser.py"}
    with tempfile.TemporaryDirectory(prefix="neuros-benchmark-") as name:
        folder = Path(name) / "whiskeye"
        shutil.copytree(WHISKEYE, folder)
        noting = (PLUGINS / "first_hook.py").read_text().partition("@neuros_function")[0]
        settings = {}
        for node, plugin in plugins.items():
            text = noting.replace("def start(", "def note_the_time(")
            noted = folder / f"noted_{plugin}"
            noted.write_text(f"{text}\n\n{(folder / plugin).read_text()}")
            settings[f"nodes.{node}.plugin"] = noted.name
        return _seconds(folder, list(plugins), backend, settings)


def _seconds(
    project: Path, names: list[str], backend: str, settings: dict[str, object] | None = None
) -> dict[str, float]:
    with live(project, backend, settings) as run:
        moments_ns = [int(text) for text in run.wait_for(names, FILE)]
    return {
        "any": (min(moments_ns) - run.command_ns) / 1e9,
        "last": (max(moments_ns) - run.command_ns) / 1e9,
    }


def _node(name: str) -> dict[str, Any]:
    return {
        "name": name,
        "container": "neuros_python",
        "plugin": "first_hook.py",
        "inputs": [{"name": "in_", "type": STRING}],
        "outputs": [{"name": "out", "type": STRING}],
    }
