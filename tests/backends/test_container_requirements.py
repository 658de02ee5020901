"""``requirements.txt`` is read as pip reads it, and compared with what is installed."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import pytest

from neuros.backends.pythons import read_requirements, unmet
from neuros.errors import EnvironmentFault

JSONSCHEMA = version("jsonschema")


def requirements(folder: Path, text: str) -> Path:
    file = folder / "requirements.txt"
    file.write_text(text)
    return file


def lacks(folder: Path, text: str, *, any_version: bool = False) -> list[str]:
    return unmet(read_requirements(requirements(folder, text)), any_version=any_version)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "# nothing\n\n",
        "jsonschema",
        "JSONSchema >= 4  # names are the same in any case",
        "jsonschema >= 4, \\\n  < 1000",
        f"jsonschema=={JSONSCHEMA} --hash=sha256:00",
        "--index-url https://example.org/simple\njsonschema",
        "no-such-package; python_version < '3'",
        "ros_jazzy.rclpy[fastrtps]",
    ],
)
def test_what_is_installed_satisfies(tmp_path: Path, text: str) -> None:
    assert lacks(tmp_path, text) == []


def test_what_is_not_satisfied_is_named_with_what_is_there(tmp_path: Path) -> None:
    text = "jsonschema<4\njsonschema<4\nno-such-package==1; python_version > '3'\ntabulate"
    assert lacks(tmp_path, text) == [
        f"jsonschema<4 ({JSONSCHEMA} is installed)",
        "no-such-package==1 (not installed)",
    ]


def test_what_an_extra_needs_is_needed(tmp_path: Path) -> None:
    (lack,) = lacks(tmp_path, "jsonschema[format-nongpl, no-such-extra]")[:1]
    assert lack.endswith("(not installed)")
    assert not lack.startswith("jsonschema")


@pytest.mark.parametrize("text", ["./here", "-e .", "https://example.org/a.zip", "two words"])
def test_what_only_pip_can_judge_counts_as_lacking(tmp_path: Path, text: str) -> None:
    assert lacks(tmp_path, text) == [text]


def test_another_origin_of_the_same_package_does_not_satisfy(tmp_path: Path) -> None:
    assert len(lacks(tmp_path, "tabulate @ https://example.org/tabulate.zip")) == 1


def test_a_constraint_asks_for_nothing_but_limits_what_is_there(tmp_path: Path) -> None:
    (tmp_path / "limits.txt").write_text("no-such-package==1\njsonschema<4")
    assert lacks(tmp_path, "-c limits.txt\ntabulate") == [
        f"jsonschema<4 ({JSONSCHEMA} is installed)"
    ]


@pytest.mark.parametrize("option", ["-r more.txt", "-rmore.txt", "--requirement=more.txt"])
def test_an_included_file_counts(tmp_path: Path, option: str) -> None:
    (tmp_path / "more.txt").write_text("-r requirements.txt\nno-such-package")
    assert lacks(tmp_path, option) == ["no-such-package (not installed)"]
    before = read_requirements(tmp_path / "requirements.txt").digest
    (tmp_path / "more.txt").write_text("no-such-package>1")
    assert read_requirements(tmp_path / "requirements.txt").digest != before


def test_where_any_version_does_only_what_is_absent_is_lacking(tmp_path: Path) -> None:
    text = "jsonschema<4\nno-such-package==1"
    assert lacks(tmp_path, text, any_version=True) == ["no-such-package==1 (not installed)"]


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    file = requirements(tmp_path, "-r absent.txt")
    with pytest.raises(EnvironmentFault, match=r"absent\.txt cannot be read: No such file"):
        read_requirements(file)
    file.write_bytes(b"\xff")
    with pytest.raises(EnvironmentFault, match=r"requirements\.txt is not valid UTF-8"):
        read_requirements(file)


def test_packages_of_a_sourced_ros_distribution_stand_for_wheels_in_own_containers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = "ros-jazzy-no-such-package==1.0"
    assert lacks(tmp_path, text, any_version=True) == [f"{text} (not installed)"]
    index = tmp_path / "ros" / "share" / "ament_index" / "resource_index" / "packages"
    index.mkdir(parents=True)
    (index / "no_such_package").touch()
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path / 'ros'}")
    assert lacks(tmp_path, text, any_version=True) == []
    assert lacks(tmp_path, text) == [f"{text} (not installed)"]
