"""Single builds: a Dockerfile becomes an image without a name, or a sentence on why not."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from docker import DockerClient
from docker.errors import APIError

from neuros.errors import EnvironmentFault
from neuros.installation.progress import Progress
from neuros.launch.docker.build_log import BuildLog
from neuros.launch.docker.buildkit import buildkit_messages, named, require_buildkit
from neuros.launch.docker.context import CERTIFICATES, Surroundings, context_of
from neuros.launch.docker.dockerfile import after_each_from, label_line, needs_buildkit
from neuros.launch.docker.python_in_image import PythonInImage, python_in
from neuros.launch.docker.recipes import BASE, BASE_ARGUMENT, find_recipe

_NOTHING: Mapping[str, str] = MappingProxyType({})
_DOCKERFILE = "Dockerfile"


class BuildSteps:
    """The builds that one image takes, all with one log.

    Args:
        name: of the image, for messages.
        log: the file for what the engine says.
    """

    def __init__(
        self,
        engine: DockerClient,
        around: Surroundings,
        progress: Progress,
        name: str,
        log: Path,
    ) -> None:
        self._engine, self._around, self._progress = engine, around, progress
        self._name, self._log = name, log
        log.parent.mkdir(parents=True, exist_ok=True)
        log.unlink(missing_ok=True)

    def build(
        self,
        folder: Path | None,
        dockerfile: str,
        arguments: Mapping[str, str] = _NOTHING,
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
        with named(self._engine, {**given, _DOCKERFILE: dockerfile}) as texts:
            archive = context_of(folder, texts.pop(_DOCKERFILE), self._around.files)
            with buildkit_messages(self._engine, archive, buildargs=texts, **settings) as messages:
                return self._follow(messages)

    def _run(self, archive: io.BytesIO, **settings: Any) -> str:
        # The classic builder's API: each line of its output is a JSON object.
        stream = self._engine.api.build(
            fileobj=archive,
            custom_context=True,
            decode=True,
            rm=True,
            forcerm=True,
            **settings,
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
                " add it from: it is part of the source checkout of NeuROS"
            )
        added = {BASE_ARGUMENT: image, "CONSTRAINTS": ""}
        made = self.build(base.folder, base.dockerfile, added)
        python = python_in(self._engine, made, self._name)
        if not python.has_rclpy:
            raise EnvironmentFault(
                f"image '{self._name}': rclpy was installed and does not load: run"
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
            remedy = "the one that the engine has is taken without --pull"
        raise EnvironmentFault(
            f"image '{name}' cannot be pulled ({error.explanation or error}): {remedy}"
        ) from error
