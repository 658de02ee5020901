"""Robots of others load as their files say; ``python -m tests.corpus`` checks many more."""

from __future__ import annotations

from pathlib import Path

import pytest

from .__main__ import main
from .checking import Listed, check, files_of, listed, unlisted
from .fetching import Unreached, requirements, unpacked
from .independent import read

SMALL, LARGE = requirements()
ARM = (
    '<robot name="r"><link name="a"/><link name="b"><inertial><mass value="{}"/>'
    '<inertia ixx="1" iyy="1" izz="{}"/></inertial></link>'
    '<joint name="j" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0 0 1"/>'
    '<limit lower="{}" upper="1" effort="2" velocity="0"/></joint></robot>'
)


@pytest.mark.parametrize("name", [row.partition("==")[0] for row in SMALL])
def test_a_package_is_what_it_says(name: str) -> None:
    try:
        folder = unpacked(name)
    except Unreached as error:
        pytest.skip(str(error))
    known, files = listed(), files_of(folder)
    outcomes = [check(file, folder) for file in files]
    assert [text for each in outcomes for text in unlisted(each, known)] == []
    assert sum(not each.refused for each in outcomes) >= len(files) / 2


@pytest.mark.acceptance
def test_all_packages_are_what_they_say(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["corpus"])
    assert main() == 0, capsys.readouterr().out


def test_every_package_is_pinned() -> None:
    assert len(SMALL) + len(LARGE) > 12
    assert all("==" in row and " --hash=sha256:" in row for row in (*SMALL, *LARGE))
    assert all(row.why for row in listed())


def arm(folder: Path, *values: float) -> Path:
    file = folder / "arm.urdf"
    file.write_text(ARM.format(*values), "utf-8")
    return file


def test_a_listed_difference_is_none_and_a_repair_is_listed(tmp_path: Path) -> None:
    assert check(arm(tmp_path, 2, 1, -1), tmp_path).failures == []
    repaired = check(arm(tmp_path, 2, 9, -1), tmp_path)  # no body has such an inertia
    assert repaired.said == 2  # and the other is that the root has no mass to speak of
    assert repaired.silent == []


@pytest.mark.parametrize(
    ("change", "finding"),
    [
        ({"body_mass": 3}, "the mass of 'b' is 3, not 2"),
        ({"body_ipos": 1}, "the centre of mass of 'b' is elsewhere"),
        ({"body_inertia": 2}, "the inertia of 'b' is another one"),
        ({"body_pos": 2}, "a body is"),
        ({"jnt_range": 2}, "the limits of 'j' are"),
        ({"jnt_axis": 3}, "'j' turns about another axis"),
        ({"dof_damping": 3}, "damping and friction of 'j'"),
    ],
)
def test_what_is_different_in_silence_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, float], finding: str
) -> None:
    import mujoco

    compiled = mujoco.MjSpec.compile

    def changed(spec: mujoco.MjSpec) -> mujoco.MjModel:
        model = compiled(spec)
        for name, value in change.items():
            getattr(model, name)[-1] = value
        return model

    monkeypatch.setattr(mujoco.MjSpec, "compile", changed)
    assert any(finding in text for text in check(arm(tmp_path, 2, 1, -1), tmp_path).silent)


def test_a_refusal_is_a_finding_unless_it_is_listed(tmp_path: Path) -> None:
    outcome = check(arm(tmp_path, 2, 1, 5), tmp_path)
    (text,) = unlisted(outcome, [])
    assert "arm.urdf: refused: " in text
    assert "the lower limit 5 is above the upper one, 1" in text
    row = Listed("*/arm.urdf", "refused: *above the upper*", "on purpose")
    assert unlisted(outcome, [row]) == []
    assert row.uses == 1


def test_without_a_registry_it_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    with pytest.raises(Unreached, match="jvrc-description cannot be downloaded: ERROR: "):
        unpacked.__wrapped__("jvrc-description")


def test_the_independent_reader_multiplies_poses(tmp_path: Path) -> None:
    said = read(arm(tmp_path, 2, 1, -1))
    assert said.bodies["b"].place[:3, 3].tolist() == [0, 0, 1]
    assert said.hinges["j"].axis.tolist() == [1, 0, 0]
    assert said.hinges["j"].limits == (-1, 1)
    file = tmp_path / "arm.sdf"
    file.write_text(
        '<sdf version="1.9"><world name="w"><model name="m"><pose>1 0 0 0 0 0</pose><link name="a">'
        '<pose>0 2 0 0 0 1.5707963267948966</pose></link><joint name="j" type="prismatic"><parent>'
        "world</parent><child>a</child><axis><xyz>1 0 0</xyz></axis></joint></model></world></sdf>"
    )
    said = read(file)
    assert said.bodies["m/a"].place[:3, 3].tolist() == [1, 2, 0]
    assert said.hinges["m/j"].axis == pytest.approx([0, 1, 0])
