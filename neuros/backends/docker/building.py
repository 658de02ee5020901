"""Builds the images of recipes with ``docker build``, parents first; current images stay.

Each image is built under a temporary name, and run once to test that it can run nodes. If it
cannot, the recipe ``neuros_python`` is built on top. It gets its own names last. The program
``docker`` chooses the builder: BuildKit where buildx is installed, else the classic one.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import tarfile
import tempfile
import time
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from pathlib import Path
from threading import Thread
from types import MappingProxyType
from typing import IO, Any

from docker import DockerClient
from docker.errors import APIError, ImageNotFound

from neuros.backends.containers import (
    BASE,
    BASE_ARGUMENT,
    Recipe,
    bare_name,
    files_of,
    find_recipe,
    for_all,
    in_order,
)
from neuros.backends.docker.dockerfile import after_each_from, arguments_of, images_in, on_images
from neuros.backends.docker.engine import engine_faults, engine_socket
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
from neuros.installation.progress import Progress, run_logged

CERTIFICATES = "/tmp/neuros-ca-bundle.pem"
"""The user's certificates during a build; they are removed at the end."""

_BASE = "neuros.image.base"
_ARGUMENTS = "neuros.image.arguments"
_FROM = "neuros.image.from"

_CERTIFICATES_IN_CONTEXT = ".neuros-ca-bundle.pem"
_TRUST = ("PIP_CERT", "SSL_CERT_FILE", "REQUESTS_CA_BUNDLE", "CURL_CA_BUNDLE")
_PROXIES = ("HTTP_PROXY", "HTTPS_PROXY", "FTP_PROXY", "NO_PROXY", "ALL_PROXY")
_NOTHING: Mapping[str, str] = MappingProxyType({})
_NO_FILES: Mapping[str, bytes] = MappingProxyType({})

_TEMPORARY = "neuros_building"
"""The repository of unfinished images."""

_TAIL_LINES = 12
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")
_STEP = re.compile(r"step \d|#\d+ \[", re.IGNORECASE)  # of the classic builder, of BuildKit
_SHOWN = re.compile(rf"{_STEP.pattern}|(#\d+ [\d.]+ )?\s*(Collecting|Downloading)", re.IGNORECASE)
_ERROR = re.compile(r"(?:#\d+ [\d.]+ )?(E(?:RROR)?: .*)")

# Causes outside the Dockerfile; the first that fits the output counts.
_CAUSES = (
    (r"no space left on device|\[Errno 28\]", "the disk is full: make room (docker system df)"),
    (
        r"CERTIFICATE_VERIFY_FAILED|x509: certificate",
        "a certificate is not trusted: give your authority's with --ca-bundle FILE",
    ),
    (
        r"(.*(?:requires BuildKit|dockerfile parse error.*unknown (?:flag|instruction)"
        r"|BuildKit is enabled but the buildx component is missing).*)",
        "{}: unless that is a slip of the pen, it takes a newer BuildKit: install docker-buildx"
        " (from docker.com: docker-buildx-plugin; before docker 23: export DOCKER_BUILDKIT=1)",
    ),
    (
        r"(?:Get|Head) \"?https?://([^/\"]+)|lookup (\S+).* no such host",
        "the registry {} cannot be reached: check the network and the engine's proxy, or name an"
        " image that the engine has with --base-image",
    ),
    (
        r"pull access denied for ([^\s,]+)|manifest for (\S+) not found"
        r"|(\S+): pull access denied, repository does not exist"
        r"|failed to resolve source metadata for (\S+):",
        "there is no image {} to begin from: correct the FROM line, or name one that the engine has"
        " with --base-image",
    ),
    (
        r"Temporary failure in name resolution|Temporary failure resolving|NewConnectionError"
        r"|Network is unreachable|Could not resolve|ConnectTimeout|ReadTimeout|ProxyError",
        "the package index cannot be reached: check the network (behind a proxy: export"
        " HTTPS_PROXY=http://HOST:PORT), or build from a folder of wheels with --wheelhouse DIR",
    ),
    (
        r"Permission denied|are you root\?",
        "a step may not write: images of NeuROS run as an ordinary user, so put USER 0 above it",
    ),
)


