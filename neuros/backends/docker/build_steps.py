"""Steps of an image build, their log, and the causes of failures.

BuildKit understands more of a Dockerfile than the classic builder; every engine that NeuROS takes
has both. BuildKit asks its client for the files of a build over a session (gRPC), which the SDK
does not have; or it fetches them itself, from an address. So it gets one, of this machine, for the
time of the build.
"""

from __future__ import annotations

import base64
import contextlib
import gzip
import io
import re
import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import MappingProxyType
from typing import Any

from docker import DockerClient
from docker.errors import APIError

from neuros.backends.docker.context import CERTIFICATES, Surroundings, context_of, serving
from neuros.backends.docker.dockerfile import (
    Instruction,
    after_each_from,
    has_syntax_line,
    label_line,
    needs_buildkit,
)
from neuros.backends.docker.engine import Abilities, engine_socket
from neuros.backends.docker.python_in_image import PythonInImage, python_in
from neuros.backends.docker.recipes import BASE, BASE_ARGUMENT, find_recipe
from neuros.distribution import install_command
from neuros.errors import EnvironmentFault
from neuros.installation.progress import Progress

_NOTHING: Mapping[str, str] = MappingProxyType({})
_DOCKERFILE = "Dockerfile"
_TAIL_LINES = 12
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")

# The first that fits what was said last tells why.
_CAUSES = (
    (r"no space left on device|\[Errno 28\]", "the disk is full: make room (docker system df)"),
    (
        r"CERTIFICATE_VERIFY_FAILED|x509: certificate",
        "a certificate is not trusted: give your authority's with --ca-bundle FILE",
    ),
    (
        r"ERROR: No matching distribution found for (?P<what>\S+)",
        "there is no package {what} for the Python of this image (or it is not in the wheelhouse):"
        " correct the requirements.txt, or take another Python with --base-image",
    ),
    (
        r"ERROR: ResolutionImpossible|have conflicting dependencies",
        "its requirements.txt cannot be satisfied, because packages in it exclude each other:"
        " loosen their versions",
    ),
    (
        r"E: Unable to locate package (?P<what>\S+)|E: Package '?(?P<also>[\w.+-]+)'? has no",
        "the package sources of its base have no {what}: correct the name, or take another base"
        " with --base-image",
    ),
    (
        r"pull access denied for (?P<what>[^\s,]+)|manifest for (?P<also>\S+) not found",
        "there is no image {what} to begin from: correct the FROM line, or name one that the engine"
        " has with --base-image",
    ),
    (
        r"(?P<what>\S+): pull access denied, repository does not exist",
        "there is no image {what} to begin from: correct the FROM line, or name one that the engine"
        " has with --base-image",
    ),
    (
        r"dockerfile parse error.*unknown flag: (?P<what>[\w-]+)",
        "this engine is too old for the option --{what} in its Dockerfile: install a newer engine,"
        " or remove the option",
    ),
    (
        r"Get \"?https?://(?P<what>[^/\"]+)|lookup (?P<also>\S+).* no such host",
        "the registry {what} cannot be reached: check the network and the engine's proxy, or name"
        " an image that the engine has with --base-image",
    ),
    (
        r"Temporary failure in name resolution|Temporary failure resolving|NewConnectionError"
        r"|Network is unreachable|Could not resolve|ConnectTimeout|ReadTimeout|ProxyError",
        "the package index cannot be reached: check the network (behind a proxy: export"
        " HTTPS_PROXY=http://HOST:PORT), or build from a folder of wheels with --wheelhouse DIR",
    ),
    (
        r"ensurepip is not available|No module named '?(venv|ensurepip)",
        "the Python of its base has no venv: add the package python3-venv to the base",
    ),
    (r"python3: (command )?not found", "its base has no Python: take one with Python 3.10 to 3.14"),
    (
        r"Permission denied|are you root\?",
        "a step may not write: images of NeuROS run as an ordinary user, so put USER 0 above it",
    ),
    (
        r"COPY failed|ADD failed|(compute cache key|calculate checksum).*: not found",
        "a file that its Dockerfile copies is not beside it",
    ),
)


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


class BuildLog:
    """The output of a build, as it comes.

    Args:
        file: keeps all of it.
        show: is called with each step.
    """

    def __init__(self, file: Path, show: Callable[[str], object]) -> None:
        self._file, self._show = file, show
        self._lines: list[str] = []
        self._begun = ""  # a line of which the rest is still to come

    def follow(self, stream: Iterable[Mapping[str, Any]]) -> str | None:
        """Read a build to its end; returns the id of the image, ``None`` if it failed."""
        image = None
        with self._file.open("a", encoding="utf-8") as file:
            for message in stream:
                text = str(message.get("stream") or message.get("error") or "")
                file.write(text)
                image = message.get("aux", {}).get("ID", image)
                if "error" in message:
                    self._take("\n" * bool(self._begun) + text + "\n")
                    return None
                self._take(text)
        self._take("\n")
        return image

    @property
    def tail(self) -> list[str]:
        """The last lines."""
        return self._lines[-_TAIL_LINES:]

    @property
    def cause(self) -> str:
        """Why it failed, in a sentence."""
        text = "\n".join(self._lines[-40:])
        for pattern, sentence in _CAUSES:
            if match := re.search(pattern, text, re.IGNORECASE):
                names = match.groupdict()
                return sentence.format(what=names.get("what") or names.get("also"))
        return self._lines[-1] if self._lines else "the engine does not say why"

    def _take(self, text: str) -> None:
        *lines, self._begun = (self._begun + text).split("\n")
        for line in _COLOURS.sub("", "\n".join(lines)).splitlines():
            if line.strip():
                self._lines.append(line.rstrip())
                if line.startswith("Step ") or re.match(r"\s*(Collecting|Downloading)", line):
                    self._show(line.strip())


