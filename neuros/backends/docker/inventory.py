"""Lists and removes the images that NeuROS has built."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from docker import DockerClient

from neuros.backends.docker.engine import engine_faults
from neuros.backends.docker.images import ADDED, CONTAINER, DIGEST, FOLDER, PYTHON
from neuros.backends.docker.recipes import find_recipe
from neuros.errors import EnvironmentFault, UsageError
from neuros.project.suggest import did_you_mean, listed


@dataclass(frozen=True)
class BuiltImage:
    """An image with a name that NeuROS gave it.

    Attributes:
        container: that it is for.
        tags: its names; those that the user gave are not among them.
        size_bytes: with everything that it begins from.
        python: the version, as "3.12".
        folder: of its recipe, ``None`` where NeuROS's base was put on an image of the user's.
        is_current: whether it is what the recipe says today.
    """

    container: str
    tags: tuple[str, ...]
    size_bytes: int
    python: str
    folder: Path | None
    is_current: bool


def inventory(engine: DockerClient) -> list[BuiltImage]:
    """Everything that NeuROS has built, by container.

    Raises:
        EnvironmentFault: if the engine does not answer.
    """
    with engine_faults("the images cannot be listed"):
        found = [*_found(engine)]
    return sorted(found, key=lambda image: (image.container, image.tags))


def remove_images(engine: DockerClient, containers: Collection[str]) -> Iterator[str]:
    """Remove what was built for these containers, or for all if none is named; yields the tags.

    Raises:
        UsageError: if nothing was built for one of them; all images stay then.
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


def _found(engine: DockerClient) -> Iterator[BuiltImage]:
    for image in engine.images.list(filters={"label": CONTAINER}):
        labels = image.labels
        container = labels[CONTAINER]
        # Labels are inherited: an image that the user built on one of ours has other names.
        tags = [tag for tag in image.tags if tag.rpartition(":")[0] in (container, ADDED)]
        if tags:
            folder = Path(labels[FOLDER]) if labels.get(FOLDER) else None
            yield BuiltImage(
                container=container,
                tags=tuple(sorted(tags)),
                size_bytes=int(image.attrs["Size"]),
                python=labels.get(PYTHON, "?"),
                folder=folder,
                is_current=_digest_now(container, folder) in (None, labels.get(DIGEST)),
            )


def _digest_now(container: str, folder: Path | None) -> str | None:
    """The digest of the recipe as it is now, ``None`` where there is none to compare with."""
    if folder is None:
        return None
    try:
        recipe = find_recipe(container, folder.parent.parent)
    except EnvironmentFault:
        return ""
    return recipe.digest if recipe else ""
