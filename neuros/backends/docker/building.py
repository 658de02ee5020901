"""Builds the images of recipes: parents first, what is current not again, a tag for the whole only.

Each image is built without a name, is run once to see that it can run nodes, gets what it lacks for
that (the recipe ``neuros_python`` on top of it), and its tag last. The classic builder is used, and
BuildKit where a Dockerfile takes it.
"""

from __future__ import annotations

import contextlib
import io
import json
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from docker import DockerClient
from docker.errors import APIError, ImageNotFound

from neuros.backends.containers import BASE, BASE_ARGUMENT, Recipe, bare_name, find_recipe, in_order
from neuros.backends.docker.builders import (
    CERTIFICATES,
    DOCKERFILE,
    BuildLog,
    Surroundings,
    buildkit_messages,
    context_of,
    named,
    require_buildkit,
)
from neuros.backends.docker.dockerfile import (
    after_each_from,
    arguments_of,
    images_in,
    label_line,
    needs_buildkit,
    on_images,
)
from neuros.backends.docker.engine import engine_faults
from neuros.backends.docker.images import (
    CONTAINER,
    DIGEST,
    FOLDER,
    PythonInImage,
    added_tag,
    built_image,
    labels_of_python,
    python_in,
)
from neuros.distribution import install_command
from neuros.errors import EnvironmentFault, UsageError
from neuros.installation.progress import Progress

_BASE = "neuros.image.base"
_ARGUMENTS = "neuros.image.arguments"
_FROM = "neuros.image.from"
_NOTHING: Mapping[str, str] = MappingProxyType({})


