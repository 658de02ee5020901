"""Nodes and programs of one machine that are kept apart, by as much as containers do it.

Shared memory of DDS loses every packet in silence between processes of different users, or of
different IPC namespaces. Here, each of these combinations delivers, or it is said what is waited
for. To become another user, and to have namespaces of one's own, takes root.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from launching import Running, start
from outside_asker import PROGRAM

from neuros.backends.domain import choose_domain
from neuros.doctor.checks import PROJECT as IMAGES
from neuros.transport.dds_profile import PROFILES_VARIABLE, RANGE_VARIABLE

pytestmark = pytest.mark.needs("root")

ECHO = Path(__file__).parent / "isolation"
STORING = Path(__file__).parent / "large_packets"
NOBODY = "65534"

# As between two containers: System V IPC and /dev/shm of their own.
OWN_IPC = ("unshare", "--ipc", "--mount", "sh", "-c", 'mount -t tmpfs none /dev/shm; exec "$@"', "")
# May read whatever root has installed, and nothing else that is not its own.
OTHER_USER = (
    *("setpriv", "--reuid", NOBODY, "--regid", NOBODY, "--clear-groups"),
    *("--inh-caps=+dac_read_search", "--ambient-caps=+dac_read_search"),
)
LOCKED_DOWN = ("setpriv", "--no-new-privs", "--inh-caps=-all", "--bounding-set=-all")
# What NeuROS's containers do: IPC of their own, and one folder of the host for /dev/shm in all.
ONE_FOLDER = ("unshare", "--ipc", "--mount", "sh", "-c", 'mount --bind "$0" /dev/shm; exec "$@"')
# Its own loopback interface has to be switched on (SIOCSIFFLAGS with IFF_UP).
OWN_NETWORK = (
    *("unshare", "--net", sys.executable, "-c"),
    "import fcntl, os, socket, struct, sys;"
    "fcntl.ioctl(socket.socket(), 0x8914, struct.pack('16sh14x', b'lo', 1));"
    "os.execvp(sys.argv[1], sys.argv[1:])",
)

APART = {
    "nothing of their own": (),
    "IPC namespaces of their own": OWN_IPC,
    "different users": OTHER_USER,
    "both": (*OWN_IPC, *OTHER_USER),
    "no rights": LOCKED_DOWN,
}


@pytest.fixture(scope="module")
def domain() -> Iterator[int]:
    with choose_domain(None, {}, False) as chosen:
        yield chosen.id


@pytest.fixture
def everybodys() -> Iterator[Path]:
    """A folder that another user can write to, too."""
    folder = Path(tempfile.mkdtemp(prefix="neuros-isolation-"))
    folder.chmod(0o777)
    yield folder
    shutil.rmtree(folder)


@contextlib.contextmanager
def partial(
    nodes: Sequence[str],
    domain: int,
    folder: Path,
    apart: Sequence[str],
    project: Path = IMAGES,
) -> Iterator[Running]:
    """Some nodes of a project, by a launcher of their own that ``apart`` separates from others."""
    chosen = [argument for node in nodes for argument in ("-n", node)]
    arguments = (*chosen, "-d", str(domain), "-o", str(folder / nodes[0]), "--no-placement")
    with start(project, *arguments, cwd=folder, through=apart) as running:
        yield running


@pytest.mark.parametrize("apart", APART.values(), ids=APART)
def test_images_reach_a_node_that_is_kept_apart(
    apart: tuple[str, ...], domain: int, everybodys: Path
) -> None:
    with (
        partial(["eye"], domain, everybodys, apart) as eye,
        partial(["camera"], domain, everybodys, ()) as camera,
    ):
        camera.wait_for("20 images of 921600 bytes have arrived", 60.0)
        assert camera.finish().exit_code == 0
        eye.signal(signal.SIGINT)
        eye.finish()


def test_a_folder_that_all_have_for_dev_shm_carries_the_images(
    domain: int, everybodys: Path
) -> None:
    folder = everybodys / "shm"
    folder.mkdir()
    apart = (*ONE_FOLDER, str(folder))
    watchers = ("lossless", "limited", "best_effort")
    with (
        partial(watchers, domain, everybodys, apart, STORING) as watching,
        partial(["camera"], domain, everybodys, apart, STORING) as camera,
    ):
        camera.wait_for("stores in neuros_", 60.0)
        assert camera.finish().exit_code == 0
        watching.signal(signal.SIGINT)
        watching.finish()
    assert not list(folder.glob("neuros_*"))


def test_between_networks_it_is_said_what_is_waited_for(domain: int, everybodys: Path) -> None:
    with (
        partial(["eye"], domain, everybodys, OWN_NETWORK) as eye,
        partial(["camera"], domain, everybodys, ()) as camera,
    ):
        for running in (eye, camera):
            running.wait_for("connections still waiting for their other end: ", 20.0)
            running.wait_for("camera.image -> eye.image")
            running.signal(signal.SIGINT)
            running.finish()


@pytest.fixture(scope="module")
def echo(domain: int, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    folder = tmp_path_factory.mktemp("echo")
    with start(ECHO, "-d", str(domain), cwd=folder) as running:
        running.wait_for("echo")
        yield
        running.signal(signal.SIGINT)
        assert running.finish().exit_code == 130


@pytest.mark.usefixtures("echo")
@pytest.mark.parametrize(
    ("apart", "discovery"),
    [*((apart, None) for apart in APART.values()), (next(iter(APART.values())), "LOCALHOST")],
)
def test_a_program_that_is_kept_apart_hears_and_is_heard(
    apart: tuple[str, ...], discovery: str | None, domain: int, everybodys: Path
) -> None:
    unwanted = (RANGE_VARIABLE, PROFILES_VARIABLE)
    environment = {key: value for key, value in os.environ.items() if key not in unwanted}
    environment |= {"ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(everybodys)}
    if discovery:
        environment[RANGE_VARIABLE] = discovery
    program = subprocess.run(
        [*apart, sys.executable, "-c", PROGRAM, everybodys.name, "20"],
        env=environment,
        capture_output=True,
        text=True,
        timeout=40,
    )
    assert program.returncode == 0, program.stderr
