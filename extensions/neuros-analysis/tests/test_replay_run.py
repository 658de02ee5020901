"""``neuros replay RUN`` on real runs: every node again, in parallel, and one table at the end."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from commands import neuros
from deadlines import wait_until
from launching import BACKENDS, EXAMPLES, launch, start
from processes import is_alive, processes_of
from recordings import flushed
from replaying import MIXER, Recorded, copied, node, record, replay, wire, write_project

DEADLINE_S = 120.0

# Its hooks see the world at moments that only the wall clock decides.
PHYSICS = """\
from neuros.hooks import neuros_function, neuros_initialise, neuros_tick
from neuros.simulators.mujoco import MuJoCo

WORLD = '''<mujoco><option timestep="0.001"/><worldbody><body name="b">
<joint name="j" type="hinge" axis="0 1 0" pos="0 0 .2"/><geom type="capsule" size=".02 .2"/></body>
</worldbody><actuator><motor name="m" joint="j"/></actuator>
<sensor><jointpos name="angle" joint="j"/></sensor></mujoco>'''


@neuros_initialise()
def begin(node):
    sim = MuJoCo(node, WORLD)
    node.set_user_data(sim)
    sim.run_asynchronous(2.0)


@neuros_function(inputs="push")
def obey(node, push):
    node.get_user_data().actuate("m", push.data)


@neuros_tick(0.003, outputs="seen")
def look(node):
    sim = node.get_user_data()
    with sim.paused():
        angle = float(sim.data.qpos[0])
    seen = node.make_packet("seen")
    seen.data = angle + sim.sim_time + node.now().nanosec
    if sim.sim_time > 0.5:
        node.shutdown("enough")
    return seen
"""
PUSHER = """\
from neuros.hooks import neuros_function


@neuros_function(inputs=["seen"], outputs="push")
def push(node, seen):
    packet = node.make_packet("push")
    packet.data = -2.0 * (seen.data % 1.0)
    return packet


@neuros_function(inputs=["angle"])
def pass_over(node, angle):
    pass
"""
STAMPS = """\
import time
from neuros.hooks import neuros_tick


@neuros_tick(0.01, outputs="number")
def stamp(node):
    number = node.make_packet("number")
    number.data = int(READ % 1_000_000)
    node.set_user_data((node.get_user_data() or 0) + 1)
    if node.get_user_data() == 20:
        node.shutdown("enough")
    return number
"""
LISTENER = """\
from neuros.hooks import neuros_function


@neuros_function(inputs="number")
def listen(node, number):
    pass
"""
SERVED = """\
from neuros.hooks import neuros_initialise, neuros_tick


@neuros_initialise()
def begin(node):
    node.set_user_data([0])
    node.get_ros_node().create_timer(0.01, lambda: count(node))


def count(node):
    node.get_user_data()[0] += 1


@neuros_tick(0.02, outputs="number")
def tell(node):
    number = node.make_packet("number")
    number.data = node.get_user_data()[0]
    if number.data > 5:
        node.shutdown("enough")
    return number
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return record(tmp_path_factory.mktemp("recorded"), "process")


@pytest.fixture
def own(recorded: Recorded, tmp_path: Path) -> Recorded:
    """The same run, with plugins and a bag that a test may change."""
    return copied(recorded, tmp_path)


def rows(output: str) -> dict[str, list[str]]:
    """The table of a replay by node: hooks, packets, verdict, first difference."""
    lines = [re.split(r" {2,}", line.strip()) for line in output.splitlines()]
    begin = next(n for n, line in enumerate(lines) if line[0].startswith("----"))
    table = lines[begin + 1 :]
    return {line[0]: line[1:] for line in table[: table.index([""])]}


def run_of(folder: Path, project: dict[str, Any], plugins: dict[str, str], *options: str) -> Path:
    """Record a run of a project."""
    (folder / "project").mkdir()
    for name, text in plugins.items():
        (folder / f"project/{name}.py").write_text(text)
    (folder / "project/project.json").write_text(json.dumps(project))
    finished = launch(folder / "project", *options, "-r", cwd=folder, timeout_s=DEADLINE_S)
    assert finished.exit_code == 0, finished.output
    assert finished.run_folder is not None
    return finished.run_folder


