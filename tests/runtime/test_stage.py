"""Nodes of one process take turns on its stage, and share nothing there."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from neuros.runtime.scope import Scope, Stage


@pytest.fixture
def stage() -> Iterator[Stage]:
    stage = Stage()
    yield stage
    stage.leave()


Make = Callable[..., Scope]


@pytest.fixture
def scope(stage: Stage, tmp_path: Path) -> Make:
    def make(log_file: Path | None = None, /, **environment: str) -> Scope:
        plugin = tmp_path / "project" / "plugins" / "plugin.py"
        plugin.parent.mkdir(parents=True, exist_ok=True)
        return stage.scope(environment, plugin, tmp_path / "project", log_file)

    return make


def getenv(name: str) -> str:
    """What a child process and C libraries find."""
    command = ["sh", "-c", f'echo "${{{name}-unset}}"']
    # Without `env` the child inherits what the C library has, not what os.environ shows.
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def test_each_node_has_its_own_variables_on_top_of_those_of_the_process(stage, scope, monkeypatch):
    monkeypatch.setenv("SHARED", "process")
    ann, bob = scope(WHO="ann"), scope(WHO="bob", ONLY_BOB="1")
    stage.enter(bob)
    assert (os.environ["WHO"], os.environ["ONLY_BOB"]) == ("bob", "1")
    stage.enter(ann)
    assert os.environ["WHO"] == "ann"
    assert "ONLY_BOB" not in os.environ
    assert os.environ["SHARED"] == "process"


def test_a_scope_takes_nothing_from_the_node_that_plays_when_it_is_made(stage, scope):
    stage.enter(scope(WHO="ann", ONLY_ANN="1"))
    bob = scope(WHO="bob")
    stage.enter(bob)
    assert "ONLY_ANN" not in os.environ
    assert bob.path.count(bob.path[0]) == 1


def test_what_a_node_sets_stays_with_it(stage, scope):
    ann, bob = scope(WHO="ann"), scope(WHO="bob")
    held = os.environ
    stage.enter(ann)
    os.environ["LATER"] = "x"
    stage.enter(bob)
    assert "LATER" not in os.environ
    stage.enter(ann)
    assert held["LATER"] == "x"


def test_c_libraries_see_the_variables_of_the_node_too(stage, scope, monkeypatch):
    monkeypatch.setenv("COLOUR", "grey")
    ann, bob = scope(COLOUR="red", SIZE="1"), scope()
    stage.enter(ann)
    assert (getenv("COLOUR"), getenv("SIZE")) == ("red", "1")
    stage.enter(bob)
    assert (getenv("COLOUR"), getenv("SIZE")) == ("grey", "unset")


def test_leaving_gives_the_process_its_own_surroundings_back(stage, scope):
    before = dict(os.environ), list(sys.path), os.environ._data
    stage.enter(scope(WHO="ann"))
    stage.leave()
    assert (dict(os.environ), list(sys.path)) == before[:2]
    assert os.environ._data is before[2]


def test_modules_beside_the_plugin_are_loaded_per_node_and_others_shared(stage, scope, tmp_path):
    ann, bob = scope(), scope()
    (tmp_path / "project/plugins/stage_sibling.py").write_text("import colorsys\nvalue = []\n")
    importlib.invalidate_caches()
    modules = []
    for each in (ann, bob, ann):
        stage.enter(each)
        modules.append(importlib.import_module("stage_sibling"))
    assert modules[0] is modules[2]
    assert modules[0] is not modules[1]
    assert modules[0].colorsys is modules[1].colorsys
    stage.leave()
    assert "stage_sibling" not in sys.modules


def test_nest_belongs_to_the_first_node_that_imports_it(stage, scope, tmp_path, monkeypatch):
    site = tmp_path / "site"
    site.mkdir()
    (site / "nest.py").write_text("KERNEL = object()\n")
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.delitem(sys.modules, "nest", raising=False)
    stage = Stage()
    ann, bob = (
        stage.scope({}, tmp_path / "project" / "plugin.py", tmp_path / "project") for _ in "ab"
    )
    stage.enter(ann)
    kernel = importlib.import_module("nest").KERNEL
    stage.enter(bob)
    with pytest.raises(ImportError, match=r"one kernel per process.*--backend process"):
        importlib.import_module("nest")
    stage.enter(ann)
    assert importlib.import_module("nest").KERNEL is kernel
    stage.leave()
    assert importlib.import_module("nest").KERNEL is kernel


def test_a_virtual_environment_below_the_project_is_shared(stage, tmp_path, monkeypatch):
    project = Path(sys.prefix).parent
    each = stage.scope({}, project / "plugin.py", project)
    shared = importlib.import_module("pytest")
    assert Path(shared.__file__).is_relative_to(project)
    assert not each.hides(shared)
    assert not each.hides(importlib.import_module("neuros.errors"))


def test_each_node_writes_to_its_own_log(tmp_path):
    program = """
        import os, sys
        from pathlib import Path
        from neuros.runtime.scope import Stage
        stage, folder = Stage(), Path(sys.argv[1])
        nodes = [stage.scope({}, folder / "plugin.py", folder, folder / name / "node.log")
                 for name in ("ann", "bob")]
        for number, node in enumerate(nodes * 2):
            stage.enter(node)
            print(f"print {number}", flush=True)
            os.system(f"echo child {number} >&2")
    """
    code = "\n".join(line[8:] for line in program.splitlines())
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True)
    for name, numbers in (("ann", (0, 2)), ("bob", (1, 3))):
        expected = "".join(f"print {i}\nchild {i}\n" for i in numbers)
        assert (tmp_path / name / "node.log").read_text() == expected
