"""How large NeuROS is, and how far it is through its code: what :mod:`test_sizes` holds down."""

from __future__ import annotations

import ast
import itertools
import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from launching import launch

ROOT = Path(__file__).resolve().parents[2]
DATA = {"examples", "containers", "workspace", "template", "__pycache__"}
_PROFILE = """
import atexit, json, os, sys, threading
calls, roots = [], {roots!r}
def note(frame, event, argument):
    code = frame.f_code
    if event == "call" and code.co_filename.startswith(roots) and code.co_name != "<module>":
        name = getattr(code, "co_qualname", code.co_name)  # of Python 3.11
        calls.append((threading.get_ident(), code.co_filename, name))
def write():
    sys.setprofile(None)
    with open(f"{folder}/calls.{{os.getpid()}}.json", "w") as file:
        json.dump(calls, file)
atexit.register(write)
leave = os._exit
os._exit = lambda code: (write(), leave(code))
os.register_at_fork(after_in_child=calls.clear)  # the guardian has made them
threading.setprofile(note)
sys.setprofile(note)
"""
_PLUGIN = """
from neuros.hooks import Optional, neuros_function, neuros_initialise
@neuros_initialise(outputs=Optional("number"))
def begin(node):
    return node.make_packet("number") if node.name == "alice" else None
@neuros_function(inputs="heard", outputs=Optional("number"))
def add_one(node, heard):
    if heard.data == 30:
        return node.shutdown("that is enough")
    answer = node.make_packet("number")
    answer.data = heard.data + 1
    return answer
"""


def sources(folder: Path) -> Iterator[Path]:
    """The modules of a distribution; examples and data are left out."""
    for path in sorted(folder.rglob("*.py")):
        if not DATA & {*path.relative_to(folder).parts}:
            yield path


def lines(*folders: Path) -> int:
    """Lines of Python, blank ones and comments included."""
    texts = (path.read_text("utf-8") for folder in folders for path in sources(folder))
    return sum(len(text.splitlines()) for text in texts)


def used_once_percent(folder: Path) -> float:
    """How many of 100 functions are private and named at exactly one place besides their own."""
    defined: Counter[str] = Counter()
    named: Counter[str] = Counter()
    functions = 0
    for path in sources(folder):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                functions += 1
                if node.name.startswith("_") and not node.name.startswith("__"):
                    defined[node.name] += 1
            elif isinstance(node, ast.Attribute):
                named[node.attr] += 1
            elif isinstance(node, ast.Name):
                named[node.id] += 1
    once = sum(count == 1 and named[name] == 1 for name, count in defined.items())
    return 100 * once / functions


def classes_in_several_modules(folder: Path) -> int:
    """How many names of public classes stand in more than one module."""
    places: dict[str, set[Path]] = {}
    for path in sources(folder):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, set()).add(path)
    return sum(len(found) > 1 for found in places.values())


def calls_of_a_node(folder: Path) -> dict[str, int]:
    """Calls and files between two hooks of a node, and functions and files before its first one.

    Two nodes, each in a process, send a number to and fro. Of all their rounds it takes the
    shortest: in others, something else happens meanwhile.
    """
    roots = tuple(f"{each}/" for each in (ROOT / "neuros", ROOT / "extensions", folder))
    (folder / "sitecustomize.py").write_text(_PROFILE.format(roots=roots, folder=folder))
    (folder / "count.py").write_text(_PLUGIN)
    port = {"type": "std_msgs/msg/Int32"}
    nodes = [
        {
            "name": name,
            "container": "neuros_python",
            "plugin": "count.py",
            "inputs": [{"name": "heard", **port}],
            "outputs": [{"name": "number", **port}],
        }
        for name in ("alice", "bob")
    ]
    keys = ("source_node", "source_output", "destination_node", "destination_input")
    ends = (("alice", "number", "bob", "heard"), ("bob", "number", "alice", "heard"))
    wires = [{**dict(zip(keys, end, strict=True)), "discard_limit": 0} for end in ends]
    project = folder / "project.json"
    project.write_text(json.dumps({"nodes": nodes, "connections": wires}))
    done = launch(project, "--backend", "process", cwd=folder, PYTHONPATH=str(folder))
    assert done.exit_code == 0, done.output
    rounds: list[tuple[int, int]] = []
    starts: list[tuple[int, int]] = []
    for path in folder.glob("calls.*.json"):
        calls = json.loads(path.read_text())
        hooks = [i for i, call in enumerate(calls) if call[-1] == "add_one"]
        if not hooks:
            continue
        before = {tuple(call[1:]) for call in calls[: hooks[0]]}
        starts.append((len(before), len({file for file, *_ in before})))
        for first, second in itertools.pairwise(hooks):
            between = [c for c in calls[first + 1 : second] if c[0] == calls[first][0]]
            rounds.append((len(between), len({call[1] for call in between})))
    names = (
        "calls of a round",
        "files of a round",
        "functions before a hook",
        "files before a hook",
    )
    return dict(zip(names, (*min(rounds), *min(starts)), strict=True))