_HEREDOCS_SINCE = (23, 0)
_IMAGE_ID = re.compile(r"\bsha256:([0-9a-f]{12})[0-9a-f]{52}\b")
_TEMPORARY = "neuros_begin"
_WRAPPED = re.compile(
    r"^((failed to solve( with frontend \S+)?|failed to create LLB definition): )+"
)
_TRACE = "moby.buildkit.trace"
_BY_HAND = "or build the image by hand (docker build -t NAME) and put its NAME into the project"


def require_buildkit(
    engine: DockerClient, image: str, dockerfile: str, step: Instruction, what: str
) -> None:
    """See to it that BuildKit can be used for what the classic builder does not understand.

    Raises:
        EnvironmentFault: if it cannot.
    """
    begin = f"image '{image}': line {step.first} of its Dockerfile ({what})"
    if Abilities.of(engine.info()).is_rootless or not _is_here(engine):
        raise EnvironmentFault(
            f"{begin} needs BuildKit, which cannot fetch files of this machine for a rootless"
            f" engine or one on another machine: write the line without it, {_BY_HAND}"
        )
    version = str(engine.version()["Version"])
    numbers = tuple(map(int, re.findall(r"\d+", version)[:2]))
    if step.heredocs and numbers < _HEREDOCS_SINCE and not has_syntax_line(dockerfile):
        raise EnvironmentFault(
            f"{begin} needs Docker Engine {_HEREDOCS_SINCE[0]} or newer, and this is {version}:"
            " write its lines as one RUN, with && between them, or, if the engine can reach a"
            " registry, begin the Dockerfile with '# syntax=docker/dockerfile:1'"
        )


@contextmanager
def buildkit_messages(
    engine: DockerClient, archive: io.BytesIO, **settings: Any
) -> Iterator[Iterator[Mapping[str, Any]]]:
    """Build with BuildKit; what it says is as from the classic builder.

    Args:
        archive: the context, a tar archive.
        settings: of ``APIClient.build``.
    """
    # From its first bytes BuildKit tells an archive from a Dockerfile, if it is compressed.
    with _served(gzip.compress(archive.getvalue(), 1)) as address:
        parameters = engine.api.params
        engine.api.params = {**parameters, "version": "2"}  # the SDK has no name for it
        try:
            stream = engine.api.build(path=address, decode=True, **settings)
        finally:
            engine.api.params = parameters
        yield _as_classic(stream)


@contextmanager
def named(engine: DockerClient, texts: Mapping[str, str]) -> Iterator[dict[str, str]]:
    """The texts with names for the ids of images, which BuildKit takes for names.

    The names are there as long as the context lasts.
    """
    token, names = secrets.token_hex(4), {}
    for text in texts.values():
        for match in _IMAGE_ID.finditer(text):
            names[match[0]] = f"{_TEMPORARY}:{match[1]}-{token}"
    try:
        for image, name in names.items():
            engine.images.get(image).tag(name)
        yield {
            key: _IMAGE_ID.sub(lambda match: names[match[0]], text) for key, text in texts.items()
        }
    finally:
        tagged = {tag for image in engine.images.list(_TEMPORARY) for tag in image.tags}
        for name in tagged.intersection(names.values()):
            engine.images.remove(name)


def _is_here(engine: DockerClient) -> bool:
    try:
        engine_socket(engine)
    except EnvironmentFault:
        return False
    return True


@contextmanager
def _served(content: bytes) -> Iterator[str]:
    """Serve this at a secret address, to programs of this machine only."""
    secret = f"/{secrets.token_urlsafe()}/context.tar.gz"

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            """The content, or nothing."""
            if self.path != secret:
                self.send_error(404)
                return
            self.send_response(200)
            self.send_header("Content-Type", "application/gzip")
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: object) -> None:
            """Log nothing."""

    with serving(ThreadingHTTPServer(("127.0.0.1", 0), Handler)) as address:
        yield address + secret


def _as_classic(stream: Iterable[Mapping[str, Any]]) -> Iterator[Mapping[str, Any]]:
    """BuildKit's messages as the classic builder would have written them."""
    begun: set[bytes] = set()
    for message in stream:
        if message.get("id") != _TRACE:
            error = message.get("error")
            yield {**message, "error": _WRAPPED.sub("", error)} if error else message
            continue
        # StatusResponse of buildkit/api/services/control/control.proto
        for kind, part in _fields(base64.b64decode(message["aux"])):
            fields = dict(_fields(part)) if kind in (1, 3) else {}
            if kind == 1 and 5 in fields and fields[1] not in begun:  # a step has started
                begun.add(fields[1])
                yield {"stream": f"Step {_text(fields.get(3))}\n"}
            elif kind == 3:  # what a step has written
                yield {"stream": _text(fields.get(4))}


def _fields(data: bytes) -> Iterator[tuple[int, bytes]]:
    """The fields of a protobuf message that have a length: texts, and messages in it."""
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        if key & 7 == 2:
            size, at = _varint(data, at)
            yield key >> 3, data[at : at + size]
            at += size
        elif key & 7 == 0:
            _, at = _varint(data, at)
        else:
            at += 8 if key & 7 == 1 else 4


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A number, and where it ends."""
    number, shift = 0, 0
    while True:
        number |= (data[at] & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if data[at - 1] < 0x80:
            return number, at


def _text(data: bytes | None) -> str:
    return (data or b"").decode(errors="replace")