class Surroundings:
    """Proxies, network, certificates and wheelhouse, which all builds share.

    With a wheelhouse, builds get no proxies and no packages of the operating system.

    Args:
        ca_bundle: a file with further certificates, PEM.
        wheels: the address of a wheelhouse, or "".

    Attributes:
        arguments: build arguments; the engine keeps proxies out of the images' history.
        network: of the build, ``None`` for the engine's default.
        files: for the context of each build.
        lines: for each stage of a Dockerfile.
    """

    def __init__(
        self, engine: DockerClient, environ: Mapping[str, str], ca_bundle: Path | None, wheels: str
    ) -> None:
        names = [name for upper in _PROXIES for name in (upper, upper.lower())]
        proxies = {name: environ[name] for name in names if environ.get(name)}
        is_here = any("127.0.0.1" in url or "localhost" in url for url in proxies.values())
        has_bridge = any(network.name == "bridge" for network in engine.networks.list())
        self.arguments = {"SYSTEM_PACKAGES": "", "WINDOWS": "no"} if wheels else proxies
        self.network = "host" if wheels or is_here or not has_bridge else None
        self.files: dict[str, bytes] = {}
        lines = []
        if ca_bundle:
            self.files[_CERTIFICATES_IN_CONTEXT] = ca_bundle.read_bytes()
            lines.append(f"COPY {_CERTIFICATES_IN_CONTEXT} {CERTIFICATES}")
            lines.append(f"ARG {' '.join(f'{name}={CERTIFICATES}' for name in _TRUST)}")
        if wheels:
            lines.append(f"ARG PIP_NO_INDEX=1 PIP_FIND_LINKS={wheels}")
        self.lines = "\n".join(lines)


@contextlib.contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder of wheels to builds without a package index; yields the address.

    The classic builder has no mounts, and copied files stay in the layers of an image. So pip gets
    the wheels over HTTP from this machine, and the build uses this machine's network. Only
    programs of this machine reach the server.

    Raises:
        EnvironmentFault: if there are no wheels.
    """
    if not any(folder.glob("*.whl")):
        raise EnvironmentFault(f"--wheelhouse {folder}: there are no wheels (*.whl) in this folder")
    handler = partial(_Handler, directory=str(folder))
    try:
        # The builder caches by address, so the same folder has the same port if that is free.
        port = 20000 + zlib.crc32(bytes(folder.resolve())) % 10000
        server = ThreadingHTTPServer(("127.0.0.1", port), handler)
    except OSError:
        server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class _Handler(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Log nothing."""


