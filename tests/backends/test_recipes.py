"""From a container's name to folders, Dockerfiles, and the order in which they are built."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from neuros.backends.containers import OWN_FOLDER, Recipe, find_recipe, in_order, names_in
from neuros.backends.docker.dockerfile import (
    after_each_from,
    arguments_of,
    images_in,
    on_images,
)
from neuros.errors import EnvironmentFault


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """NeuROS's own recipes, in short."""
    folder = tmp_path / "own"
    write(folder / "neuros_python", "ARG BASE_IMAGE=python:3.12\nFROM ${BASE_IMAGE}\n")
    write(folder / "neuros_nest", "ARG BASE_IMAGE=neuros_python\nFROM ${BASE_IMAGE}\n")
    return folder


@pytest.fixture
def project(tmp_path: Path) -> Path:
    folder = tmp_path / "project"
    folder.mkdir()
    return folder


def write(folder: Path, dockerfile: str | None = None, requirements: str | None = None) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    if dockerfile is not None:
        (folder / "Dockerfile").write_text(dockerfile)
    if requirements is not None:
        (folder / "requirements.txt").write_text(requirements)


def found(container: str, project: Path | None, own: Path) -> Recipe:
    recipe = find_recipe(container, project, own)
    assert recipe is not None
    return recipe


def names(recipes: list[Recipe]) -> list[str]:
    return [recipe.name for recipe in recipes]


class TestImagesInDockerfiles:
    @pytest.mark.parametrize(
        ("dockerfile", "images"),
        [
            ("FROM debian:12", ["debian:12"]),
            ("from --platform=linux/amd64 debian AS one", ["debian"]),
            ("ARG A=debian\nARG B=${A}:12\nFROM $B", ["debian:12"]),
            ('ARG A="debian"\nFROM ${A}', ["debian"]),
            ("FROM ${A:-debian}", ["debian"]),
            ("FROM a AS one\nFROM b\nCOPY --from=one / /", ["a", "b"]),
            ("FROM a AS one\nFROM one", ["a"]),
            ("FROM \\\n  debian", ["debian"]),
            ("FROM a\nARG A=b\nRUN echo FROM c\n# FROM d", ["a"]),
            ("FROM a\nRUN <<-'EOF' python3\nfrom os import path\n\tEOF\nFROM b", ["a", "b"]),
            ("FROM a\nCOPY <<one <<two /\nFROM x\none\nFROM y\ntwo\nFROM b", ["a", "b"]),
            ("FROM a\nRUN echo \\\n  # FROM x\n\n  FROM b\nFROM c", ["a", "c"]),
            ("# escape=`\nFROM `\n a\nRUN echo \\\nFROM b", ["a", "b"]),
            ("ARG A=a B='b'\nFROM $A\nFROM $B", ["a", "b"]),
        ],
    )
    def test_the_images_that_it_begins_from_are_known(
        self, dockerfile: str, images: list[str]
    ) -> None:
        assert images_in(dockerfile) == images

    def test_an_argument_that_is_given_counts_more_than_its_default(self) -> None:
        text = "ARG BASE_IMAGE=a\nFROM ${BASE_IMAGE}"
        assert images_in(text, {"BASE_IMAGE": "b", "OTHER": "c"}) == ["b"]

    def test_lines_can_be_put_into_every_stage(self) -> None:
        text = after_each_from("ARG X\nFROM a AS one\nRUN b\nFROM \\\n c\nRUN d", "ARG Y")
        assert text == "ARG X\nFROM a AS one\nARG Y\nRUN b\nFROM \\\n c\nARG Y\nRUN d\n"

    def test_images_are_named_anew_where_it_begins_from_them_and_nowhere_else(self) -> None:
        text = "ARG A=mine\nFROM mine:latest AS mine\nFROM mine2\nRUN mine"
        assert on_images(text, {"mine": "sha256:1"}) == (
            "ARG A=sha256:1\nFROM sha256:1 AS mine\nFROM mine2\nRUN mine"
        )

    def test_the_arguments_that_it_declares_are_known(self) -> None:
        text = "ARG A\nFROM x\n arg B=1 D='2 E'\nRUN echo ARG C"
        assert arguments_of(text) == {"A", "B", "D"}


class TestFinding:
    def test_a_projects_own_container_comes_before_neuros_s(self, project: Path, own: Path) -> None:
        write(project / "containers" / "neuros_nest", "FROM mine")
        assert found("neuros_nest", project, own).folder == project / "containers" / "neuros_nest"
        assert found("neuros_python", project, own).folder == own / "neuros_python"

    def test_the_latest_version_is_the_recipe_and_another_one_is_not(self, own: Path) -> None:
        assert found("neuros_python:latest", None, own).name == "neuros_python"
        assert find_recipe("neuros_python:1.0", None, own) is None

    @pytest.mark.parametrize("name", ["nowhere", "../own", "a/b", ".", "", "\0"])
    def test_a_name_without_a_folder_of_its_own_can_only_be_an_image(
        self, name: str, project: Path, own: Path
    ) -> None:
        assert find_recipe(name, project, own) is None

    def test_requirements_alone_begin_from_the_base(self, project: Path, own: Path) -> None:
        write(project / "containers" / "brain", requirements="numpy==1.26.4\n")
        recipe = found("brain", project, own)
        assert names(list(recipe.parents)) == ["neuros_python"]
        assert "install --no-cache-dir -r /tmp/requirements.txt" in recipe.dockerfile

    def test_a_folder_that_holds_neither_is_named(self, project: Path, own: Path) -> None:
        (project / "containers" / "brain").mkdir(parents=True)
        with pytest.raises(EnvironmentFault, match=r"brain: there is neither a Dockerfile nor"):
            find_recipe("brain", project, own)

    def test_images_that_begin_from_each_other_are_named(self, project: Path, own: Path) -> None:
        write(project / "containers" / "a", "FROM b")
        write(project / "containers" / "b", "FROM a")
        with pytest.raises(EnvironmentFault, match="begin from each other: a -> b -> a"):
            find_recipe("a", project, own)


