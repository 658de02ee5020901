"""Builds with BuildKit, which understands more of a Dockerfile than the classic builder.

Every engine that NeuROS takes has both. BuildKit asks its client for the files of a build over a
session (gRPC), which the SDK does not have; or it fetches them itself, from an address. So it gets
one, of this machine, for the time of the build.
"""

from __future__ import annotations

import base64
import gzip
import io
import re
import secrets
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from docker import DockerClient

from neuros.backends.docker.context import serving
from neuros.backends.docker.dockerfile import Instruction, has_syntax_line
from neuros.backends.docker.engine import Abilities, engine_socket
from neuros.errors import EnvironmentFault

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