def pair(plugin: str) -> dict[str, Any]:
    """A node that sends numbers to another one."""
    nodes = [node("sender", plugin, [], ["number"]), node("listener", "listener", ["number"], [])]
    return {"nodes": nodes, "connections": [wire("sender.number -> listener.number", 0)]}


# ------------------------------------------------------------------ identical


@pytest.mark.parametrize("backend", BACKENDS)
def test_every_node_of_a_lossy_and_ticking_run_is_identical(
    backend: str, recorded: Recorded, tmp_path: Path
) -> None:
    run = recorded.run if backend == "process" else record(tmp_path, backend).run
    done = neuros("replay", run)
    assert done.returncode == 0, done.stdout + done.stderr
    figures = json.loads((run / "run.json").read_text())
    for name, row in rows(done.stdout).items():
        hooks = figures["nodes"][name]["hooks"].values()
        sent = [c["sent"] for c in figures["connections"] if c["connection"].startswith(name)]
        assert row == [str(sum(h["executions"] for h in hooks)), str(sum(sent)), "identical"]
    assert [*rows(done.stdout)] == ["counter", "mixer"]
    assert re.search(r"^identical: 2 nodes; \d+ packets; \d+ starts of hooks$", done.stdout, re.M)


def test_as_many_nodes_run_at_a_time_as_are_asked_for(recorded: Recorded) -> None:
    done = neuros("replay", recorded.run, "--jobs", "1")
    assert done.returncode == 0, done.stdout + done.stderr
    said = [line for line in done.stderr.splitlines() if "replayed" in line]
    assert said == [
        "neuros: replayed counter (1 of 2): identical",
        "neuros: replayed mixer (2 of 2): identical",
    ]


def test_as_json(recorded: Recorded) -> None:
    done = neuros("replay", recorded.run, "--format", "json", "--node", "mixer")
    assert done.returncode == 0, done.stdout + done.stderr
    answer = json.loads(done.stdout)
    (verdict,) = answer["nodes"]
    assert verdict["node"] == "mixer"
    assert verdict["verdict"] == "identical"
    assert verdict["packets"] > 0
    assert verdict["hooks"] >= verdict["packets"]
    assert (verdict["difference"], verdict["notes"], answer["notes"]) == ("", [], [])


@pytest.mark.parametrize("options", ["process", "in-process", "in-process --time virtual"])
def test_physics_that_runs_by_itself_is_where_the_hooks_saw_it(
    options: str, tmp_path: Path
) -> None:
    """Commands, readings of its state and its time, and packets that left without a hook."""
    float_type = "std_msgs/msg/Float64"
    physics = node("physics", "physics", ["push"], ["seen", "angle"])
    pusher = node("pusher", "pusher", ["seen", "angle"], ["push"])
    for port in (*physics["inputs"], *physics["outputs"], *pusher["inputs"], *pusher["outputs"]):
        port["type"] = float_type
    physics["outputs"][1]["mujoco"] = {"sensor": "reading", "element": "angle", "rate": 250}
    wires = [
        wire("physics.seen -> pusher.seen"),
        wire("physics.angle -> pusher.angle"),
        wire("pusher.push -> physics.push"),
    ]
    project = {"nodes": [physics, pusher], "connections": wires}
    plugins = {"physics": PHYSICS, "pusher": PUSHER}
    run = run_of(tmp_path, project, plugins, "--backend", *options.split())
    done = neuros("replay", run)
    assert done.returncode == 0, done.stdout + done.stderr
    assert int(rows(done.stdout)["physics"][1]) > 100


def test_the_time_that_a_node_is_told_is_that_of_the_run(tmp_path: Path) -> None:
    plugin = STAMPS.replace("READ", "node.now().nanosec")
    run = run_of(tmp_path, pair("stamps"), {"stamps": plugin, "listener": LISTENER})
    done = neuros("replay", run)
    assert done.returncode == 0, done.stdout + done.stderr


# ------------------------------------------------------------------ different


def test_a_clock_that_the_plugin_reads_itself_is_told_by_packet(tmp_path: Path) -> None:
    plugin = STAMPS.replace("READ", "time.time_ns()")
    run = run_of(tmp_path, pair("stamps"), {"stamps": plugin, "listener": LISTENER})
    done = neuros("replay", run)
    assert done.returncode == 1, done.stdout + done.stderr
    sender, listener = rows(done.stdout).values()
    assert sender[2] == "different"
    assert sender[3].startswith("sender.number -> listener.number: packet 1 differs in data: ")
    assert listener[1:] == ["0", "identical"]


