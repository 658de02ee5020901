"""Docker engines of a test's own: on another machine, on a small disk, or to be killed."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from deadlines import wait_until
from docker import DockerClient
from machines import Machine, require_machines
from needs import cannot_run

from containers import connected, require_containers
from neuros.backends.docker.engine import connect
from neuros.errors import EnvironmentFault

_SOON_S = 30.0


class OwnEngine:
    """A daemon on a machine, with its data on a disk in memory that goes with that machine.

    Attributes:
        address: what ``DOCKER_HOST`` is to be.
    """

    def __init__(self, machine: Machine, folder: Path, disk: str) -> None:
        self.address = f"unix://{folder / 'docker.sock'}"
        self._machine, self._folder = machine, folder
        self._daemon: subprocess.Popen[bytes] | None = None
        (folder / "data").mkdir()
        machine.run("mount", "-t", "tmpfs", "-o", f"size={disk}", "tmpfs", str(folder / "data"))

    @property
    def data(self) -> Path:
        """The folder with its data, as it is reached from this machine."""
        return Path(f"/proc/{self._machine.pid}/root{self._folder}/data")

    def start(self) -> None:
        """Start the daemon, and wait until it answers."""
        folder = self._folder
        options = {
            "host": self.address,
            "data-root": folder / "data",
            "exec-root": folder / "exec",
            "pidfile": folder / "pid",
            "iptables": "false",
            "bridge": "none",
        }
        with (folder / "log").open("ab") as log:
            self._daemon = subprocess.Popen(
                [
                    *self._machine.inside(),
                    *("setpriv", "--pdeathsig", "TERM"),  # it ends with this process
                    *("dockerd", *(f"--{name}={value}" for name, value in options.items())),
                ],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        wait_until(self._answers, _SOON_S)

    def connect(self) -> DockerClient:
        """A client, which the caller closes."""
        return connect({"DOCKER_HOST": self.address})

    @property
    def pid(self) -> int:
        """Of the daemon."""
        assert self._daemon is not None
        return self._daemon.pid

    def kill(self) -> None:
        """End the daemon with SIGKILL; its containers run on."""
        assert self._daemon is not None
        self._daemon.kill()
        self.await_end()

    def await_end(self) -> None:
        """Wait until the daemon has ended, which was told to, and all that would be in the way."""
        assert self._daemon is not None
        self._daemon.wait(_SOON_S)
        wait_until(lambda: not self._has_containerd())

    def stop(self) -> None:
        """End the daemon, and its containers with it."""
        if self._daemon is not None and self._daemon.poll() is None:
            self._daemon.terminate()
            self._daemon.wait(_SOON_S)

    def _has_containerd(self) -> bool:
        try:
            pid = (self._folder / "exec/containerd/containerd.pid").read_text()
        except FileNotFoundError:
            return False
        return Path("/proc", pid).exists()

    def _answers(self) -> bool:
        assert self._daemon is not None
        if self._daemon.poll() is not None:
            raise RuntimeError((self._folder / "log").read_text()[-2000:])
        try:
            self.connect().close()
        except EnvironmentFault:
            return False
        return True


@contextmanager
def own_engine(
    machine: Machine, *, disk: str = "1g", has_images: bool = True
) -> Iterator[OwnEngine]:
    """An engine at work, with the images of the engine for tests; it is ended in the end."""
    folder = Path(tempfile.mkdtemp(prefix="neuros-engine-"))  # short: it holds sockets
    engine = OwnEngine(machine, folder, disk)
    try:
        if has_images:
            _lend_images(engine.data)
        engine.start()
        yield engine
    finally:
        engine.stop()
        machine.run("umount", str(folder / "data"))
        shutil.rmtree(folder, ignore_errors=True)


def require_engines(*images: str) -> None:
    """Skip the test where it cannot have engines of its own with these images; in CI it has to."""
    require_containers(*images)
    require_machines()
    if shutil.which("dockerd") is None:
        cannot_run("dockerd")
    if not (_lender() / "overlay2").is_dir():
        cannot_run("an engine that keeps its images as the storage driver overlay2 does")


def _lender() -> Path:
    """The data of the engine for tests."""
    with connected() as engine:
        return Path(engine.info()["DockerRootDir"])


def _lend_images(folder: Path) -> None:
    """Let a daemon that has not yet run have the images of the engine for tests, in no time.

    ``docker save | docker load`` takes half a minute. Layers never change, so links to them do.
    """
    lender = _lender()
    _copy_what_stays(lender / "image", folder / "image")
    layers = folder / "overlay2"
    layers.mkdir(mode=0o710)
    for layer in (lender / "overlay2").iterdir():
        if layer.name == "l":  # short names, as links
            _copy_what_stays(layer, layers / "l")
        else:
            (layers / layer.name).symlink_to(layer)


def _copy_what_stays(source: Path, target: Path) -> None:
    """Copy a folder, but for what vanishes meanwhile: other tests end their containers."""
    try:
        shutil.copytree(source, target, symlinks=True)
    except shutil.Error as error:
        if any(os.path.lexists(file) for file, _, _ in error.args[0]):
            raise