class ImageBuilder:
    """Builds images, with a line about each.

    Args:
        logs: the folder for what the engine says.
        bases: base images by container name, in place of those in the Dockerfiles.
        arguments: build arguments for the Dockerfiles that declare them.
        pull: whether the newest version of base images is asked for.
    """

    def __init__(
        self,
        engine: DockerClient,
        around: Surroundings,
        progress: Progress,
        logs: Path,
        *,
        bases: Mapping[str, str],
        arguments: Mapping[str, str],
        pull: bool,
    ) -> None:
        self._engine, self._around, self._progress = engine, around, progress
        self._logs, self._bases, self._arguments, self._pull = logs, bases, arguments, pull

    def build(self, recipes: Iterable[Recipe]) -> None:
        """Build what is missing or out of date of these and of what they begin from.

        Raises:
            UsageError: for a base image that would not be used; nothing is built then.
            EnvironmentFault: at the first that cannot be built; those before it are kept.
        """
        recipes = list(recipes)
        with engine_faults("images cannot be built"):
            bases = self._remembered_bases(recipes) | dict(self._bases)
        wanted = in_order(recipes, bases)
        _require_use(self._bases, wanted)
        for recipe in wanted:
            with engine_faults(f"image '{recipe.name}' cannot be built"):
                self._bring_up_to_date(recipe, bases.get(recipe.name, ""))

    def add_to(self, name: str) -> None:
        """Build, on an image that the user has, one that can run nodes; nothing where it can.

        Raises:
            EnvironmentFault: if there is no such image, or it can never run nodes.
        """
        started_s = time.monotonic()
        with engine_faults(f"image '{name}' cannot be used"):
            try:
                image = self._engine.images.get(name)
            except ImageNotFound:
                raise EnvironmentFault(
                    f"there is neither a folder containers/{name} nor an image '{name}': docker"
                    f" pull {name}, or correct the name"
                ) from None
            steps = self._steps(name)
            made, python = steps.able(image.id)
            if made == image.id:
                self._progress.step(f"{name}: can run nodes as it is")
                return
            labels = {CONTAINER: name, **labels_of_python(python)}
            steps.finish(made, [added_tag(image)], labels)
            self._report(f"{name}: built {added_tag(image)}, with what nodes need", started_s)

    def _steps(self, name: str) -> BuildSteps:
        log = self._logs / f"{name.replace('/', '_')}.log"
        return BuildSteps(self._engine, self._around, self._progress, name, log)

    def _remembered_bases(self, recipes: Iterable[Recipe]) -> dict[str, str]:
        """The base images that the user wanted when these were built last."""
        built = [(recipe, built_image(recipe, self._engine)) for recipe in in_order(recipes)]
        return {
            recipe.name: base
            for recipe, old in built
            if old and (base := old.labels.get(_BASE)) and recipe.takes(base)
        }

    def _bring_up_to_date(self, recipe: Recipe, base: str) -> None:
        started_s = time.monotonic()
        old = built_image(recipe, self._engine)
        labels = self._labels(recipe, base, old)
        if self._pull and not base:
            self._pull_bases(recipe)
        begin = {
            parent.name: built_image(parent, self._engine).id  # type: ignore[union-attr]
            for parent in recipe.parents_on(base or None)
        }
        if base and base not in begin:
            begin[base] = str(pulled(self._engine, base, newest=self._pull).id)
        labels[_FROM] = json.dumps(begin, sort_keys=True)
        compared = (DIGEST, _BASE, _ARGUMENTS, _FROM)
        is_as_wanted = old and all(old.labels.get(key) == labels[key] for key in compared)
        if is_as_wanted and not self._pull:
            self._progress.step(f"{recipe.name}: up to date, {_size(old)}")
            return
        steps = self._steps(recipe.name)
        arguments = json.loads(labels[_ARGUMENTS])
        if base:
            arguments[BASE_ARGUMENT] = self._base(recipe, base, begin[base], steps)
        text = on_images(recipe.dockerfile, begin)
        made, python = steps.able(steps.build(recipe.folder, text, arguments))
        steps.finish(made, recipe.tags, {**labels, **labels_of_python(python)})
        self._forget(recipe, old)
        self._report(f"{recipe.name}: built", started_s, self._engine.images.get(recipe.tags[0]))

    def _labels(self, recipe: Recipe, base: str, old: Any | None) -> dict[str, str]:
        """Labels that the image is to have; arguments of last time count again."""
        wanted = old.labels if old is not None else {}
        known = arguments_of(recipe.dockerfile)
        given = {key: value for key, value in self._arguments.items() if key in known}
        arguments = json.loads(wanted.get(_ARGUMENTS, "{}")) | given
        return {
            CONTAINER: recipe.name,
            FOLDER: str(recipe.folder),
            DIGEST: recipe.digest,
            _BASE: base,
            _ARGUMENTS: json.dumps(arguments, sort_keys=True),
        }

    def _base(self, recipe: Recipe, base: str, image: str, steps: BuildSteps) -> str:
        """The image that the user wants to begin with.

        In place of a recipe's image it must be able to do what that can: run nodes.
        """
        replaces_recipe = len(recipe.parents_on(base)) < len(recipe.parents)
        return steps.able(image)[0] if replaces_recipe else image

    def _pull_bases(self, recipe: Recipe) -> None:
        parents = {parent.name for parent in recipe.parents}
        for image in images_in(recipe.dockerfile):
            if bare_name(image) not in parents and image != "scratch":
                self._progress.detail(f"{recipe.name}: pulling {image}")
                pulled(self._engine, image, newest=True)

    def _forget(self, recipe: Recipe, old: Any | None) -> None:
        """Remove what was built from this folder before, unless somebody uses it.

        Labels are inherited, so only names that were given here say what is ours.
        """
        stale = [
            tag
            for image in self._engine.images.list(
                name=recipe.name, filters={"label": f"{FOLDER}={recipe.folder}"}
            )
            for tag in image.tags
            if tag not in recipe.tags and tag.startswith(f"{recipe.name}:")
        ]
        with contextlib.suppress(ImageNotFound):
            if old is not None and not self._engine.images.get(old.id).tags:
                stale.append(old.id)
        for name in stale:
            with contextlib.suppress(APIError):
                self._engine.images.remove(name)

    def _report(self, text: str, started_s: float, image: Any | None = None) -> None:
        size = f", {_size(image)}" if image is not None else ""
        self._progress.step(f"{text} in {time.monotonic() - started_s:.1f} s{size}")


def _require_use(bases: Mapping[str, str], recipes: Iterable[Recipe]) -> None:
    """Raise ``UsageError`` where an image that is to be begun from would not be."""
    by_name = {recipe.name: recipe for recipe in recipes}
    for name, base in bases.items():
        recipe = by_name.get(name)
        if recipe is None:
            names = ", ".join(sorted(by_name)) or "none"
            raise UsageError(
                f"--base-image {name}={base}: no container '{name}' is built here (there are:"
                f" {names})"
            )
        if not recipe.takes(base):
            raise UsageError(
                f"--base-image {name}={base}: {recipe.folder}/Dockerfile does not begin from"
                f" {BASE_ARGUMENT}: let it begin with 'ARG {BASE_ARGUMENT}=...' and"
                f" 'FROM ${{{BASE_ARGUMENT}}}', or write the image into its FROM line"
            )


def _size(image: Any) -> str:
    return f"{image.attrs['Size'] / 1e6:.0f} MB"


