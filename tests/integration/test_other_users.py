"""Another user of the machine opens nothing of a run, and hears nothing of an isolated one.

To become another user takes root.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from launching import EXAMPLES, Running, start

from neuros.backends.domain import choose_domain
from neuros.transport.dds_profile import PROFILES_VARIABLE, RANGE_VARIABLE

pytestmark = pytest.mark.needs("root")

NOBODY = 65534
IMAGES = Path(__file__).parent / "large_packets"
CLOCK = EXAMPLES / "1_tick/clock"
BECOME_NOBODY = ("setpriv", "--reuid", str(NOBODY), "--regid", str(NOBODY), "--clear-groups")
# A home folder with this Python that only root can enter is open to the command that follows.
OPEN_HOME = """
mount -t tmpfs none /mnt && mkdir /mnt/upper /mnt/work &&
mount -t overlay -o lowerdir="$0",upperdir=/mnt/upper,workdir=/mnt/work overlay "$0" &&
chmod 755 "$0" && exec "$@"
"""
# Names those of its arguments that it can read, write, or connect to.
READER = """
import os, socket, sys
for path in sys.argv[1:]:
    try:
        socket.socket(socket.AF_UNIX).connect(path)
        print(path)
    except OSError:
        if os.access(path, os.R_OK) or os.access(path, os.W_OK):
            print(path)
"""
# Ends with 0 if it hears a packet, or sees a node.
LISTENER = """
import sys, time
import rclpy
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node("passer_by")
heard = []
node.create_subscription(String, "/neuros/clock/time/display/time/data", heard.append, 10)
end = time.monotonic() + float(sys.argv[1])
while not heard and "clock" not in node.get_node_names():
    if time.monotonic() > end:
        sys.exit("silence")
    rclpy.spin_once(node, timeout_sec=0.1)
"""


def other_user() -> tuple[str, ...]:
    """What makes a command that of an ordinary user without any rights."""
    programs = (Path(sys.executable), Path(sys.executable).resolve())
    folders = {folder for program in programs for folder in program.parents}
    closed = [folder for folder in sorted(folders) if not folder.stat().st_mode & 1]
    opening = ("unshare", "--mount", "sh", "-c", OPEN_HOME, str(closed[0])) if closed else ()
    return (*opening, *BECOME_NOBODY)


@pytest.fixture
def everybodys() -> Iterator[Path]:
    """A folder that another user can write to, too."""
    folder = Path(tempfile.mkdtemp(prefix="neuros-users-"))
    folder.chmod(0o777)
    yield folder
    shutil.rmtree(folder)


def test_another_user_can_open_nothing_of_a_run(everybodys: Path) -> None:
    shared = {*Path("/dev/shm").glob("neuros_*")}  # other programs may have others meanwhile
    previous = os.umask(0)  # the worst there is
    try:
        running = start(IMAGES, "-r", "-m", "-o", "runs/1", cwd=everybodys)
    finally:
        os.umask(previous)
    with running:
        running.wait_for("stores in neuros_", 60.0)
        found = [*(everybodys / "runs").rglob("*")]
        found += {*Path("/dev/shm").glob("neuros_*")} - shared
        names = {path.name for path in found}
        assert {"control.sock", "node.json", "node.log", "project.json", "spool"} <= names
        assert any(name.startswith("neuros_") for name in names)
        assert opened_by_nobody(*found) == []
        run = running.finish(60.0)
    assert run.exit_code == 0, run.output
    assert opened_by_nobody(*(everybodys / "runs/1").rglob("*")) == []


def opened_by_nobody(*paths: Path) -> list[str]:
    """Those that another user can read, write, or connect to."""
    asked = subprocess.run(
        [*other_user(), sys.executable, "-I", "-S", "-c", READER, *map(str, paths)],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    return asked.stdout.splitlines()


def test_keys_are_their_users_alone_in_a_folder_that_all_can_read(everybodys: Path) -> None:
    folder = everybodys / "run"
    folder.mkdir()
    folder.chmod(0o755)
    with start(CLOCK, "-o", str(folder), cwd=everybodys) as running:
        running.wait_for("display")
        assert opened_by_nobody(*folder.glob("*/node.json")) == []
        end(running)


@pytest.mark.parametrize("is_root", [True, False], ids=["root", "an ordinary user"])
def test_an_isolated_run_is_heard_by_nobody_outside(is_root: bool, everybodys: Path) -> None:
    through = () if is_root else other_user()
    with choose_domain(None, {}, False) as domain:
        arguments = ("--isolate", "-d", str(domain.id))
        with start(CLOCK, *arguments, cwd=everybodys, through=through) as running:
            running.wait_for("[display]: ", 60.0)
            assert listen(domain.id, 4.0, everybodys) == "silence"
            end(running)


def test_a_run_that_is_not_isolated_is_heard(everybodys: Path) -> None:
    """The listener of the test before does hear."""
    with (
        choose_domain(None, {}, False) as domain,
        start(CLOCK, "-d", str(domain.id), cwd=everybodys) as running,
    ):
        running.wait_for("[display]: ", 60.0)
        assert listen(domain.id, 20.0, everybodys) == ""
        end(running)


def test_where_no_network_can_be_had_it_is_said(everybodys: Path) -> None:
    no_namespaces = ("--no-new-privs", "--bounding-set=-sys_admin", "--inh-caps=-sys_admin")
    with start(CLOCK, "--isolate", cwd=everybodys, through=("setpriv", *no_namespaces)) as running:
        run = running.finish()
    assert run.exit_code == 4
    assert "--isolate: the run gets no network here (Operation not permitted)" in run.output
    assert "Traceback" not in run.output


def listen(domain: int, seconds: float, logs: Path) -> str:
    """What another user's ROS program complains of."""
    unwanted = (RANGE_VARIABLE, PROFILES_VARIABLE)
    environment = {key: value for key, value in os.environ.items() if key not in unwanted}
    environment |= {"ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(logs)}
    done = subprocess.run(
        [*other_user(), sys.executable, "-c", LISTENER, str(seconds)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode in (0, 1), done.stderr
    return done.stderr.strip()


def end(running: Running) -> None:
    running.signal(signal.SIGINT)
    assert running.finish().exit_code == 130
