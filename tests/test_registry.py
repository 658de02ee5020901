"""Parts are found by their names, and no module compares such a name."""

from __future__ import annotations

import ast
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from neuros.errors import EnvironmentFault, UsageError
from neuros.ports import BackEnd
from neuros.registry import BACK_ENDS, EXECUTORS, OWN, TRANSPORTS

ROOT = Path(__file__).resolve().parents[1]
FILES = sorted((ROOT / "neuros").rglob("*.py"))
NAMES = {*BACK_ENDS, *TRANSPORTS}


@pytest.mark.parametrize("name", [*BACK_ENDS])
def test_our_back_ends_can_be_loaded_and_say_what_help_needs(name: str) -> None:
    back_end = BACK_ENDS.load(name)
    assert isinstance(back_end, BackEnd)
    assert back_end.name == name
    assert back_end.transport in TRANSPORTS
    assert back_end.place


def test_our_transports_and_executors_can_be_loaded() -> None:
    for registry in (TRANSPORTS, EXECUTORS):
        assert [registry.load(name).name for name in registry] == [*registry]


def test_the_build_takes_our_parts_from_where_they_are_read() -> None:
    pyproject = (ROOT / "pyproject.toml").read_text()
    assert f'entry-points = {{ file = "{OWN.relative_to(ROOT)}" }}' in pyproject
    assert f'"{OWN.name}"' in pyproject, "it is part of the package"


def test_our_parts_are_found_without_any_installation() -> None:
    """As in a container, and in a checkout that was updated and not installed again."""
    program = (
        f"import sys; sys.path[:0] = ['.', {sysconfig.get_path('purelib')!r}]\n"
        "import neuros.registry as registry\n"
        "registry.BACK_ENDS.load('docker')\n"
        "assert not {'importlib.metadata', 'docker'} & {*sys.modules}"
    )
    done = subprocess.run([sys.executable, "-IS", "-c", program], cwd=ROOT, check=False)
    assert done.returncode == 0


def test_a_name_that_is_none_is_refused_with_those_that_there_are() -> None:
    with pytest.raises(UsageError, match=r"transport 'rose': choose one of ros, memory"):
        TRANSPORTS.load("rose")


def test_what_is_none_is_not_taken(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    own = tmp_path / "entry_points.txt"
    own.write_text("[neuros.backends]\nx = neuros.registry:OWN\n")
    monkeypatch.setattr("neuros.registry.OWN", own)
    registry = type(BACK_ENDS)("neuros.backends", "back end", BackEnd)
    with pytest.raises(EnvironmentFault, match=r"back end 'x' of the distribution neuros .* is no"):
        registry.load("x")


def compared_names(tree: ast.AST) -> set[str]:
    """The names of parts with which something is compared, alone or in a tuple, list or set."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.MatchValue):
            operands = [node.value]
        elif isinstance(node, ast.Compare):
            operands = [node.left, *node.comparators]
        else:
            continue
        every = [part for each in operands for part in getattr(each, "elts", [each])]
        found |= {each.value for each in every if isinstance(each, ast.Constant)} & NAMES
    return found


def test_a_comparison_is_found() -> None:
    assert compared_names(ast.parse("if plan.back_end.name == 'docker': pass")) == {"docker"}
    assert compared_names(ast.parse("is_it = name in ('process', 'x')")) == {"process"}
    assert compared_names(ast.parse("is_it = find('docker') is None")) == set()


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_module_compares_the_name_of_a_part(path: Path) -> None:
    assert compared_names(ast.parse(path.read_text("utf-8"))) == set()
