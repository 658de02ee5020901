"""Descriptions that are too deep, too large, without an end, or lead out: refused with a place."""

from __future__ import annotations

import os
import time
from pathlib import Path

import mujoco
import pytest

from neuros.cli.main import main

SDF = '<sdf version="1.9"><model name="m">{}</model></sdf>'
LINK = '<link name="l"><visual name="v"><geometry>{}</geometry></visual></link>'
INERTIAL = (
    '<inertial><mass value="{}"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
    "</inertial>"
)
URDF = (
    f'<robot name="r"><link name="a">{INERTIAL}</link><link name="b">{INERTIAL}</link>'
    '<link name="c">{}</link>'
    '<joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint>'
    '<joint name="k" type="continuous"><parent link="b"/><child link="c"/>{}</joint></robot>'
)
PROMPT_S = 60.0


def said(
    capsys: pytest.CaptureFixture[str], folder: Path, text: str | bytes, suffix: str = "sdf"
) -> str:
    """What ``convert`` says of a wrong description, soon."""
    file = folder / f"robot.{suffix}"
    file.write_bytes(text.encode() if isinstance(text, str) else text)
    begin_s = time.monotonic()
    assert main(["convert", str(file)]) == 3
    assert time.monotonic() - begin_s < PROMPT_S
    error = capsys.readouterr().err
    assert f"robot.{suffix}:" in error
    return error