def test_a_changed_plugin_is_the_only_node_that_differs(own: Recorded) -> None:
    plugin = own.project / "mixer.py"
    plugin.write_text(MIXER.replace("seen[0] % 1000", "seen[0] % 1000 + (seen[0] > 20)"))
    done = neuros("replay", own.run)
    assert done.returncode == 1, done.stdout + done.stderr
    found = rows(done.stdout)
    assert found["counter"][2:] == ["identical"]
    assert found["mixer"][2] == "different"
    number = int(found["mixer"][1]) + 1
    says = rf"mixer.mixed -> counter.back: packet {number} differs in data: (\d+) in the run, (\d+)"
    assert re.match(says, found["mixer"][3]), found
    assert f"note: mixer: {plugin} was changed after the run had begun" in done.stdout
    assert "\nmixer different; " in done.stdout


def test_a_plugin_that_kills_its_process_is_told_with_its_last_words(own: Recorded) -> None:
    dies = "    seen = node.get_user_data()\n    print('so long', flush=True)\n    os._exit(9)\n"
    plugin = MIXER.replace("    seen = node.get_user_data()\n", dies)
    (own.project / "mixer.py").write_text(f"import os\n{plugin}")
    done = neuros("replay", own.run)
    assert done.returncode == 4, done.stdout + done.stderr
    assert "not replayed" in done.stdout
    assert "its process ended: exit code 9" in done.stdout
    assert "so long" in done.stdout


# ------------------------------------------------------------------ less than all


def test_what_cannot_be_replayed_is_refused_at_once_and_nothing_is_started(own: Recorded) -> None:
    (own.project / "mixer.py").unlink()
    (own.run / "counter/packets/event_log").unlink()
    done = neuros("replay", own.run)
    assert done.returncode == 2, done.stdout + done.stderr
    assert "2 of 2 nodes of " in done.stderr
    assert "cannot be replayed, and none was started" in done.stderr
    assert "  counter: " in done.stderr
    assert "run the project again with -r" in done.stderr
    assert f"  mixer: the plugin of 'mixer' is gone: {own.project / 'mixer.py'}" in done.stderr
    assert done.stdout == ""


def test_the_refusal_says_how_to_replay_the_others(own: Recorded) -> None:
    (own.project / "mixer.py").unlink()
    done = neuros("replay", own.run)
    assert done.returncode == 2, done.stdout + done.stderr
    assert f"to replay the others: neuros replay {own.run} --node counter" in done.stderr
    assert replay(own.run, "counter").returncode == 0


def test_connections_that_were_left_out_are_named_for_both_ends(tmp_path: Path) -> None:
    finished = launch(
        EXAMPLES / "2_synchronisation/tennis",
        *("--backend", "process", "-r", "--exclude", "bob.*"),
        cwd=tmp_path,
    )
    assert finished.run_folder is not None
    done = neuros("replay", finished.run_folder)
    assert done.returncode == 2
    assert "  ann: what 'ann' received on bob.ball_out -> ann.ball_in was not" in done.stderr
    assert "  bob: nothing that it sent was recorded: run the project again" in done.stderr


def test_callbacks_on_the_ros_node_are_refused_by_name(tmp_path: Path) -> None:
    run = run_of(tmp_path, pair("served"), {"served": SERVED, "listener": LISTENER})
    done = neuros("replay", run)
    assert done.returncode == 2, done.stdout + done.stderr
    assert re.search(r"  sender: \d+ callbacks of services, timers or subscriptions", done.stderr)
    assert f"to replay the others: neuros replay {run} --node listener" in done.stderr
    alone = replay(run, "sender")
    assert alone.returncode == 1
    assert re.search(r"^note: \d+ callbacks of services", alone.stdout, re.M)
    assert "differs in data: 0 in the replay" in re.sub(r"\d+ in the run, ", "", alone.stdout)


