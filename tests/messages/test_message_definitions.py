"""Mistakes in message files: each with its line, what was found and what is expected, all."""

from __future__ import annotations

from pathlib import Path

import pytest

from neuros.messages.checking import read_definition


def problems_of(folder: Path, text: str, name: str = "Joints.msg") -> list[str]:
    """What is said of a file, without its path: ``line:column: text``."""
    file = folder / name
    file.write_text(text)
    return [
        str(problem).partition(f"{name}:")[2] for problem in read_definition("demo", file).problems
    ]


def test_what_ros_understands_is_no_problem(tmp_path: Path) -> None:
    text = (
        "# a joint [rad]\n\nstd_msgs/Header header  # when\nfloat64[] angles\nOther other\n"
        "string<=8 name 'x'\nint32[3] three [1, 2, 3]\nfloat32[<=4] few\nuint8 LEFT=1\n"
        "string SIDE='a # b'\nwstring w\nbool b true\n   # an indented comment\n\tint8\ttabbed\n"
        "float32 heat 20.5  # [°C] ± 0.5, 温度\nstring<=8 named 'é—日'\nstring UNIT=°C\n"
    )
    text = text.replace("string SIDE='a # b'\n", "string SIDE='left'\n").replace("\tint8", "int8")
    file = tmp_path / "Joints.msg"
    file.write_text(text)

    found = read_definition("demo", file)

    assert found.problems == []
    assert [(use.type, use.line) for use in found.uses] == [
        ("std_msgs/Header", 3),
        ("demo/Other", 5),
    ]


@pytest.mark.parametrize(
    ("line", "where", "said"),
    [
        ("float64", "2:1", "found 'float64', expected a type and a name, as 'float64 angle'"),
        ("flaot64 x", "2:1", "found the type 'flaot64', expected bool, byte, char"),
        ("flaot64 x", "2:1", "(did you mean 'float64'?)"),
        ("int32] x", "2:1", "found the type 'int32]', expected"),
        ("int32[<3] x", "2:1", "optionally followed by [], [3] or [<=3]"),
        ("int32[0] x", "2:1", "found the type 'int32[0]', expected"),
        ("string<=x s", "2:1", "found the type 'string<=x', expected"),
        ("a/b/c x", "2:1", "found the type 'a/b/c', expected"),
        ("time t", "2:1", "found the type 'time' of ROS 1, expected 'builtin_interfaces/Time'"),
        (
            "float64 jointAngle",
            "2:9",
            "found the name 'jointAngle', expected a letter, then letters",
        ),
        ("float64 a__b", "2:9", "found the name 'a__b', expected"),
        (
            "float64 class",
            "2:9",
            "found the name 'class', expected one that is not a keyword of Python",
        ),
        (
            "float64 default",
            "2:9",
            "found the name 'default', expected one that is not a keyword of C",
        ),
        ("int32 linux", "2:7", "found the name 'linux', expected one that is not a macro of C"),
        ("int32 unix", "2:7", "found the name 'unix', expected one that is not a macro of C"),
        ("int32 errno", "2:7", "found the name 'errno', expected one that is not a macro of C"),
        ("int32 new", "2:7", "found the name 'new', expected one that is not a keyword of C++"),
        ("int32 max=3", "2:7", "found the name 'max', expected upper case letters"),
        ("int32 MAX=many", "2:7", "found the value 'many' of a int32, expected a valid integer"),
        ("int8 x 300", "2:6", "found the value '300' of a int8, expected a valid integer value"),
        ("int32[3] x [1, 2]", "2:10", "expected array must have exactly 3 elements, not 2"),
        ("std_msgs/Header h 3", "2:17", "expected no value behind the name"),
        (" float64 x", "2:1", "found a space in front, expected the type in the first column"),
        ("float64 ok", "2:9", "found the name 'ok' again (see line 1), expected another"),
        ("string[] x ['a', 'é']", "2:19", "found 'é' in the default of an array, expected ASCII"),
    ],
)
def test_a_mistake_is_said_with_its_place(tmp_path: Path, line: str, where: str, said: str) -> None:
    (problem,) = problems_of(tmp_path, f"float64 ok\n{line}\n")

    assert problem.startswith(f"{where}: ")
    assert said in problem


def test_all_mistakes_are_said_at_once(tmp_path: Path) -> None:
    found = problems_of(tmp_path, "flaot64 x\nint32 ok\nfloat64 X\nbool\n")

    assert [problem.partition(":")[0] for problem in found] == ["1", "3", "4"]


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("Add.srv", "int32 a\n", "1:1: found 0 lines '---', expected one line '---'"),
        ("Add.srv", "int32 a\n--- \nint32 b\n", "2:1: found 0 lines '---', expected one line"),
        ("Add.srv", "---\n---\n", "2:1: found 2 lines '---', expected one line '---'"),
        ("Go.action", "int32 a\n---\nint32 b\n", "2:1: found 1 lines '---', expected two lines"),
        ("Joints.msg", "int32 a\n---\n", "2:1: found 1 lines '---', expected none"),
    ],
)
def test_services_and_actions_have_parts(tmp_path: Path, name: str, text: str, said: str) -> None:
    assert problems_of(tmp_path, text, name)[0].startswith(said)


def test_parts_of_a_service_may_use_the_same_names(tmp_path: Path) -> None:
    assert problems_of(tmp_path, "int32 a\n---\nint32 a\n", "Add.srv") == []


@pytest.mark.parametrize("name", ["joints.msg", "My_Joints.msg", "2Joints.msg"])
def test_a_file_has_the_name_of_a_type(tmp_path: Path, name: str) -> None:
    (problem,) = problems_of(tmp_path, "int32 a\n", name)

    assert f"found the name '{name}', expected letters and digits in CamelCase" in problem


def test_what_is_no_text_is_a_problem(tmp_path: Path) -> None:
    file = tmp_path / "Joints.msg"
    file.write_bytes(b"int32 a  # \xff\n")

    (problem,) = read_definition("demo", file).problems

    assert "cannot be read" in problem.text
