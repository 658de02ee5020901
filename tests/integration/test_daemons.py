"""A daemon that a node leaves ends with the run, however that ends.

It is started as daemons are: fork, setsid, fork, with an empty environment. So neither its parent,
its session nor its environment tells whose it is.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from deadlines import wait_until

from tests.support.launching import Running, start

DAEMON = """
import os, sys
marked, marking = os.pipe()
if os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        open(os.path.join(os.environ["MARK"], str(os.getpid())), "w").close()
        os.closerange(0, 100)
        os.open("/dev/null", os.O_RDWR)
        os.chdir("/")
        os.execve("/bin/sleep", ["sleep", "98765"], {})
    os._exit(0)
os.close(marking)
os.read(marked, 1)  # the daemon has left its mark, and closed its end
os.wait()
"""
PLUGIN = """
import os, signal, subprocess, sys
from neuros.hooks import neuros_initialise, neuros_tick
@neuros_initialise()
def begin(node):
    subprocess.run([sys.executable, "-S", "-c", DAEMON], check=True)
    print("begun", flush=True)
@neuros_tick(seconds=0.05)
def act(node):
    LAST_ACT
"""
# What a node does when it has begun, and the signals that its launcher gets.
ENDS: dict[str, tuple[str, int | None]] = {
    "the end that it asks for": ("node.shutdown('done')", None),
    "its failure": ("raise ValueError", None),
    "its own death": ("os.kill(os.getpid(), signal.SIGKILL)", None),
    "Ctrl+C": ("pass", signal.SIGINT),
    "a launcher that is killed": ("pass", signal.SIGKILL),
}


@pytest.fixture
def marks(tmp_path: Path) -> Iterator[Path]:
    """Where each daemon leaves a file that its number names."""
    folder = tmp_path / "marks"
    folder.mkdir()
    yield folder
    for pid in _daemons(folder):
        os.kill(pid, signal.SIGKILL)


def _daemons(marks: Path) -> list[int]:
    return [int(file.name) for file in marks.iterdir() if _is_daemon(int(file.name))]


def _is_daemon(pid: int) -> bool:
    try:
        return b"98765" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def _start(tmp_path: Path, marks: Path, plugin: str, backend: str, script: str = "") -> Running:
    project = tmp_path / "project"
    project.mkdir()
    (project / "plugin.py").write_text(plugin)
    node = {"name": "a", "container": "neuros_python", "plugin": "plugin.py"}
    if script:
        (project / "prepare.sh").write_text(script)
        node["script"] = "prepare.sh"
    (project / "project.json").write_text(json.dumps({"nodes": [node]}))
    return start(project, "--backend", backend, cwd=tmp_path, MARK=str(marks))


@pytest.mark.parametrize(
    ("backend", "end"),
    [*(("process", end) for end in ENDS), ("in-process", "a launcher that is killed")],
)
def test_a_daemon_ends_with_the_run(tmp_path: Path, marks: Path, backend: str, end: str) -> None:
    last_act, number = ENDS[end]
    plugin = PLUGIN.replace("DAEMON", repr(DAEMON)).replace("LAST_ACT", last_act)
    with _start(tmp_path, marks, plugin, backend) as running:
        running.wait_for("begun")
        assert [*marks.iterdir()]
        if number is not None:
            running.signal(number)
        running.finish()
        # The guardian of a launcher that was killed gives nodes 4.5 s, and kills what is left.
        wait_until(lambda: not _daemons(marks), 6.0 if number == signal.SIGKILL else 0.0)


def test_a_daemon_of_a_script_ends_with_the_run(tmp_path: Path, marks: Path) -> None:
    plugin = PLUGIN.replace("DAEMON", "'pass'").replace("LAST_ACT", "node.shutdown('done')")
    script = f"exec {sys.executable} -S - <<'END'\n{DAEMON}\nEND\n"
    with _start(tmp_path, marks, plugin, "process", script) as running:
        assert running.finish().exit_code == 0
        assert [*marks.iterdir()]
        assert not _daemons(marks)
