"""Any changed description becomes a model, or a list of problems."""

from __future__ import annotations

import random
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import pytest
from neuros_robots.elements import Finder
from neuros_robots.sdf import convert_sdf

from neuros.errors import DescriptionError, Problem

HERE = Path(__file__).resolve().parent
EVERYTHING = HERE / "everything.sdf"
WORDS = (
    *("0", "-1", "nan", "inf", "1e400", "1e-320", "x", "é", "0 0 0", "true", "ball", "mesh"),
    *("world", "base", "__model__", "__root__", "a::b", "t", "n::z"),
)
NAMING = ("relative_to", "attached_to", "expressed_in", "placement_frame", "name", "type")


def change(root: Any, chance: random.Random) -> None:
    """Leave out, repeat, rename or rewrite one element."""
    elements = list(root.iter())
    element = chance.choice(elements)
    children = list(element)
    match chance.randrange(6):
        case 0 if children:
            element.remove(chance.choice(children))
        case 1 if children:
            element.append(chance.choice(children))
        case 2 if element.attrib:
            element.set(chance.choice(sorted(element.attrib)), chance.choice(WORDS))
        case 3 if element is not root:
            element.tag = chance.choice(elements[1:]).tag
        case 4:
            element.set(chance.choice(NAMING), chance.choice(WORDS))
        case _:
            element.text = chance.choice(WORDS)


def test_everything_converts() -> None:
    model = convert_sdf(EVERYTHING, Finder()).spec.compile()
    assert (model.nbody - 1, model.nsensor, model.nlight) == (5, 13, 1)


@pytest.mark.parametrize("seed", range(30))
def test_no_change_ends_in_anything_else(tmp_path: Path, seed: int) -> None:
    chance = random.Random(seed)
    tree = ElementTree.parse(EVERYTHING)
    for _ in range(chance.randint(1, 4)):
        change(tree.getroot(), chance)
    file = tmp_path / "changed.sdf"
    tree.write(file)
    problems: list[Problem] = []
    try:
        convert_sdf(file, Finder()).spec.compile()
    except DescriptionError as error:
        problems += error.problems
    assert all(problem.line >= 1 and problem.text for problem in problems)
