"""Both builders of the engine: what goes into an image build, what it says, why it fails.

BuildKit understands more of a Dockerfile than the classic builder; every engine that NeuROS takes
has both. BuildKit asks its client for the files of a build over a session (gRPC), which the SDK
does not have; or it fetches them itself, from an address. So it gets one, of this machine, for the
time of the build.
"""

from __future__ import annotations

import base64
import gzip
import io
import re
import secrets
import tarfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from types import MappingProxyType
from typing import Any

from docker import DockerClient

from neuros.backends.containers import files_of
from neuros.backends.docker.dockerfile import Instruction, has_syntax_line
from neuros.backends.docker.engine import Abilities, engine_socket
from neuros.errors import EnvironmentFault

DOCKERFILE = "Dockerfile"
CERTIFICATES = "/tmp/neuros-ca-bundle.pem"
"""Where a build finds the certificates that the user gives; it is taken away at the end."""

_CERTIFICATES_IN_CONTEXT = ".neuros-ca-bundle.pem"
_TRUST = ("PIP_CERT", "SSL_CERT_FILE", "REQUESTS_CA_BUNDLE", "CURL_CA_BUNDLE")
_PROXIES = ("HTTP_PROXY", "HTTPS_PROXY", "FTP_PROXY", "NO_PROXY", "ALL_PROXY")
_NOTHING: Mapping[str, str] = MappingProxyType({})
_NO_FILES: Mapping[str, bytes] = MappingProxyType({})

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

_HEREDOCS_SINCE = (23, 0)
_IMAGE_ID = re.compile(r"\bsha256:([0-9a-f]{12})[0-9a-f]{52}\b")
_TEMPORARY = "neuros_begin"
_WRAPPED = re.compile(
    r"^((failed to solve( with frontend \S+)?|failed to create LLB definition): )+"
)
_TRACE = "moby.buildkit.trace"
_BY_HAND = "or build the image by hand (docker build -t NAME) and put its NAME into the project"


@dataclass(frozen=True)
class Surroundings:
    """Needs of this machine that all builds share.

    Attributes:
        arguments: build arguments; the engine keeps proxies out of the images' history.
        network: of the build, ``None`` for the engine's default.
        ca_bundle: certificates to trust besides, PEM.
        wheels: the address of a wheelhouse, or "".
    """

    arguments: Mapping[str, str] = field(default_factory=lambda: _NOTHING)
    network: str | None = None
    ca_bundle: bytes = b""
    wheels: str = ""

    @property
    def files(self) -> dict[str, bytes]:
        """Files to lay beside every Dockerfile."""
        return {_CERTIFICATES_IN_CONTEXT: self.ca_bundle} if self.ca_bundle else {}

    @property
    def lines(self) -> str:
        """Lines to declare in every stage of a Dockerfile."""
        lines = []
        if self.ca_bundle:
            lines.append(f"COPY {_CERTIFICATES_IN_CONTEXT} {CERTIFICATES}")
            lines.append(f"ARG {' '.join(f'{name}={CERTIFICATES}' for name in _TRUST)}")
        if self.wheels:
            lines.append(f"ARG PIP_NO_INDEX=1 PIP_FIND_LINKS={self.wheels}")
        return "\n".join(lines)


def surroundings(
    engine: DockerClient, environ: Mapping[str, str], ca_bundle: Path | None, wheels: str
) -> Surroundings:
    """Needs of this machine, from its environment and the engine.

    A wheelhouse leaves proxies out, and packages of the operating system.
    """
    proxies = {
        name: environ[name]
        for upper in _PROXIES
        for name in (upper, upper.lower())
        if environ.get(name)
    }
    is_here = any("127.0.0.1" in url or "localhost" in url for url in proxies.values())
    has_bridge = any(network.name == "bridge" for network in engine.networks.list())
    return Surroundings(
        arguments={"SYSTEM_PACKAGES": "", "WINDOWS": "no"} if wheels else proxies,
        network="host" if wheels or is_here or not has_bridge else None,
        ca_bundle=ca_bundle.read_bytes() if ca_bundle else b"",
        wheels=wheels,
    )


def context_of(
    folder: Path | None, dockerfile: str, further: Mapping[str, bytes] = _NO_FILES
) -> io.BytesIO:
    """A tar archive with the files of ``folder``, the Dockerfile, and ``further`` files.

    A link becomes the file that it leads to, which may be outside.
    """
    archive = io.BytesIO()
    with tarfile.open(fileobj=archive, mode="w", dereference=True) as tar:
        for file in files_of(folder) if folder else ():
            if file.name != DOCKERFILE or file.parent != folder:
                tar.add(file, str(file.relative_to(folder or file)), filter=_anonymous)
        for name, content in {DOCKERFILE: dockerfile.encode(), **further}.items():
            entry = tarfile.TarInfo(name)
            entry.size, entry.mode = len(content), 0o644
            tar.addfile(entry, io.BytesIO(content))
    archive.seek(0)
    return archive


def _anonymous(entry: tarfile.TarInfo) -> tarfile.TarInfo:
    """Make it readable by all, without its owner."""
    entry.uid = entry.gid = 0
    entry.uname = entry.gname = ""
    entry.mode = 0o755 if entry.mode & 0o111 else 0o644
    return entry


@contextmanager
def serving(server: ThreadingHTTPServer) -> Iterator[str]:
    """Serve as long as the context lasts; yields the address, which ends without a slash."""
    thread = Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class _Handler(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Log nothing."""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder of wheels while an image is built without a package index; yields the address.

    The classic builder has no mounts, and what is copied into an image stays in its layers. So pip
    gets the wheels over HTTP from this machine, while the build uses this machine's network; only
    programs of this machine reach the server.

    Raises:
        EnvironmentFault: if there are no wheels.
    """
    if not any(folder.glob("*.whl")):
        raise EnvironmentFault(f"--wheelhouse {folder}: there are no wheels (*.whl) in this folder")
    with serving(_server(folder)) as address:
        yield f"{address}/"


def _server(folder: Path) -> ThreadingHTTPServer:
    """At the same port for the same folder, if that is free: the builder caches by address."""
    handler = partial(_Handler, directory=str(folder))
    try:
        port = 20000 + zlib.crc32(bytes(folder.resolve())) % 10000
        return ThreadingHTTPServer(("127.0.0.1", port), handler)
    except OSError:
        return ThreadingHTTPServer(("127.0.0.1", 0), handler)


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