def test_a_run_without_a_recording_says_how_to_make_one(tmp_path: Path) -> None:
    tennis = EXAMPLES / "2_synchronisation/tennis"
    finished = launch(tennis, "--backend", "process", cwd=tmp_path)
    assert finished.run_folder is not None
    done = neuros("replay", finished.run_folder)
    assert done.returncode == 2
    assert "was not recorded: launch the project with -r" in done.stderr


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--node", "nobody", "--node", "mixer"], "nobody: "),
        (["--pdb"], "--pdb and --debugpy need one --node NAME"),
        (["--pdb", "--node", "mixer", "--node", "counter"], "--pdb and --debugpy need one"),
        (["--pdb", "--node", "mixer", "--format", "json"], "leave --format json out"),
        (["--topic", "*", "--node", "mixer"], "--topic publishes; --node, --jobs and --output"),
        (["--jobs", "0"], "'0' is not a whole number from 1 on"),
        (["--jobs", "many"], "'many' is not a whole number from 1 on"),
    ],
)
def test_what_users_mistype(recorded: Recorded, options: list[str], says: str) -> None:
    done = neuros("replay", recorded.run, *options)
    assert done.returncode == 2, done.stdout + done.stderr
    assert says in done.stderr
    assert "Traceback" not in done.stderr


def test_an_event_log_that_was_cut_off_is_replayed_as_far_as_it_goes(own: Recorded) -> None:
    event_log = own.run / "mixer/packets/event_log"
    event_log.write_bytes(event_log.read_bytes()[: event_log.stat().st_size // 2])
    done = neuros("replay", own.run)
    assert done.returncode == 0, done.stdout + done.stderr
    found = rows(done.stdout)
    assert found["mixer"][2] == "identical, as far as recorded"
    assert found["counter"][2] == "identical"
    assert "note: mixer: the event log of the run ends after " in done.stdout


@pytest.mark.parametrize("what", ["launcher", "everything"])
def test_a_run_that_was_killed_is_replayed_as_far_as_it_was_kept(what: str, tmp_path: Path) -> None:
    project = write_project(tmp_path / "project")
    (project / "limit").write_text("1000000000")
    with start(project, "--backend", "process", "-r", cwd=tmp_path) as running:
        wait_until(lambda: len(event_logs(tmp_path)) == 2, DEADLINE_S)
        (run,) = (tmp_path / "runs").glob("*/*")
        refused = neuros("replay", run)
        assert refused.returncode == 4, refused.stdout + refused.stderr
        assert "is still being recorded: wait for its end" in refused.stderr
        wait_until(lambda: is_kept(run), DEADLINE_S)
        processes = processes_of(run)
        if what == "everything":
            for process in processes:
                os.kill(process, signal.SIGKILL)
        running.signal(signal.SIGKILL)
    # Nodes end by themselves without a launcher.
    wait_until(lambda: not any(map(is_alive, processes)), DEADLINE_S)
    done = neuros("replay", run)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "note: the launcher of the run was killed" in done.stdout
    found = rows(done.stdout)
    assert [*found] == ["counter", "mixer"]
    assert all(int(row[0]) > 10 and row[2].startswith("identical") for row in found.values())


def event_logs(folder: Path) -> list[Path]:
    return [*folder.glob("runs/*/*/*/packets/event_log")]


def is_kept(run: Path) -> bool:
    """Whether some packets of all four topics, and some events of both nodes, are in files."""
    packets = flushed(run).values()
    logs = [file.stat().st_size for file in run.glob("*/packets/event_log")]
    return len(packets) == 4 and min(packets) > 20 and min(logs) > 4096


def test_ctrl_c_ends_the_replays(own: Recorded, tmp_path: Path) -> None:
    waits = "    open(node.run_dir / 'waits', 'w').close()\n    import time\n    time.sleep(1000)\n"
    text = "    seen = node.get_user_data()\n"
    (own.project / "mixer.py").write_text(MIXER.replace(text, waits + text))
    kept = tmp_path / "kept"
    command = [sys.executable, "-m", "neuros.cli", "replay", str(own.run), "-o", str(kept)]
    with subprocess.Popen(command, stderr=subprocess.PIPE) as process:
        wait_until((kept / "mixer/waits").exists, DEADLINE_S)
        process.send_signal(signal.SIGINT)
        assert process.wait(DEADLINE_S) == 130
    assert processes_of(kept) == {}