class ImageBuilder:
    """Builds images, with a line of progress for each.

    Args:
        logs: the folder for the output of ``docker build``.
        bases: base images by container name, in place of those in the Dockerfiles.
        arguments: build arguments for the Dockerfiles that declare them.
        pull: whether to pull the newest version of base images.
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
        """Build the missing and outdated images of these recipes and their parents.

        Raises:
            UsageError: for a base image without use; nothing is built then.
            EnvironmentFault: at the first image that cannot be built; those before it are kept.
        """
        recipes = list(recipes)
        bases: dict[str, str] = {}
        with engine_faults("images cannot be built"):
            for recipe in in_order(recipes):
                old = built_image(recipe, self._engine)
                # The base image of the last time counts again.
                if old and (base := old.labels.get(_BASE)) and recipe.takes(base):
                    bases[recipe.name] = base
        bases |= self._bases
        wanted = in_order(recipes, bases)
        by_name = {recipe.name: recipe for recipe in wanted}
        for name, base in self._bases.items():
            if name not in by_name:
                names = ", ".join(sorted(by_name)) or "none"
                raise UsageError(
                    f"--base-image {name}={base}: no container '{name}' is built here (there are:"
                    f" {names})"
                )
            if not by_name[name].takes(base):
                raise UsageError(
                    f"--base-image {name}={base}: {by_name[name].folder}/Dockerfile does not begin"
                    f" from {BASE_ARGUMENT}: let it begin with 'ARG {BASE_ARGUMENT}=...' and"
                    f" 'FROM ${{{BASE_ARGUMENT}}}', or write the image into its FROM line"
                )
        for recipe in wanted:
            with engine_faults(f"image '{recipe.name}' cannot be built"):
                self._bring_up_to_date(recipe, bases.get(recipe.name, ""))

    def add_to(self, name: str) -> None:
        """Build an image that can run nodes on an image of the user's, unless that can.

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
            with self._builds(name) as builds:
                made, python = builds.able(name)
                if made == name:
                    self._progress.step(f"{name}: can run nodes as it is")
                    return
                labels = {CONTAINER: name, **labels_of_python(python)}
                builds.finish(made, [added_tag(image)], labels)
        took_s = time.monotonic() - started_s
        self._progress.step(
            f"{name}: built {added_tag(image)}, with what nodes need in {took_s:.1f} s"
        )

    def _builds(self, name: str) -> _Builds:
        log = self._logs / f"{name.replace('/', '_')}.log"
        return _Builds(self._engine, self._around, self._progress, name, log)

    def _bring_up_to_date(self, recipe: Recipe, base: str) -> None:
        started_s = time.monotonic()
        old = built_image(recipe, self._engine)
        was = old.labels if old is not None else {}
        parents = recipe.parents_on(base or None)
        if self._pull and not base:
            names = {parent.name for parent in recipe.parents}
            for image in images_in(recipe.dockerfile):
                if bare_name(image) not in names and image != "scratch":
                    self._progress.detail(f"{recipe.name}: pulling {image}")
                    pulled(self._engine, image, newest=True)
        begin: dict[str, Any] = {each.name: built_image(each, self._engine) for each in parents}
        # BuildKit takes an id for a name. Those that a user has given may go at any time.
        names_of_parents = {
            parent.name: next(
                (tag for tag in parent.tags if tag in begin[parent.name].tags),
                begin[parent.name].tags[0],
            )
            for parent in parents
        }
        if base and base not in begin:
            begin[base] = pulled(self._engine, base, newest=self._pull)
        # Arguments of last time count again.
        known = arguments_of(recipe.dockerfile)
        arguments = json.loads(was.get(_ARGUMENTS, "{}"))
        arguments |= {key: value for key, value in self._arguments.items() if key in known}
        labels = {
            CONTAINER: recipe.name,
            FOLDER: str(recipe.folder),
            DIGEST: recipe.digest,
            _BASE: base,
            _ARGUMENTS: json.dumps(arguments, sort_keys=True),
            _FROM: json.dumps({n: image.id for n, image in begin.items()}, sort_keys=True),
        }
        compared = (DIGEST, _BASE, _ARGUMENTS, _FROM)
        if old and not self._pull and all(was.get(key) == labels[key] for key in compared):
            self._progress.step(f"{recipe.name}: up to date, {_size(old)}")
            return
        with self._builds(recipe.name) as builds:
            if base:
                arguments[BASE_ARGUMENT] = names_of_parents.get(base, base)
                if len(parents) < len(recipe.parents):
                    # In place of a recipe's image it has to do what that does: run nodes.
                    arguments[BASE_ARGUMENT] = builds.able(arguments[BASE_ARGUMENT])[0]
            text = on_images(recipe.dockerfile, names_of_parents)
            made, python = builds.able(builds.build(recipe.folder, text, arguments))
            builds.finish(made, recipe.tags, {**labels, **labels_of_python(python)})
        self._forget(recipe, old)
        took_s, new = time.monotonic() - started_s, self._engine.images.get(recipe.tags[0])
        self._progress.step(f"{recipe.name}: built in {took_s:.1f} s, {_size(new)}")

    def _forget(self, recipe: Recipe, old: Any | None) -> None:
        """Remove former images of this folder that are not in use.

        Images on top of ours inherit the labels, so only the names tell ours.
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


def _size(image: Any) -> str:
    return f"{image.attrs['Size'] / 1e6:.0f} MB"


class _Builds:
    """The builds for one image, with one log; its context removes the temporary names.

    Args:
        name: of the image, for messages.
        log: the file for the output of ``docker build``.
    """

    def __init__(
        self, engine: DockerClient, around: Surroundings, progress: Progress, name: str, log: Path
    ) -> None:
        self._engine, self._around, self._progress = engine, around, progress
        self._name, self._log = name, log
        self._temporary: list[str] = []
        self._environ = {**os.environ, "BUILDKIT_PROGRESS": "plain"}
        with contextlib.suppress(EnvironmentFault):
            # The program does not find the socket of a rootless engine by itself.
            self._environ["DOCKER_HOST"] = f"unix://{engine_socket(engine)}"
        log.parent.mkdir(parents=True, exist_ok=True)
        log.unlink(missing_ok=True)

    def __enter__(self) -> _Builds:
        return self

    def __exit__(self, *_: object) -> None:
        for name in self._temporary:
            with contextlib.suppress(APIError):  # failed builds, images in use
                self._engine.images.remove(name, noprune=True)

    def build(
        self, folder: Path | None, dockerfile: str, arguments: Mapping[str, str] = _NOTHING
    ) -> str:
        """Build from the files of ``folder``; returns a temporary name, which BuildKit needs.

        Raises:
            EnvironmentFault: if it fails.
        """
        if self._around.lines:
            dockerfile = after_each_from(dockerfile, self._around.lines)
        name = f"{_TEMPORARY}:{secrets.token_hex(6)}"
        self._temporary.append(name)
        options = ["--tag", name]
        if self._around.network:
            options += ["--network", self._around.network]
        for key, value in {**self._around.arguments, **arguments}.items():
            # Other users of this machine see the arguments of programs, but not the environment.
            is_known = self._environ.get(key) == value
            options += ["--build-arg", key if is_known else f"{key}={value}"]
        self._run(options, dockerfile, folder, self._around.files)
        return name

    def able(self, image: str) -> tuple[str, PythonInImage]:
        """The image if it can run nodes, else a new one with the base on top; and its Python.

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
        made = self.build(base.folder, base.dockerfile, {BASE_ARGUMENT: image, "CONSTRAINTS": ""})
        python = python_in(self._engine, made, self._name)
        if not python.has_rclpy:
            self._temporary.remove(made)
            raise EnvironmentFault(
                f"image '{self._name}': rclpy was installed, but does not load; to see why, run"
                f" docker run --rm --entrypoint {python.path} {made} -c 'import rclpy'"
            )
        return made, python

    def finish(self, image: str, tags: Sequence[str], labels: Mapping[str, str]) -> None:
        """Remove the certificates, and add the labels and names."""
        lines = [f"FROM {image}"]
        if self._around.files:
            user = self._engine.images.get(image).attrs["Config"].get("User") or "0"
            lines += ["USER 0", f"RUN rm -f {CERTIFICATES}", f"USER {user}"]
        options = ["--network", "none"]
        for tag in tags:
            options += ["--tag", tag]
        for key, value in labels.items():
            options += ["--label", f"{key}={value}"]
        self._run(options, "\n".join(lines))

    def _run(
        self,
        options: Sequence[str],
        dockerfile: str,
        folder: Path | None = None,
        further: Mapping[str, bytes] = _NO_FILES,
    ) -> None:
        lines: list[str] = []

        def show(line: str) -> None:
            plain = _COLOURS.sub("", line).rstrip()
            if plain.strip():
                lines.append(plain)
            if _SHOWN.match(plain):
                self._progress.detail(f"{self._name}: {plain.strip()}")

        command = ["docker", "build", "--force-rm", *options, "-"]
        with context_of(folder, dockerfile, further) as context:
            code = run_logged(command, self._log, show, environ=self._environ, given=context)
        if code:
            for line in lines[-_TAIL_LINES:]:
                self._progress.step(f"  {line[:300]}")
            raise EnvironmentFault(
                f"image '{self._name}' cannot be built: {cause_of(lines)} (log: {self._log})"
            )


