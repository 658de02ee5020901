"""Finds the image of a container: built by NeuROS or a project, or one that the user has."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from docker import DockerClient
from docker.errors import APIError, ImageNotFound

from neuros.backends.docker.engine import engine_faults
from neuros.backends.docker.python_in_image import PythonInImage, python_in
from neuros.backends.docker.recipes import BASE, Recipe, find_recipe
from neuros.distribution import build_command
from neuros.errors import EnvironmentFault

CONTAINER = "neuros.image.container"
FOLDER = "neuros.image.folder"
DIGEST = "neuros.image.digest"

START = "neuros.image.start"
PYTHON = "neuros.image.python"

ADDED = "neuros_on"
"""The repository of images that users have, with what nodes need added; tags are their ids."""

# What may stand in an address of the engine, where ".." would lead elsewhere.
_REFERENCE = re.compile(r"[A-Za-z0-9][\w.-]*([:/@][A-Za-z0-9][\w.-]*)*")


@dataclass(frozen=True)
class Image:
    """An image that can run nodes.

    Attributes:
        id: as the engine names it, ``sha256:...``.
        name: for people.
        start: how its Python is started: ``[*start, "-m", "neuros.cli", "node", ...]``.
        python_version: of that Python, as ``(3, 12)``.
        notice: one sentence if something about it should be said at each launch, else "".
    """

    id: str
    name: str
    start: tuple[str, ...]
    python_version: tuple[int, int]
    notice: str = ""


def images_for(
    containers: Iterable[str], project_folder: Path | None, engine: DockerClient
) -> dict[str, Image]:
    """The image of each container.

    Raises:
        EnvironmentFault: with one line for each that has none.
    """
    found: dict[str, Image] = {}
    faults: list[str] = []
    for container in dict.fromkeys(containers):
        try:
            found[container] = image_for(container, project_folder, engine)
        except EnvironmentFault as fault:
            faults.append(str(fault))
    if faults:
        raise EnvironmentFault("\n".join(faults))
    return found


def image_for(container: str, project_folder: Path | None, engine: DockerClient) -> Image:
    """The image of a container: the project's own recipe, NeuROS's, or any image of that name.

    Raises:
        EnvironmentFault: if it is not there, is not built, or cannot run nodes.
    """
    recipe = find_recipe(container, project_folder)
    with engine_faults(f"container '{container}'"):
        if recipe is None:
            return _given(container, engine)
        return _built(recipe, project_folder, engine)


def built_image(recipe: Recipe, engine: DockerClient) -> Any | None:
    """The newest image that was built from this folder or an equal one, current or not."""
    images = [
        image
        for image in engine.images.list(name=recipe.name, filters={"label": CONTAINER})
        if image.labels.get(CONTAINER) == recipe.name
        and (is_current(image, recipe) or image.labels.get(FOLDER) == str(recipe.folder))
    ]
    newest_last = sorted(images, key=lambda image: str(image.attrs.get("Created", "")))
    current = [image for image in newest_last if is_current(image, recipe)]
    return (current or newest_last or [None])[-1]


def is_current(image: Any, recipe: Recipe) -> bool:
    """Whether nothing has changed in the recipe since this was built."""
    return bool(image.labels.get(DIGEST) == recipe.digest)


def labels_of_python(python: PythonInImage) -> dict[str, str]:
    """Labels of a built image that describe its Python, so that it is run only once."""
    return {START: json.dumps(python.start), PYTHON: "{}.{}".format(*python.version)}


def added_tag(image: Any) -> str:
    """The name of what is built on an image of a user's that lacks rclpy."""
    return f"{ADDED}:{str(image.id).removeprefix('sha256:')[:12]}"


def _built(recipe: Recipe, project_folder: Path | None, engine: DockerClient) -> Image:
    image = built_image(recipe, engine)
    remedy = f"run {build_command(_to_build(recipe, project_folder))}"
    if image is None:
        raise EnvironmentFault(f"the image of container '{recipe.name}' is not built: {remedy}")
    notice = ""
    if not is_current(image, recipe):
        notice = f"the image of container '{recipe.name}' is older than its recipe: {remedy}"
    return _labelled(image, recipe.tags[0], notice)


def _to_build(recipe: Recipe, project_folder: Path | None) -> Path | str:
    """The argument that builds an image; a project can do without a ``project.json``."""
    if project_folder is None or not recipe.folder.is_relative_to(project_folder):
        return recipe.name
    return project_folder if (project_folder / "project.json").is_file() else recipe.folder


def _labelled(image: Any, name: str, notice: str = "") -> Image:
    labels: Mapping[str, str] = image.labels
    major, minor = map(int, labels[PYTHON].split("."))
    return Image(image.id, name, tuple(json.loads(labels[START])), (major, minor), notice)


def _given(container: str, engine: DockerClient) -> Image:
    """An image that the user has; its own Python is used where that has rclpy."""
    try:
        image = engine.images.get(container) if _REFERENCE.fullmatch(container) else None
    except (ImageNotFound, APIError) as error:
        if not isinstance(error, ImageNotFound) and error.status_code != 400:
            raise
        image = None
    if image is None:
        raise EnvironmentFault(
            f"container '{container}': there is no folder containers/{container}, and the engine"
            f" has no image of that name: docker pull {container}, or write its Dockerfile"
        )
    if START in image.labels:
        return _labelled(image, container)
    try:
        return _labelled(engine.images.get(added_tag(image)), container)
    except ImageNotFound:
        pass
    python = python_in(engine, image.id, container)
    if not python.has_rclpy:
        raise EnvironmentFault(
            f"image '{container}' has Python {'{}.{}'.format(*python.version)} without rclpy, which"
            f" {BASE} has: to have it added, run {build_command(container)}"
        )
    return Image(image.id, container, python.start, python.version)
