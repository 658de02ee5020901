"""Runs in containers, as a user starts them: what a node may and sees there, and how it ends."""

from __future__ import annotations

import json
import os
import re
import secrets
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from container_bench import HOLDS_THE_GIL, ContainerBench, container_bench
from deadlines import wait_until
from endings import GONE_WITHIN_S, RUNS
from launching import EXAMPLES, Finished, Running, launch, start
from virtual_display import virtual_display

from containers import require_containers
from neuros.backends.control_sockets import SOCKET_NAME
from neuros.backends.docker.engine import engine_socket
from neuros.backends.docker.launcher import Containers, DockerLauncher
from neuros.backends.docker.settings import container_name, shared_memory
from neuros.backends.run_processes import RUN_ID
from neuros.backends.sessions import RunOnThisMachine
from neuros.errors import EnvironmentFault
from neuros.ports import NodeProgram
from neuros.project.load import load_project
from neuros.project.model import Folders
from neuros.project.split import split
from neuros.transport.dds_profile import LOCAL_PROFILES, PROFILES

DRAWS = """
from neuros.visualise import VisualiseLines

@neuros_initialise()
def draw(node):
    figure = VisualiseLines("speed of light")
    figure.add_line("c")
    figure.plot("c", 1.0, 0.0)
    node.set_user_data(figure)

@neuros_tick(seconds=0.1)
def live(node):
    pass
"""
LOOKS = """
@neuros_initialise()
def look(node):
    status = pathlib.Path("/proc/self/status").read_text()
    facts = dict(line.split(":", 1) for line in status.splitlines())
    def writes(path):
        try:
            pathlib.Path(path).touch()
        except OSError as error:
            return error.strerror
        return "yes"
    seen = {
        "user": [os.getuid(), os.getgid()],
        "capabilities": [int(facts[key], 16) for key in ("CapEff", "CapPrm", "CapBnd")],
        "no new privileges": facts["NoNewPrivs"].strip(),
        "writes": {p: writes(p) for p in ("/x", "/neuros/project/x", "/neuros/workspace/x",
                                          str(node.run_dir / "node.json"), "/tmp/x",
                                          str(node.run_dir / "x"), "x")},
        "engine": os.path.exists("/var/run/docker.sock"),
        "environment": dict(os.environ),
        "folder": os.getcwd(),
        "cores": sorted(os.sched_getaffinity(0)),
        "file": os.environ["FILE"] and open(os.environ["FILE"]).read(),
        "device": os.path.exists("/dev/net/tun"),
        "init": open("/proc/1/cmdline").read(),
    }
    (node.run_dir / "seen.json").write_text(json.dumps(seen))
    node.shutdown("seen")
"""
NEEDS_MEMORY = """
@neuros_tick(seconds=0.1)
def grow(node):
    node.set_user_data(bytearray(400 << 20))
"""
INTRUDES = """
@neuros_tick(seconds=0.05)
def intrude(node):
    if not (node.run_dir.parent / "b/up").exists():
        return
    def answer(action, *paths):
        try:
            action(*paths)
        except OSError as error:
            return errno.errorcode[error.errno]
        return "done"
    run = node.run_dir.parent
    tries = {
        "overwrite": answer((run / "b/node.json").write_text, "{}"),
        "remove": answer(os.remove, run / "b/node.json"),
        "add": answer((run / "b/x").touch),
        "move": answer(os.rename, run / "b", run / "c"),
        "project": answer((run / "project.json").write_text, "{}"),
        "own": answer((node.run_dir / "x").touch),
        "run folder": answer((run / "x").touch),
    }
    node.shutdown(json.dumps(tries))
"""
FAILS_AT_ITS_END = """
@neuros_initialise()
def leave(node):
    node.shutdown("done")
@neuros_finalise()
def fail(node):
    raise OSError(__file__)
"""
WRITES = """
@neuros_tick(seconds=0.1)
def write(node):
    open("/usr/log", "w")
"""


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[ContainerBench]:
    require_containers()
    with container_bench(tmp_path) as bench:
        yield bench


def last_line(finished: Finished) -> str:
    return finished.said("neuros")[-1]


# ------------------------------------------------------------------ what a node may