class BuildSteps:
    """The builds that one image takes, all with one log.

    Args:
        name: of the image, for messages.
        log: the file for what the engine says.
    """

    def __init__(
        self, engine: DockerClient, around: Surroundings, progress: Progress, name: str, log: Path
    ) -> None:
        self._engine, self._around, self._progress = engine, around, progress
        self._name, self._log = name, log
        log.parent.mkdir(parents=True, exist_ok=True)
        log.unlink(missing_ok=True)

    def build(
        self, folder: Path | None, dockerfile: str, arguments: Mapping[str, str] = _NOTHING
    ) -> str:
        """Build from the files of ``folder``; returns the id of the image.

        Raises:
            EnvironmentFault: if it fails.
        """
        found = needs_buildkit(dockerfile)
        if found:
            require_buildkit(self._engine, self._name, dockerfile, *found)
        if self._around.lines:
            dockerfile = after_each_from(dockerfile, self._around.lines)
        given = {**self._around.arguments, **arguments}
        settings = {"network_mode": self._around.network}
        if not found:
            archive = context_of(folder, dockerfile, self._around.files)
            return self._run(archive, buildargs=given, **settings)
        with named(self._engine, {**given, DOCKERFILE: dockerfile}) as texts:
            archive = context_of(folder, texts.pop(DOCKERFILE), self._around.files)
            with buildkit_messages(self._engine, archive, buildargs=texts, **settings) as messages:
                return self._follow(messages)

    def _run(self, archive: io.BytesIO, **settings: Any) -> str:
        # The classic builder's API: each line of its output is a JSON object.
        stream = self._engine.api.build(
            fileobj=archive, custom_context=True, decode=True, rm=True, forcerm=True, **settings
        )
        return self._follow(stream)

    def _follow(self, messages: Iterable[Mapping[str, Any]]) -> str:
        log = BuildLog(self._log, lambda line: self._progress.detail(f"{self._name}: {line}"))
        image = log.follow(messages)
        if image is None:
            for line in log.tail:
                self._progress.step(f"  {line[:300]}")
            raise EnvironmentFault(
                f"image '{self._name}' cannot be built: {log.cause} (log: {self._log})"
            )
        return image

    def able(self, image: str) -> tuple[str, PythonInImage]:
        """The image itself if it can run nodes, else one with what it lacks on top of it.

        Raises:
            EnvironmentFault: if it can never run nodes.
        """
        python = python_in(self._engine, image, self._name)
        if python.has_rclpy:
            return image, python
        base = find_recipe(BASE)
        if base is None:
            raise EnvironmentFault(
                f"image '{self._name}' has no rclpy, and there is no folder containers/{BASE} to"
                f" add it from: {install_command()}"
            )
        added = {BASE_ARGUMENT: image, "CONSTRAINTS": ""}
        made = self.build(base.folder, base.dockerfile, added)
        python = python_in(self._engine, made, self._name)
        if not python.has_rclpy:
            raise EnvironmentFault(
                f"image '{self._name}': rclpy was installed, but does not load; to see why, run"
                f" docker run --rm --entrypoint {python.path} {made[7:19]} -c 'import rclpy'"
            )
        return made, python

    def finish(self, image: str, tags: Sequence[str], labels: Mapping[str, str]) -> None:
        """Take away what only the build needed, write the labels, and give it its names."""
        lines = [f"FROM {image}"]
        if self._around.ca_bundle:
            user = self._engine.images.get(image).attrs["Config"].get("User") or "0"
            lines += ["USER 0", f"RUN rm -f {CERTIFICATES}", f"USER {user}"]
        lines.append(label_line(labels))
        made = self._run(context_of(None, "\n".join(lines)), tag=tags[0], network_mode="none")
        for further in tags[1:]:
            self._engine.images.get(made).tag(further)


def pulled(engine: DockerClient, name: str, *, newest: bool) -> Any:
    """An image of that name, from its registry where it is not there (or the ``newest`` is wanted).

    Raises:
        EnvironmentFault: if it cannot be had.
    """
    if not newest:
        with contextlib.suppress(APIError):
            return engine.images.get(name)
    try:
        return engine.images.pull(name, None if ":" in name.rpartition("/")[2] else "latest")
    except APIError as error:
        remedy = "docker load it, or name one that the engine has with --base-image"
        with contextlib.suppress(APIError):
            engine.images.get(name)
            remedy = "leave out --pull to use the one that the engine has"
        raise EnvironmentFault(
            f"image '{name}' cannot be pulled ({error.explanation or error}): {remedy}"
        ) from error
