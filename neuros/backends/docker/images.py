"""Finds the image for a node; lists and removes images that NeuROS has built.

An image is run once to test whether its Python can run nodes.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from docker import DockerClient
from docker.errors import APIError, ImageNotFound, NotFound

from neuros.backends.containers import BASE, Recipe, find_recipe
from neuros.backends.docker.engine import engine_faults
from neuros.distribution import build_command
from neuros.errors import EnvironmentFault, UsageError
from neuros.installation.machine import NEWEST, OLDEST, dotted
from neuros.project.suggest import did_you_mean, listed

CONTAINER = "neuros.image.container"
FOLDER = "neuros.image.folder"
DIGEST = "neuros.image.digest"

START = "neuros.image.start"
PYTHON = "neuros.image.python"

ADDED = "neuros_on"
"""The repository of images that users have, with what nodes need added; tags are their ids."""


# Prints the facts about each Python of the image. A ROS distribution has to be sourced first. The
# proof uses rclpy: without its middleware rclpy does not work.
_PROBE = r"""
cd /
for setup in /opt/ros/*/setup.sh; do
  [ -f "$setup" ] && . "$setup" && export NEUROS_SETUP="$setup" && break
done
for python in /opt/neuros/bin/python "$VIRTUAL_ENV/bin/python" python3 python; do
  command -v "$python" >/dev/null 2>&1 || continue
  "$python" -c "$PROOF" 2>/dev/null || "$python" -c "$FACTS" 2>/dev/null
done
true
"""
_FACTS = r"""
import json, os, platform, sys
print(json.dumps({"python": sys.executable, "version": list(sys.version_info[:2]),
    "glibc": platform.libc_ver()[0] == "glibc", "machine": platform.machine(),
    "has_rclpy": "rclpy" in sys.modules, "setup": os.environ.get("NEUROS_SETUP", "")}))
"""
_PROOF = f"""
import rclpy, rclpy.utilities
rclpy.utilities.get_rmw_implementation_identifier()
{_FACTS}
"""
_PROBE_TIMEOUT_S = 120

# What may stand in an address of the engine, where ".." would lead elsewhere.
_REFERENCE = re.compile(r"[A-Za-z0-9][\w.-]*([:/@][A-Za-z0-9][\w.-]*)*")


@dataclass(frozen=True)
class Image:
    """An image that can run nodes.

    Attributes:
        id: of the engine, ``sha256:...``.
        name: for people.
        start: the command of its Python, without arguments.
        python_version: as ``(3, 12)``.
        notice: a sentence for each launch, or "".
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
        EnvironmentFault: with one line for each container without an image.
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
        EnvironmentFault: if it is absent, is not built, or cannot run nodes.
    """
    recipe = find_recipe(container, project_folder)
    with engine_faults(f"container '{container}'"):
        if recipe is None:
            return _given(container, engine)
        image = built_image(recipe, engine)
    to_build: Path | str = recipe.name
    if project_folder is not None and recipe.folder.is_relative_to(project_folder):
        has_file = (project_folder / "project.json").is_file()  # a project can do without
        to_build = project_folder if has_file else recipe.folder
    remedy = f"run {build_command(to_build)}"
    if image is None:
        raise EnvironmentFault(f"the image of container '{recipe.name}' is not built: {remedy}")
    notice = ""
    if not is_current(image, recipe):
        notice = f"the image of container '{recipe.name}' is older than its recipe: {remedy}"
    return _labelled(image, recipe.tags[0], notice)


def built_image(recipe: Recipe, engine: DockerClient) -> Any | None:
    """The newest image that was built from this folder or an equal one, current or not."""
    images = [
        image
        for image in engine.images.list(name=recipe.name, filters={"label": CONTAINER})
        if image.labels.get(CONTAINER) == recipe.name
        and (is_current(image, recipe) or image.labels.get(FOLDER) == str(recipe.folder))
    ]

    def age(image: Any) -> tuple[bool, str]:
        return is_current(image, recipe), str(image.attrs.get("Created", ""))

    return max(images, key=age, default=None)


def is_current(image: Any, recipe: Recipe) -> bool:
    return bool(image.labels.get(DIGEST) == recipe.digest)


def labels_of_python(python: PythonInImage) -> dict[str, str]:
    """Labels with the Python of an image, which then needs no second test."""
    return {START: json.dumps(python.start), PYTHON: dotted(python.version)}


def added_tag(image: Any) -> str:
    """The name of the image that is built on a user's image without rclpy."""
    return f"{ADDED}:{str(image.id).removeprefix('sha256:')[:12]}"


def _labelled(image: Any, name: str, notice: str = "") -> Image:
    labels: Mapping[str, str] = image.labels
    major, minor = map(int, labels[PYTHON].split("."))
    return Image(image.id, name, tuple(json.loads(labels[START])), (major, minor), notice)


def _given(container: str, engine: DockerClient) -> Image:
    """A user's image, or the one that was built on it."""
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
    with contextlib.suppress(ImageNotFound):
        return _labelled(engine.images.get(added_tag(image)), container)
    python = python_in(engine, image.id, container)
    if not python.has_rclpy:
        raise EnvironmentFault(
            f"image '{container}' has Python {dotted(python.version)} without rclpy, which"
            f" {BASE} has: to have it added, run {build_command(container)}"
        )
    return Image(image.id, container, python.start, python.version)


@dataclass(frozen=True)
class BuiltImage:
    """An image with a name that NeuROS gave it.

    Attributes:
        container: its container.
        tags: its names, without those that the user gave.
        size_bytes: with all its layers.
        python: the version, as "3.12".
        folder: of its recipe, ``None`` if NeuROS's base was built on an image of the user's.
        is_current: whether its recipe has not changed.
    """

    container: str
    tags: tuple[str, ...]
    size_bytes: int
    python: str
    folder: Path | None
    is_current: bool


def inventory(engine: DockerClient) -> list[BuiltImage]:
    """All images that NeuROS has built, by container.

    Raises:
        EnvironmentFault: if the engine does not answer.
    """
    found = []
    with engine_faults("the images cannot be listed"):
        images = engine.images.list(filters={"label": CONTAINER})
    for image in images:
        labels = image.labels
        container, folder = labels[CONTAINER], labels.get(FOLDER)
        # Labels are inherited: an image that the user built on one of ours has other names.
        tags = [tag for tag in image.tags if tag.rpartition(":")[0] in (container, ADDED)]
        if not tags:
            continue
        is_still = True
        if folder:
            try:
                recipe = find_recipe(container, Path(folder).parent.parent)
                is_still = recipe is not None and is_current(image, recipe)
            except EnvironmentFault:
                is_still = False
        found.append(
            BuiltImage(
                container=container,
                tags=tuple(sorted(tags)),
                size_bytes=int(image.attrs["Size"]),
                python=labels.get(PYTHON, "?"),
                folder=Path(folder) if folder else None,
                is_current=is_still,
            )
        )
    return sorted(found, key=lambda image: (image.container, image.tags))


def remove_images(engine: DockerClient, containers: Collection[str]) -> Iterator[str]:
    """Remove the images of these containers, or of all if none is named; yields the tags.

    Raises:
        UsageError: if one of them has no image; all images stay then.
        EnvironmentFault: if an image is in use.
    """
    images = inventory(engine)
    built = {image.container for image in images}
    if unknown := [name for name in containers if name not in built]:
        hint = did_you_mean(unknown[0], built) if len(unknown) == 1 else ""
        raise UsageError(
            f"NeuROS has built no image for {listed(unknown)}{hint and f' ({hint})'}: nothing was"
            " removed; `neuros containers list` shows what there is"
        )
    for image in reversed(images):
        if not containers or image.container in containers:
            for tag in image.tags:
                with engine_faults(f"{tag} cannot be removed"):
                    engine.images.remove(tag)
                yield tag


@dataclass(frozen=True)
class PythonInImage:
    """The Python that nodes would run in.

    Attributes:
        path: of the program.
        version: as ``(3, 12)``.
        has_rclpy: whether rclpy and its middleware load there.
        setup: the shell script of a ROS distribution that has to be sourced first, or "".
    """

    path: str
    version: tuple[int, int]
    has_rclpy: bool
    setup: str = ""

    @property
    def start(self) -> tuple[str, ...]:
        """The command that starts this Python, without arguments."""
        if not self.setup:
            return (self.path,)
        return ("/bin/sh", "-c", f'. {self.setup} && exec "$0" "$@"', self.path)


def python_in(engine: DockerClient, image: str, name: str) -> PythonInImage:
    """The Python of an image, found by a container that is then removed.

    Args:
        name: of the image, for messages.

    Raises:
        EnvironmentFault: if it has no Python that could ever run nodes.
    """
    output = ""
    with engine_faults(f"image '{name}' cannot be looked into"):
        try:
            container = engine.containers.create(
                image,
                entrypoint=["/bin/sh", "-c", _PROBE],
                command=[],
                environment={
                    "PROOF": _PROOF,
                    "FACTS": _FACTS,
                    "ROS_LOG_DIR": "/tmp",
                    "HOME": "/tmp",
                },
                labels={"neuros.probe": "1"},
                network_mode="none",
                user="65534:65534",
                cap_drop=["ALL"],
                security_opt=["no-new-privileges"],
            )
        except NotFound:
            raise EnvironmentFault(f"there is no image '{name}'") from None
        try:
            container.start()
            container.wait(timeout=_PROBE_TIMEOUT_S)
            output = container.logs(stdout=True, stderr=False).decode(errors="replace")
        except APIError as error:
            # An image without a shell has no Python to speak of.
            if "no such file" not in str(error).lower():
                raise
        finally:
            container.remove(force=True, v=True)
    answers = []
    for line in output.splitlines():
        with contextlib.suppress(ValueError):  # a ROS distribution prints while it is sourced
            answers.append(json.loads(line))
    return chosen([each for each in answers if isinstance(each, dict)], name)


def chosen(answers: Sequence[Mapping[str, Any]], name: str) -> PythonInImage:
    """The Python for nodes, among the facts about the Pythons of an image.

    Raises:
        EnvironmentFault: if there is none that could ever run nodes.
    """
    supported = f"{dotted(OLDEST)} to {dotted(NEWEST)}"
    if not answers:
        raise EnvironmentFault(
            f"image '{name}' has no Python: take one with Python {supported}, as python:3.12-slim"
        )
    answer = next((each for each in answers if each["has_rclpy"]), answers[0])
    major, minor = version = answer["version"]
    # There are no wheels of rclpy for everything.
    wrong = remedy = ""
    if not answer["glibc"]:
        wrong, remedy = "another C library than glibc", "Debian or Ubuntu, as python:3.12-slim"
    elif answer["machine"] != "x86_64":
        wrong, remedy = f"a processor of the kind {answer['machine']}", "x86_64"
    elif not OLDEST <= (major, minor) <= NEWEST:
        wrong, remedy = f"Python {dotted(version)}", f"Python {supported}"
    if wrong and not answer["has_rclpy"]:
        raise EnvironmentFault(
            f"image '{name}' has {wrong}, for which there is no package of rclpy: take an image"
            f" with {remedy}, or one with a ROS distribution"
        )
    return PythonInImage(answer["python"], (major, minor), answer["has_rclpy"], answer["setup"])