@contextlib.contextmanager
def context_of(
    folder: Path | None, dockerfile: str, further: Mapping[str, bytes] = _NO_FILES
) -> Iterator[IO[bytes]]:
    """A tar archive with the files of ``folder``, the Dockerfile, and ``further`` files.

    A link becomes its target, which may be outside.
    """
    with tempfile.TemporaryFile() as archive:
        # Some versions of docker recognise an archive only if it is compressed.
        with tarfile.open(fileobj=archive, mode="w:gz", compresslevel=1, dereference=True) as tar:
            for file in files_of(folder) if folder else ():
                if file.name != "Dockerfile" or file.parent != folder:
                    tar.add(file, str(file.relative_to(folder or file)), filter=for_all)
            for name, content in {"Dockerfile": dockerfile.encode(), **further}.items():
                entry = tarfile.TarInfo(name)
                entry.size, entry.mode = len(content), 0o644
                tar.addfile(entry, BytesIO(content))
        archive.seek(0)
        yield archive


def cause_of(lines: Sequence[str]) -> str:
    """Why a build failed, in a sentence with a remedy, else the error as it was printed.

    Args:
        lines: the output of ``docker build``, without colours.
    """
    last = list(lines[-40:])
    for pattern, sentence in _CAUSES:
        for line in last:
            if match := re.search(pattern, line, re.IGNORECASE):
                return sentence.format(next(filter(None, match.groups()), ""))
    begin = max((at for at, line in enumerate(last) if _STEP.match(line)), default=0)
    errors = (match[1] for line in last[begin:] if (match := _ERROR.match(line)))
    return next(errors, last[-1] if last else "docker build does not say why")


def pulled(engine: DockerClient, name: str, *, newest: bool) -> Any:
    """An image of that name, pulled if the engine lacks it or for the ``newest`` version.

    Raises:
        EnvironmentFault: if it cannot be pulled.
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
