"""Input of one image build: files, Dockerfile, arguments, network, wheels."""

from __future__ import annotations

import io
import tarfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from types import MappingProxyType

from docker import DockerClient

from neuros.backends.docker.recipes import files_of
from neuros.errors import EnvironmentFault

CERTIFICATES = "/tmp/neuros-ca-bundle.pem"
"""Where a build finds the certificates that the user gives; it is taken away at the end."""

_CERTIFICATES_IN_CONTEXT = ".neuros-ca-bundle.pem"
_TRUST = ("PIP_CERT", "SSL_CERT_FILE", "REQUESTS_CA_BUNDLE", "CURL_CA_BUNDLE")
_PROXIES = ("HTTP_PROXY", "HTTPS_PROXY", "FTP_PROXY", "NO_PROXY", "ALL_PROXY")
_NOTHING: Mapping[str, str] = MappingProxyType({})
_NO_FILES: Mapping[str, bytes] = MappingProxyType({})


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
            if file.name != "Dockerfile" or file.parent != folder:
                tar.add(file, str(file.relative_to(folder or file)), filter=_anonymous)
        for name, content in {"Dockerfile": dockerfile.encode(), **further}.items():
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
