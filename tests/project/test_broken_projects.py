"""Every kind of mistake: the exact output, all of it in one go, for each file in ``broken/``."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from neuros.errors import ProjectError
from neuros.project.load import load_project

BROKEN = Path(__file__).parent / "broken"
CASES = sorted(BROKEN.glob("[0-9]*.json"))


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.stem)
def test_every_problem_is_reported_with_its_place(
    case: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(BROKEN)
    with pytest.raises(ProjectError) as error:
        load_project(Path(case.name), workspace=BROKEN.parents[2] / "workspace")
    assert f"{error.value}\n" == case.with_suffix(".expected").read_text(encoding="utf-8")


def test_there_are_at_least_twenty_kinds() -> None:
    assert len(CASES) >= 20


def test_a_project_of_twenty_problems_is_judged_in_well_under_half_a_second(
    tmp_path: Path,
) -> None:
    port = '{"name": "a b", "type": "std_msgs/msg/Nothing", "colour": 1}'
    node = f'{{"name": "n", "container": "neuros_python", "outputs": [{port}]}}'
    file = tmp_path / "project.json"
    file.write_text(f'{{"nodes": [{", ".join([node] * 20)}]}}')
    start_s = time.process_time()
    with pytest.raises(ProjectError) as error:
        load_project(file, workspace=tmp_path)
    assert time.process_time() - start_s < 0.4
    assert len(error.value.problems) > 20