class TestOrder:
    def test_parents_come_first_and_each_comes_once(self, project: Path, own: Path) -> None:
        write(project / "containers" / "brain", "FROM neuros_nest")
        recipes = [found("brain", project, own), found("neuros_nest", project, own)]
        assert names(in_order(recipes)) == ["neuros_python", "neuros_nest", "brain"]

    def test_a_parent_that_the_user_replaces_is_not_built(self, project: Path, own: Path) -> None:
        write(project / "containers" / "brain", requirements="numpy\n")
        assert names(in_order([found("brain", project, own)], {"brain": "debian:12"})) == ["brain"]

    def test_another_container_as_the_base_is_one(self, own: Path) -> None:
        recipe = found("neuros_nest", None, own)
        assert names(recipe.parents_on("neuros_python:latest")) == ["neuros_python"]


class TestDigest:
    """It says whether an image is what its folder says today."""

    @pytest.fixture
    def brain(self, project: Path) -> Path:
        folder = project / "containers" / "brain"
        write(folder, "FROM debian:12\nCOPY data /data\n")
        (folder / "data").write_text("1")
        return folder

    @pytest.fixture
    def digest(self, brain: Path, project: Path, own: Path) -> str:
        return found("brain", project, own).digest

    def test_it_stays_while_nothing_changes(
        self, brain: Path, project: Path, own: Path, digest: str
    ) -> None:
        (brain / "data").touch()
        (brain / "__pycache__").mkdir()
        (brain / "__pycache__" / "x.pyc").write_text("")
        assert found("brain", project, own).digest == digest

    @pytest.mark.parametrize("change", ["content", "name", "rights", "dockerfile", "base"])
    def test_it_changes_with_everything_that_goes_into_the_image(
        self, change: str, brain: Path, project: Path, own: Path, digest: str
    ) -> None:
        match change:
            case "content":
                (brain / "data").write_text("2")
            case "name":
                (brain / "data").rename(brain / "other")
            case "rights":
                (brain / "data").chmod(0o755)
            case "dockerfile":
                (brain / "Dockerfile").write_text("FROM debian:13\n")
            case "base":  # which is put on top of what lacks rclpy
                (own / "neuros_python" / "requirements.txt").write_text("more\n")
        assert found("brain", project, own).digest != digest

    def test_a_tag_is_a_part_of_it_and_neuros_s_own_are_the_latest_too(self) -> None:
        recipe = found("neuros_python", None, OWN_FOLDER)
        assert recipe.tags == [f"neuros_python:{recipe.digest[:12]}", "neuros_python:latest"]


class TestOwnRecipes:
    """What lies in ``containers/``."""

    def test_there_are_seven(self) -> None:
        assert names_in(OWN_FOLDER) == [
            "neuros_mujoco",
            "neuros_nest",
            "neuros_nir",
            "neuros_onnx",
            "neuros_python",
            "neuros_tensorflow",
            "neuros_tools",
        ]

    @pytest.mark.parametrize("name", names_in(OWN_FOLDER))
    def test_the_base_is_pinned_or_another_of_them(self, name: str) -> None:
        recipe = found(name, None, OWN_FOLDER)
        (image,) = images_in(recipe.dockerfile)
        assert "ARG BASE_IMAGE=" in recipe.dockerfile
        assert recipe.parents or re.fullmatch(
            r"python:3\.\d+\.\d+-slim-\w+|osrf/ros:jazzy-.*", image
        )

    @pytest.mark.parametrize("name", names_in(OWN_FOLDER))
    def test_an_ordinary_user_runs_it(self, name: str) -> None:
        users = re.findall(r"^USER (.+)$", found(name, None, OWN_FOLDER).dockerfile, re.MULTILINE)
        assert users[-1] == "1000:1000"


ROOT = Path(__file__).resolve().parents[2]
PINS = sorted((ROOT / "containers").glob("*/*.txt"))


def requirements(file: Path) -> list[str]:
    rows = (row.partition("#")[0].strip() for row in file.read_text().splitlines())
    return [row for row in rows if row]


def test_every_requirement_is_pinned_there_or_in_the_constraints() -> None:
    constrained = requirements(ROOT / "containers/neuros_python/constraints.txt")
    pinned = {row.partition("==")[0] for row in constrained}
    loose = [
        row
        for file in PINS
        for row in requirements(file)
        if "==" not in row.partition(";")[0] and re.split(r"[<>~!]", row)[0] not in pinned
    ]
    assert not loose


def test_the_pins_are_in_the_ranges_of_the_project() -> None:
    """What is tried with ``.venv`` is what runs in containers."""
    tomllib = pytest.importorskip("tomllib")
    packaging = pytest.importorskip("packaging.requirements")
    table = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    texts = [
        *table["dependencies"],
        *(t for e in table["optional-dependencies"].values() for t in e),
    ]
    ranges = {r.name: r.specifier for r in map(packaging.Requirement, texts)}
    compared = 0
    for row in (row for file in PINS for row in requirements(file)):
        pin = packaging.Requirement(row)
        for specifier in pin.specifier:
            if specifier.operator == "==" and pin.name in ranges:
                assert ranges[pin.name].contains(specifier.version), row
                compared += 1
    assert compared >= 7