def test_elements_are_nested_a_hundred_deep(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    deep = "<a>" * 996 + "</a>" * 996
    assert "nested more than 100 deep" in said(capsys, tmp_path, SDF.format(deep))
    nested = SDF
    for level in range(70):
        nested = nested.format(f'<model name="m{level}">{{}}</model>')
    assert "more than 50 models are nested" in said(capsys, tmp_path, nested.format(""))


def test_includes_are_nested_fifty_deep(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for level in range(197):
        inner = f"<include><uri>{level + 1}.sdf</uri></include>"
        (tmp_path / f"{level}.sdf").write_text(SDF.format(inner))
    (tmp_path / "197.sdf").write_text(SDF.format('<link name="l"/>'))
    (tmp_path / "robot.sdf").write_text((tmp_path / "0.sdf").read_text())
    assert main(["convert", str(tmp_path / "robot.sdf")]) == 3
    assert "more than 50 models are nested in each other" in capsys.readouterr().err


def test_includes_do_not_multiply(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for level in range(10):
        each = "<include><name>{}</name><uri>{}.sdf</uri></include>"
        inner = "".join(each.format(f"m{place}", level + 1) for place in range(10))
        (tmp_path / f"{level}.sdf").write_text(SDF.format(inner))
    (tmp_path / "10.sdf").write_text(SDF.format(""))
    begin_s = time.monotonic()
    assert main(["convert", str(tmp_path / "0.sdf")]) == 3
    assert time.monotonic() - begin_s < PROMPT_S
    assert "more than 200000 elements" in capsys.readouterr().err


def test_entities_are_not_expanded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "secret").write_text("secret")
    for entity in (
        "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10 if i else "lol"}">' for i in range(9)),
        f'<!ENTITY a8 SYSTEM "file://{tmp_path}/secret">',
    ):
        head = f"<!DOCTYPE sdf [{entity}]>"
        text = said(capsys, tmp_path, head + SDF.format('<link name="&a8;"/>'))
        assert "declares the entity" in text
        assert "secret'" not in text


def test_an_unknown_encoding_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for encoding in ("klingon", "rot13", "utf-7"):
        head = f'<?xml version="1.0" encoding="{encoding}"?>'
        for suffix, text in (("sdf", SDF.format("")), ("urdf", URDF)):
            assert "this is not XML: " in said(capsys, tmp_path, head + text, suffix)


@pytest.mark.parametrize(
    ("number", "problem"),
    [
        ("inf", "a number must be finite, and below 1e+15, not inf"),
        ("-1e999", "a number must be finite, and below 1e+15, not -inf"),
        ("1e300", "a number must be finite, and below 1e+15, not 1e+300"),
        ("", "a number must stand here, not 0"),
        ("1 2", "a number must stand here, not 2"),
        ("x", "'x' is not a number"),
        ("nan", "'nan' is not a number"),
        # Python would read these.
        ("1_0", "'1_0' is not a number"),
        ("\u0661", "'\u0661' is not a number"),
        ("1,5", "'1,5' is not a number (spaces stand between numbers)"),
    ],
)
def test_a_number_is_one_for_everybody(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], number: str, problem: str
) -> None:
    text = URDF.format("1", number, INERTIAL.format("1"), "")
    place = "link[b]/inertial/mass: value"
    column = text.index("<mass", text.index('name="b"')) + 1
    assert f"robot.urdf:1:{column}: {place}: {problem}" in said(capsys, tmp_path, text, "urdf")
    mimic = f'<mimic joint="j" multiplier="{number}"/>'
    text = URDF.format("1", "1", INERTIAL.format("1"), mimic)
    assert f"joint[k]/mimic: multiplier: {problem}" in said(capsys, tmp_path, text, "urdf")
    text = SDF.format(f'<link name="l"><inertial><pose>0 0 0 {number} 0 0</pose></inertial></link>')
    of_six = problem.replace("a number must stand here, not 0", "6 numbers must stand here, not 5")
    of_six = of_six.replace("a number must stand here, not 2", "6 numbers must stand here, not 7")
    assert f"link[l]/inertial/pose: {of_six}" in said(capsys, tmp_path, text)


def test_a_limit_may_be_none(tmp_path: Path) -> None:
    for number in ("inf", "1e16", "1.79769e+308"):
        limit = f'<limit lower="-{number}" upper="{number}" effort="{number}"/>'
        text = URDF.format("1", "1", INERTIAL.format("1"), limit).replace("continuous", "revolute")
        (tmp_path / "robot.urdf").write_text(text)
        assert main(["convert", str(tmp_path / "robot.urdf"), "--force"]) == 0
        model = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
        assert not model.joint("k").limited[0]
        assert not model.jnt_actfrclimited.any()


def test_an_error_of_mujocos_has_the_place_of_what_it_names(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    light = '<inertial auto="true"/><collision name="c"><density>1e-30</density><geometry>{}'
    light = light.format("<sphere/></geometry></collision>")
    text = SDF.format(f'\n<link name="k"/>\n<link name="l">{light}</link>')
    assert "robot.sdf:3:1: model[m]/link[l]: MuJoCo cannot" in said(capsys, tmp_path, text)


def test_a_name_of_a_mesh_may_be_longer_than_any_file_has(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = "x" * 5000
    mesh = f"<mesh><uri>{name}.stl</uri></mesh>"
    collision = f'<collision name="c"><geometry>{mesh}</geometry></collision>'
    error = said(capsys, tmp_path, SDF.format(f'<link name="l">{collision}</link>'))
    assert f"'{name}.stl' cannot be found" in error
    shape = f'<collision><geometry><mesh filename="{name}.stl"/></geometry></collision>'
    text = URDF.format("1", "1", shape + INERTIAL.format("1"), "")
    assert f"'{name}.stl' cannot be found" in said(capsys, tmp_path, text, "urdf")
    assert main(["convert", name]) == 2


def test_pipes_are_no_descriptions_and_no_meshes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.mkfifo(tmp_path / "pipe.sdf")
    assert main(["convert", str(tmp_path / "pipe.sdf")]) == 3
    assert "pipe.sdf:1:1: /: cannot be read: it is not an ordinary file" in capsys.readouterr().err
    os.mkfifo(tmp_path / "pipe.stl")
    collision = "<mesh><uri>pipe.stl</uri></mesh>"
    link = f'<link name="l"><collision name="c"><geometry>{collision}</geometry></collision></link>'
    assert "'pipe.stl' is not a file" in said(capsys, tmp_path, SDF.format(link))
    os.mkfifo(tmp_path / "out.xml")
    (tmp_path / "good.sdf").write_text(SDF.format('<link name="l"/>'))
    out = str(tmp_path / "out.xml")
    assert main(["convert", str(tmp_path / "good.sdf"), "-o", out, "--force"]) == 2
    assert "out.xml: is not a file" in capsys.readouterr().err


def test_a_chain_of_frames_may_be_as_long_as_it_likes(tmp_path: Path) -> None:
    frames = [
        f'<frame name="f{n}"><pose relative_to="f{n + 1}">0 0 1 0 0 0</pose></frame>'
        for n in range(600)
    ]
    link = '<link name="l"><pose relative_to="f0">0 0 1 0 0 0</pose></link>'
    (tmp_path / "long.sdf").write_text(SDF.format("".join(frames) + '<frame name="f600"/>' + link))
    assert main(["convert", str(tmp_path / "long.sdf")]) == 0
    assert 'pos="0 0 601"' in (tmp_path / "long.xml").read_text()
