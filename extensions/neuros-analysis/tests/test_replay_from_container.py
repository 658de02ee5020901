"""What a replay says of a node that ran in a container."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from neuros_analysis.replay.from_container import note_on_versions

from neuros.api.run_record import PastRun


def versions(python: str = "3.11.2", **packages: str) -> dict[str, Any]:
    return {"python": python, "packages": packages}


def run(in_image: dict[str, Any] | None, of_launcher: dict[str, Any]) -> PastRun:
    record = {
        "backend": "docker",
        "expanded_project": {"nodes": [{"name": "snn", "container": "neuros_nest"}]},
        "docker": {"images": {"neuros_nest": {"name": "neuros_nest:1"}}},
        "versions": {**of_launcher, "nodes": {} if in_image is None else {"snn": in_image}},
    }
    return PastRun(Path("/runs/1"), record)


def test_other_versions_of_python_and_packages_are_named_with_the_image() -> None:
    there = versions("3.13.1", nest="3.10", numpy="2.4.6", scipy="1.0")
    here = versions("3.11.2", numpy="2.1.0", scipy="1.0", torch="9")
    assert note_on_versions(run(there, here), "snn", here) == (
        "the node ran in image neuros_nest:1 with Python 3.13.1 (here 3.11.2),"
        " numpy 2.4.6 (here 2.1.0)"
    )


def test_the_same_versions_are_not_worth_a_word() -> None:
    there = versions(numpy="2.4.6", pip="23.0")
    here = versions(numpy="2.4.6", pip="26.1")
    assert note_on_versions(run(there, versions(numpy="1")), "snn", here) == ""


def test_what_was_not_noted_of_the_node_was_as_in_the_launcher() -> None:
    of_launcher = versions(numpy="2.4.6")
    found = note_on_versions(run(None, of_launcher), "snn", versions(numpy="2.1.0"))
    assert found == "the node ran in image neuros_nest:1 with numpy 2.4.6 (here 2.1.0)"


def test_of_many_the_first_are_named_and_the_others_counted() -> None:
    there, here = (versions(**{f"p{n}": v for n in range(8)}) for v in ("1", "2"))
    found = note_on_versions(run(there, here), "snn", here)
    assert found.endswith("p4 1 (here 2) and 3 more")
    assert found.count("(here 2)") == 5
