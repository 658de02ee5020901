"""Problems and unsupported elements are reported with file, line and path."""

from __future__ import annotations

from pathlib import Path

import pytest
from describing import Folder, joint, link
from neuros_robots.elements import Finder
from neuros_robots.sdf import convert_sdf

from neuros.errors import DescriptionError


def test_all_problems_are_reported_at_once(folder: Folder) -> None:
    problems = folder.problems(
        '<link name="a"><inertial>\n<mass>-1</mass></inertial></link>\n'
        '<link name="a"/>\n'
        '<link name="b"><pose relative_to="nowhere">0 0 0</pose></link>\n'
        + joint("hinge", "a", "b")
    )
    assert [problem.split(": ", 2)[0] for problem in problems] == [
        "4:1",
        "5:1",
        "6:1",
        "6:16",
        "7:1",
    ]
    assert "occurs twice" in problems[1]
    assert "there is no link, joint, frame or model 'nowhere'" in problems[2]
    assert "6 numbers must stand here, not 3" in problems[3]
    assert "'hinge' is not a type of joint" in problems[4]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("<sdf><model>", "this is not XML: no element found"),
        ("", "this is not XML: no element found"),
        ("<robot/>", "an SDF file begins with <sdf>, not with <robot>"),
        ("<sdf version='1.9'/>", "there is neither a <world> nor a <model> in it"),
    ],
)
def test_what_is_no_sdf_at_all(tmp_path: Path, text: str, problem: str) -> None:
    file = tmp_path / "broken.sdf"
    file.write_text(text, "utf-8")
    with pytest.raises(DescriptionError) as caught:
        convert_sdf(file, Finder())
    assert "broken.sdf:1:" in str(caught.value)
    assert problem in str(caught.value)


@pytest.mark.parametrize(
    ("inside", "problem"),
    [
        ("<pose>1 2 x 0 0 0</pose>" + link("a"), "'x' is not a number"),
        (link("a") + joint("revolute", "a", "z", "<xyz>1 0 0</xyz>"), "or model 'z'"),
        (link("a") + joint("revolute", "a", "a", "<xyz>1 0 0</xyz>"), "joins a link to itself"),
        (
            link("a") + link("b") + joint("revolute", "a", "b", "<xyz>0 0 0</xyz>"),
            "the axis has no direction",
        ),
        ('<frame name="f"><pose relative_to="f"/></frame>' + link("a"), "relative to itself"),
        (
            '<frame name="f" attached_to="g"/><frame name="g" attached_to="f"/>'
            + link("a")
            + joint("fixed", "a", "f"),
            "relative to itself",
        ),
        (
            '<link name="a"><inertial><inertia><ixx>-1</ixx></inertia></inertial></link>',
            "no body has this inertia: its principal moments are -1, 1 and 1 kg m²",
        ),
        ("<include><uri>model://nothing</uri></include>", "'model://nothing' cannot be found"),
        ("<include><uri>https://x.org/m</uri></include>", "is on the network"),
    ],
)
def test_a_mistake_has_its_sentence(folder: Folder, inside: str, problem: str) -> None:
    assert any(problem in found for found in folder.problems(inside))


def test_an_unsupported_element_is_listed_with_its_place(folder: Folder) -> None:
    notes = folder.notes(
        link(
            "a",
            '<collision name="c"><geometry><sphere><radius>1</radius></sphere></geometry>'
            "\n<laser_retro>1</laser_retro></collision>",
        )
        + '\n<plugin filename="x" name="y"><deep/></plugin>\n<own:thing/>\n<unheard_of/>'
    )
    assert notes == {
        "4 link[a]/collision[c]/laser_retro": "MuJoCo's rangefinders measure distances only",
        "5 plugin[y]": "code that runs inside Gazebo; a NeuROS plugin takes its place",
        "6 own:thing": "an extension of its author's own",
        "7 unheard_of": "the converter does not know this element",
    }


def test_the_same_thing_is_listed_once_and_counted(folder: Folder) -> None:
    links = "".join(link(name, "<enable_wind>true</enable_wind>") for name in "abc")
    (note,) = folder.convert(f'<model name="robot">{links}</model>').differences
    assert note.count == 3
    assert str(note).endswith("MuJoCo simulates no such environment (and 2 more)")


def test_a_link_without_inertial_gets_what_sdf_gives_it(folder: Folder) -> None:
    assert folder.model('<link name="a"/>').body("a").mass == 1
    assert "SDF's 1 kg" in folder.notes('<link name="a"/>')["3 link[a]"]


def test_an_inertia_that_only_gazebo_accepts_is_evened_out(folder: Folder) -> None:
    moments = "<inertia><ixx>1</ixx><iyy>1</iyy><izz>4</izz></inertia>"
    text = f'<link name="a"><inertial><mass>1</mass>{moments}</inertial></link>'
    assert folder.model(text).body("a").inertia.tolist() == [2, 2, 2]
    (why,) = folder.notes(text).values()
    assert "exceeds the sum of the others" in why
