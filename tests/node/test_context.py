"""Nodes of one process take turns, each in its own context."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from neuros.node.context import Context, ContextSwitch


@pytest.fixture
def contexts() -> Iterator[ContextSwitch]:
    contexts = ContextSwitch()
    yield contexts
    contexts.leave()


Make = Callable[..., Context]


@pytest.fixture
def context(contexts: ContextSwitch, tmp_path: Path) -> Make:
    def make(log_file: Path | None = None, /, **environment: str) -> Context:
        plugin = tmp_path / "project" / "plugins" / "plugin.py"
        plugin.parent.mkdir(parents=True, exist_ok=True)
        return contexts.make_context(environment, plugin, tmp_path / "project", log_file)

    return make


def getenv(name: str) -> str:
    """What a child process and C libraries find."""
    command = ["sh", "-c", f'echo "${{{name}-unset}}"']
    # Without `env` the child inherits what the C library has, not what os.environ shows.
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def test_each_node_has_its_own_variables_on_top_of_those_of_the_process(
    contexts, context, monkeypatch
):
    monkeypatch.setenv("SHARED", "process")
    ann, bob = context(WHO="ann"), context(WHO="bob", ONLY_BOB="1")
    contexts.enter(bob)
    assert (os.environ["WHO"], os.environ["ONLY_BOB"]) == ("bob", "1")
    contexts.enter(ann)
    assert os.environ["WHO"] == "ann"
    assert "ONLY_BOB" not in os.environ
    assert os.environ["SHARED"] == "process"


def test_a_context_takes_nothing_from_the_node_in_whose_context_it_is_made(contexts, context):
    contexts.enter(context(WHO="ann", ONLY_ANN="1"))
    bob = context(WHO="bob")
    contexts.enter(bob)
    assert "ONLY_ANN" not in os.environ
    assert bob.path.count(bob.path[0]) == 1


def test_what_a_node_sets_stays_with_it(contexts, context):
    ann, bob = context(WHO="ann"), context(WHO="bob")
    held = os.environ
    contexts.enter(ann)
    os.environ["LATER"] = "x"
    contexts.enter(bob)
    assert "LATER" not in os.environ
    contexts.enter(ann)
    assert held["LATER"] == "x"


def test_c_libraries_see_the_variables_of_the_node_too(contexts, context, monkeypatch):
    monkeypatch.setenv("COLOUR", "grey")
    ann, bob = context(COLOUR="red", SIZE="1"), context()
    contexts.enter(ann)
    assert (getenv("COLOUR"), getenv("SIZE")) == ("red", "1")
    contexts.enter(bob)
    assert (getenv("COLOUR"), getenv("SIZE")) == ("grey", "unset")


def test_leaving_gives_the_process_its_own_context_back(contexts, context):
    before = dict(os.environ), list(sys.path), os.environ._data
    contexts.enter(context(WHO="ann"))
    contexts.leave()
    assert (dict(os.environ), list(sys.path)) == before[:2]
    assert os.environ._data is before[2]


def test_modules_beside_the_plugin_are_loaded_per_node_and_others_shared(
    contexts, context, tmp_path
):
    ann, bob = context(), context()
    (tmp_path / "project/plugins/stage_sibling.py").write_text("import colorsys\nvalue = []\n")
    importlib.invalidate_caches()
    modules = []
    for each in (ann, bob, ann):
        contexts.enter(each)
        modules.append(importlib.import_module("stage_sibling"))
    assert modules[0] is modules[2]
    assert modules[0] is not modules[1]
    assert modules[0].colorsys is modules[1].colorsys
    contexts.leave()
    assert "stage_sibling" not in sys.modules


def test_nest_belongs_to_the_first_node_that_imports_it(contexts, context, tmp_path, monkeypatch):
    site = tmp_path / "site"
    site.mkdir()
    (site / "nest.py").write_text("KERNEL = object()\n")
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.setitem(sys.modules, "nest", None)  # so that this one does not outlive the test
    monkeypatch.delitem(sys.modules, "nest")
    contexts = ContextSwitch()
    ann, bob = (
        contexts.make_context({}, tmp_path / "project" / "plugin.py", tmp_path / "project")
        for _ in "ab"
    )
    contexts.enter(ann)
    kernel = importlib.import_module("nest").KERNEL
    contexts.enter(bob)
    with pytest.raises(ImportError, match=r"one kernel per process.*--backend process"):
        importlib.import_module("nest")
    contexts.enter(ann)
    assert importlib.import_module("nest").KERNEL is kernel
    contexts.leave()
    assert importlib.import_module("nest").KERNEL is kernel


def test_a_virtual_environment_below_the_project_is_shared(contexts, tmp_path, monkeypatch):
    project = Path(sys.prefix).parent
    each = contexts.make_context({}, project / "plugin.py", project)
    shared = importlib.import_module("pytest")
    assert Path(shared.__file__).is_relative_to(project)
    assert not each.hides(shared)
    assert not each.hides(importlib.import_module("neuros.errors"))


def test_each_node_writes_to_its_own_log(tmp_path):
    program = """
        import os, sys
        from pathlib import Path
        from neuros.node.context import ContextSwitch
        contexts, folder = ContextSwitch(), Path(sys.argv[1])
        nodes = [contexts.make_context({}, folder / "plugin.py", folder, folder / name / "node.log")
                 for name in ("ann", "bob")]
        for number, node in enumerate(nodes * 2):
            contexts.enter(node)
            print(f"print {number}", flush=True)
            os.system(f"echo child {number} >&2")
    """
    code = "\n".join(line[8:] for line in program.splitlines())
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True)
    for name, numbers in (("ann", (0, 2)), ("bob", (1, 3))):
        expected = "".join(f"print {i}\nchild {i}\n" for i in numbers)
        assert (tmp_path / name / "node.log").read_text() == expected