def test_isolated_containers_have_a_network_of_their_own(bench: ContainerBench) -> None:
    arguments = ("--backend", "docker", "--isolate")
    with start(EXAMPLES / "1_tick/clock", *arguments, cwd=bench.folder) as running:
        running.wait_for("[display]: ", 30.0)
        run = bench.session(running).run
        found = bench.engine.containers.list(filters={"label": f"neuros.run={run}"})
        interfaces = {c.exec_run(["ls", "/sys/class/net"]).output.decode() for c in found}
        modes = sorted(each.attrs["HostConfig"]["NetworkMode"] for each in found)
        running.signal(signal.SIGINT)
        assert running.finish().exit_code == 130
    assert len(found) == 2
    assert interfaces == {"lo\n"}
    assert modes[0].startswith("container:")
    assert modes[1] == "none"


def test_a_container_is_locked_down(bench: ContainerBench, monkeypatch: pytest.MonkeyPatch) -> None:
    (bench.folder / "file").write_text("hello")
    bench.project(
        {"a": LOOKS},
        a={
            "environment": {"FILE": "#file", "MINE": 1},
            "affinity": [min(os.sched_getaffinity(0))],
            "resources": {"memory": "300m", "cpus": 0.5, "pids": 100},
        },
    )
    monkeypatch.setenv("SECRET_OF_THE_USER", "1")
    monkeypatch.setenv("LANG", "C.UTF-8")
    finished = bench.launch()
    assert finished.exit_code == 0, finished.output
    assert finished.run_folder is not None
    seen = json.loads((finished.run_folder / "a/seen.json").read_text())
    assert seen["user"] == [os.getuid(), os.getgid()]
    assert seen["capabilities"] == [0, 0, 0]
    assert seen["no new privileges"] == "1"
    refused = {path for path, answer in seen["writes"].items() if answer != "yes"}
    assert refused == {
        "/x",
        "/neuros/project/x",
        "/neuros/workspace/x",
        "/neuros/run/a/node.json",
    }
    assert (finished.run_folder / "x").exists(), "the current folder is the run folder"
    assert seen["folder"] == "/neuros/run"
    assert not seen["engine"]
    environment = seen["environment"]
    assert "SECRET_OF_THE_USER" not in environment
    assert environment["LANG"] == "C.UTF-8"
    assert environment["MINE"] == "1"
    assert environment["FILE"] == "/neuros/project/file"
    assert seen["file"] == "hello"
    assert seen["cores"] == [min(os.sched_getaffinity(0))]
    assert not seen["device"]
    assert "init" in seen["init"]


def test_a_node_writes_nothing_of_another_nodes_nor_of_the_runs(bench: ContainerBench) -> None:
    up = "@neuros_initialise()\ndef up(node):\n    (node.run_dir / 'up').touch()\n"
    bench.project({"a": INTRUDES, "b": RUNS + up})
    finished = bench.launch()
    assert finished.exit_code == 0, finished.output
    said = last_line(finished).partition("a ended the project: ")[2]
    assert json.loads(said) == {
        **dict.fromkeys(("overwrite", "remove", "add", "project"), "EROFS"),
        "move": "EBUSY",
        **dict.fromkeys(("own", "run folder"), "done"),
    }
    assert finished.run_folder is not None
    assert json.loads((finished.run_folder / "b/node.json").read_text())["node"]["name"] == "b"
    assert bench.has_saved("a", "b")


def test_a_node_gets_the_device_that_it_asks_for(bench: ContainerBench) -> None:
    if not Path("/dev/net/tun").exists():
        pytest.skip("there is no device here to let a container in to")
    bench.project({"a": LOOKS}, a={"devices": ["/dev/net/tun"], "environment": {"FILE": ""}})
    finished = bench.launch()
    assert finished.run_folder is not None, finished.output
    assert json.loads((finished.run_folder / "a/seen.json").read_text())["device"]


def test_settings_of_dds_of_the_users_own_hold_inside(
    bench: ContainerBench, tmp_path_factory: pytest.TempPathFactory
) -> None:
    own = tmp_path_factory.mktemp("home") / "dds.xml"
    own.write_text(LOCAL_PROFILES.read_text())
    bench.project({"a": LOOKS}, a={"environment": {"FILE": "/neuros/fast_dds.xml"}})
    finished = bench.launch(FASTRTPS_DEFAULT_PROFILES_FILE=str(own))
    assert finished.run_folder is not None, finished.output
    seen = json.loads((finished.run_folder / "a/seen.json").read_text())
    assert seen["environment"]["FASTRTPS_DEFAULT_PROFILES_FILE"] == "/neuros/fast_dds.xml"
    assert seen["file"] == own.read_text()


def test_settings_of_dds_that_a_run_inherits_from_a_run_are_none(bench: ContainerBench) -> None:
    bench.project({"a": LOOKS}, a={"environment": {"FILE": ""}})
    finished = bench.launch(FASTRTPS_DEFAULT_PROFILES_FILE=str(PROFILES))
    assert finished.run_folder is not None, finished.output
    seen = json.loads((finished.run_folder / "a/seen.json").read_text())
    assert seen["environment"]["FASTRTPS_DEFAULT_PROFILES_FILE"].endswith("fast_dds_local.xml")


def test_a_display_that_is_not_there_is_said(bench: ContainerBench) -> None:
    bench.project({"a": RUNS}, a={"display": True})
    finished = bench.launch("--duration", "0.1", DISPLAY="")
    assert finished.exit_code == 0, finished.output
    assert "no windows of a: DISPLAY is not set" in finished.said("neuros")


def test_a_figure_has_a_window_on_the_display_that_may_be_closed(bench: ContainerBench) -> None:
    bench.project({"a": DRAWS}, a={"display": True})
    with virtual_display() as user:
        running = bench.start(DISPLAY=user.display)
        user.close(user.find("speed of light"))
        running.signal(signal.SIGINT)
        finished = running.finish(30.0)
    assert finished.exit_code == 130, finished.output
    assert finished.run_folder is not None
    assert "no window" not in finished.output
    assert (finished.run_folder / "a" / "speed_of_light.png").stat().st_size > 0


def test_a_script_runs_first_inside(bench: ContainerBench) -> None:
    script = bench.folder / "before"
    script.write_text("#!/usr/bin/env python3\nprint('a script in Python')\n")
    script.chmod(0o755)
    bench.project({"a": LOOKS}, a={"script": "before", "environment": {"FILE": ""}})
    finished = bench.launch()
    assert finished.exit_code == 0, finished.output
    assert "a script in Python" in finished.output


@pytest.mark.needs("root")
def test_an_ordinary_user_of_the_engine_leaves_files_of_nobody_else(bench: ContainerBench) -> None:
    uid, group = 1000, os.stat(engine_socket(bench.engine)).st_gid
    # May read what root has installed, and use the engine; nothing else that is not its own.
    ordinary = (
        *("setpriv", f"--reuid={uid}", f"--regid={uid}", f"--groups={group}"),
        *("--inh-caps=-all,+dac_read_search", "--ambient-caps=+dac_read_search"),
    )
    bench.project({"a": RUNS})
    os.chown(bench.folder, uid, uid)
    arguments = ("--backend", "docker", "--duration", "0.2")
    with start(
        bench.folder, *arguments, cwd=bench.folder, through=ordinary, HOME=str(bench.folder)
    ) as running:
        finished = running.finish(30.0)
    assert finished.exit_code == 0, finished.output
    assert bench.has_saved("a")
    assert finished.run_folder is not None
    owners = {path.stat().st_uid for path in finished.run_folder.rglob("*")}
    assert owners == {uid}


# ------------------------------------------------------------------ how it ends


def test_a_node_that_needs_too_much_memory_is_named_with_its_limit(bench: ContainerBench) -> None:
    bench.project({"a": NEEDS_MEMORY, "b": RUNS}, a={"resources": {"memory": "200m"}})
    finished = bench.launch()
    assert finished.exit_code == 1, finished.output
    assert re.fullmatch(r"node 'a' .*: out of memory \(limit 200m\)", last_line(finished))


def test_what_a_node_may_not_write_is_named_as_it_is_called_here(bench: ContainerBench) -> None:
    bench.project({"a": WRITES})
    finished = bench.launch()
    assert finished.exit_code == 1, finished.output
    assert "Read-only file system: '/usr/log'" in last_line(finished)
    assert str(bench.folder / "a.py") in finished.output
    assert finished.record["reason"] == last_line(finished)


@pytest.mark.parametrize("plugin", [WRITES, FAILS_AT_ITS_END], ids=["running", "at its end"])
def test_what_ended_a_run_is_said_once(bench: ContainerBench, plugin: str) -> None:
    bench.project({"a": plugin, "b": RUNS})
    finished = bench.launch()
    assert finished.exit_code == 1, finished.output
    said = [text for text in finished.said("neuros") if "'a' failed" in text]
    assert said == [last_line(finished)]
    assert "/neuros/project" not in finished.output


def test_a_node_that_is_killed_ends_the_others_properly(bench: ContainerBench) -> None:
    bench.project({"a": RUNS, "b": RUNS})
    running = bench.start_and_wait("a", "b")
    bench.kill(running, "a", signal.SIGKILL)
    finished = running.finish(10.0)
    assert finished.exit_code == 1
    # Its last report may have been made while its hook ran.
    seen = "(, last seen executing 'beat')?"
    why = f"node 'a' ended unexpectedly{seen}: killed by SIGKILL"
    assert re.fullmatch(why, last_line(finished))
    assert bench.has_saved("b")


@pytest.mark.parametrize("plugin", [RUNS, HOLDS_THE_GIL], ids=["busy", "holding the GIL"])
def test_when_the_launcher_is_killed_no_container_outlives_it_by_six_seconds(
    bench: ContainerBench, plugin: str
) -> None:
    bench.project({"a": plugin, "b": RUNS})
    running = bench.start_and_wait("a", "b")
    running.signal(signal.SIGKILL)
    running.process.wait()
    wait_until(lambda: not bench.left(), GONE_WITHIN_S)
    assert bench.has_saved("b") or bench.has_saved("a", "b")


def test_no_paused_container_outlives_a_killed_launcher_either(bench: ContainerBench) -> None:
    bench.project({"a": RUNS, "b": RUNS})
    running = bench.start_and_wait("a", "b")
    pause(bench, running)
    running.signal(signal.SIGKILL)
    running.process.wait()
    wait_until(lambda: not bench.left(), GONE_WITHIN_S)
    assert bench.has_saved("a", "b"), "it was resumed, and ended by itself"


@pytest.mark.acceptance
def test_killed_together_with_its_guardian_what_is_left_goes_with_the_next_run(
    bench: ContainerBench,
) -> None:
    bench.project({"a": RUNS})
    running = bench.start_and_wait("a")
    session = bench.session(running)
    for pid in (guardian_of(session), running.process.pid):
        os.kill(pid, signal.SIGKILL)
    running.process.wait()
    memory, control = shared_memory(session.run), Path(session.folder, SOCKET_NAME)
    wait_until(lambda: set(bench.left()) == {str(memory), str(control)}, GONE_WITHIN_S)
    bench.launch("--duration", "0.1")
    control.unlink()  # in the run folder, which is the user's
    assert bench.left() == []


def test_also_when_it_is_killed_while_it_starts_them(bench: ContainerBench) -> None:
    bench.project(dict.fromkeys("abcd", RUNS))
    running = bench.start()
    running.wait_for("run folder", 15.0)
    wait_until(lambda: bench.left())
    running.signal(signal.SIGKILL)
    running.process.wait()
    wait_until(lambda: not bench.left(), GONE_WITHIN_S)


def test_a_container_that_somebody_else_stops_is_named_and_why(bench: ContainerBench) -> None:
    bench.project({"a": RUNS, "b": RUNS})
    running = bench.start_and_wait("a", "b")
    run = bench.session(running).run
    (container,) = bench.engine.containers.list(
        filters={"label": [f"neuros.run={run}", "neuros.node=a"]}
    )
    container.stop()
    finished = running.finish(10.0)
    assert finished.exit_code == 1
    assert "node 'a' ended unexpectedly: exit code 0: the Docker engine stopped it" in last_line(
        finished
    )
    assert bench.has_saved("a", "b")


# ------------------------------------------------------------------ what cannot be started


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"container": "no_such_image"}, "no_such_image"),
        ({"container": "../images"}, "the engine has no image of that name"),
        ({"resources": {"cpus": 4096}}, "node 'a' cannot be started: .*CPUs"),
        ({"devices": ["/dev/no_such_thing"]}, "node 'a' asks for the device /dev/no_such_thing"),
    ],
    ids=["image", "no name of an image", "cpus", "device"],
)
def test_what_is_not_there_is_said_in_one_sentence(
    bench: ContainerBench, keys: dict[str, object], sentence: str
) -> None:
    bench.project({"a": RUNS, "b": RUNS}, a=keys)
    finished = bench.launch()
    assert finished.exit_code == 4, finished.output
    (line,) = [line for line in finished.output.splitlines() if line.startswith("neuros: ")]
    assert re.search(sentence, line)
    assert "Traceback" not in finished.output
    assert bench.left() == []


def test_without_an_engine_auto_is_process_and_says_why(bench: ContainerBench) -> None:
    bench.project({"a": RUNS})
    nowhere = {"DOCKER_HOST": f"unix://{bench.folder}/no.sock"}
    finished = launch(
        bench.folder, "--backend", "auto", "--duration", "0.2", cwd=bench.folder, **nowhere
    )
    assert finished.exit_code == 0, finished.output
    assert finished.record["backend"] == "process"
    (why,) = [text for text in finished.said("neuros") if "not in a container" in text]
    assert "no Docker engine answers" in why
    refused = launch(bench.folder, "--backend", "docker", cwd=bench.folder, **nowhere)
    assert refused.exit_code == 4
    assert "no Docker engine answers" in refused.output


def test_with_an_engine_and_the_images_auto_is_docker(bench: ContainerBench) -> None:
    bench.project({"a": RUNS})
    finished = launch(
        bench.folder, "--backend", "auto", "--duration", "0.2", cwd=bench.folder, timeout_s=30.0
    )
    assert finished.exit_code == 0, finished.output
    assert finished.record["backend"] == "docker"


def test_a_name_that_is_taken_is_said_and_nothing_is_left(
    bench: ContainerBench, tmp_path: Path
) -> None:
    bench.project({"a": RUNS, "b": RUNS})
    project = load_project(tmp_path, workspace=tmp_path).project
    run_id, (a, b) = secrets.token_hex(8), split(project, lambda _: Folders(*[tmp_path] * 3))
    for node in (a, b):
        (tmp_path / node.node.name).mkdir()
        (tmp_path / node.node.name / "node.json").touch()
    containers = Containers([a.node, b.node], tmp_path)
    launcher = DockerLauncher(containers, NodeProgram())
    taken = containers.engine.containers.create(
        containers.images["neuros_python"].id, ["true"], name=container_name(b, run_id)
    )
    try:
        with pytest.raises(EnvironmentFault, match="already in use"):
            launcher.start([a, b], {RUN_ID: run_id})
        wait_until(lambda: not bench.left())
    finally:
        taken.remove()
        containers.engine.close()
        shared_memory(run_id).rmdir()


# ------------------------------------------------------------------ packets


def test_whiskeye_runs_in_three_different_containers(bench: ContainerBench) -> None:
    require_containers("neuros_python", "neuros_mujoco", "neuros_nest")
    finished = launch(
        EXAMPLES / "4_neurorobotics/whiskeye/strict.json",
        *("--backend", "docker", "--duration", "1sim"),
        cwd=bench.folder,
        timeout_s=60.0,
    )
    assert finished.exit_code == 0, finished.output
    for counters in finished.record["connections"]:
        assert counters["sent"] == counters["consumed"] == 50
    assert finished.run_folder is not None
    picture = finished.run_folder / "visualiser/head_direction.png"
    assert picture.exists()
    assert f"picture: {picture}" in finished.output, "as it is called here"


# ------------------------------------------------------------------ sessions


def test_ps_shows_a_run_and_stop_ends_it(bench: ContainerBench) -> None:
    bench.project({"a": RUNS, "b": RUNS})
    running = bench.start_and_wait("a", "b")
    run = bench.session(running).run
    rows = [line.split() for line in neuros("ps").splitlines() if line.startswith(run[:8])]
    # Counted from the end: a column names the users where others have runs, too.
    assert [(row[-5], row[-4], row[-1]) for row in rows] == [
        ("a", "docker", "running"),
        ("b", "docker", "running"),
    ]
    (container,) = bench.engine.containers.list(
        filters={"label": [f"neuros.run={run}", "neuros.node=a"]}
    )
    assert container.labels["neuros.project"] == str(bench.folder)
    assert f"stopped {run[:8]}" in neuros("stop", run[:8])
    finished = finish_stopped(running)
    assert finished.exit_code == 130
    assert bench.has_saved("a", "b")


def neuros(*arguments: str) -> str:
    return subprocess.run(
        [sys.executable, "-m", "neuros.cli", *arguments],
        check=True,
        capture_output=True,
        text=True,
        timeout=30.0,
    ).stdout


def pause(bench: ContainerBench, running: Running) -> None:
    """Pause all containers of a run."""
    run = bench.session(running).run
    for container in bench.engine.containers.list(filters={"label": f"neuros.run={run}"}):
        container.pause()


def guardian_of(session: RunOnThisMachine) -> int:
    """The number of the process that was started with the id of the run, and is no fork."""
    (guardian,) = [
        process
        for process in psutil.process_iter(["cmdline"])
        if process.info["cmdline"] and process.info["cmdline"][-1] == session.run
    ]
    return int(guardian.pid)


def finish_stopped(running: Running) -> Finished:
    """It has ended already, as `stop` waits for that."""
    return running.finish(3.0)
