"""Both back ends start hosts with the right command, environment, folder and log."""

from __future__ import annotations

import json
import os
import secrets
import signal
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from deadlines import wait_until
from processes import is_alive

from neuros.backends import node_command
from neuros.backends.guardian import Guardian
from neuros.backends.node_command import process_environment
from neuros.backends.process_launchers import InProcessLauncher, ProcessLauncher, RunningProcess
from neuros.errors import EnvironmentFault
from neuros.ports import NodeProgram
from neuros.project.model import Folders, Node, NodeFile

# A host that says all that it was given.
SAY = """
import json, os, sys
print(json.dumps({"files": sys.argv[1:], "environment": dict(os.environ), "folder": os.getcwd(),
                  "input": sys.stdin.read(), "session": os.getsid(0) == os.getpid()}))
"""
SLEEP = "import time; print('ready', flush=True); time.sleep(60)"


def command(program: str) -> list[str]:
    return [sys.executable, "-S", "-c", program]


class Run:
    def __init__(self, folder: Path) -> None:
        self.folder = folder / "a run"
        self.folder.mkdir()
        self.guardian = Guardian.start(secrets.token_hex(8))
        self.hosts: list[RunningProcess] = []

    def node(self, name: str, script: Path | None = None, **environment: str) -> NodeFile:
        (self.folder / name).mkdir(exist_ok=True)
        node = Node(name, "", Path("/plugin.py"), script=script, environment=environment)
        return NodeFile(node, (), Folders(self.folder, self.folder, self.folder))

    def script(self, name: str, text: str, mode: int = 0o644) -> Path:
        path = self.folder / name
        path.write_text(text)
        path.chmod(mode)
        return path

    def start(
        self, program: str, nodes: Sequence[NodeFile], in_process: bool = False
    ) -> list[RunningProcess]:
        kind = InProcessLauncher if in_process else ProcessLauncher
        launcher = kind(NodeProgram(program=command(program), guardian=self.guardian))
        self.hosts += launcher.start(nodes, {"NEUROS_RUN_ID": "1234", "SHARED": "run"})
        return self.hosts

    def end(self, program: str, nodes: Sequence[NodeFile], in_process: bool = False) -> list[str]:
        """Start and wait: how the hosts ended."""
        return [host.wait(10) or "" for host in self.start(program, nodes, in_process)]

    def log(self, path: str) -> str:
        return (self.folder / path).read_text()


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    run = Run(tmp_path)
    yield run
    run.guardian.finish()


def test_one_process_per_node(run: Run) -> None:
    nodes = [run.node("snn"), run.node("robot")]
    assert run.end(SAY, nodes) == ["exit code 0"] * 2
    assert [host.names for host in run.hosts] == [("snn",), ("robot",)]
    said = json.loads(run.log("snn/node.log"))
    assert said["files"] == [str(run.folder / "snn/node.json")]
    assert said["folder"] == str(run.folder)
    assert said["input"] == ""
    assert said["session"], "Ctrl+C reaches the launcher only"


def test_one_process_for_all_nodes(run: Run) -> None:
    nodes = [run.node("snn", ONLY="snn"), run.node("robot")]
    assert run.end(SAY, nodes, in_process=True) == ["exit code 0"]
    assert run.hosts[0].names == ("snn", "robot")
    said = json.loads(run.log("host.log"))
    assert said["files"] == [str(run.folder / f"{name}/node.json") for name in ("snn", "robot")]
    assert said["environment"]["NEUROS_RUN_ID"] == "1234"
    assert "ONLY" not in said["environment"], "the host gives it to that node alone"


def test_a_node_has_its_environment_and_that_of_the_run(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FROM_THE_USER", "yes")
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "3")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    run.end(SAY, [run.node("snn", RATE="50", OMP_NUM_THREADS="2", SHARED="node")])
    environment = json.loads(run.log("snn/node.log"))["environment"]
    expected = {
        "RATE": "50",
        "FROM_THE_USER": "yes",
        "SHARED": "run",
        "NEUROS_RUN_ID": "1234",
        "NEUROS_RUN_DIR": str(run.folder / "snn"),
        "PYTHONUNBUFFERED": "1",
        "OMP_NUM_THREADS": "2",
        "OPENBLAS_NUM_THREADS": "3",
        "MKL_NUM_THREADS": "1",
        "NUMBA_NUM_THREADS": "1",
    }
    assert expected.items() <= environment.items()


def test_the_restart_of_the_ros_wheels_happens_anew_in_each_host() -> None:
    libraries = os.pathsep.join([f"{sys.prefix}/lib", "/opt/mine", f"{sys.prefix}/a.libs"])
    given = {"_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1", "LD_LIBRARY_PATH": libraries}
    environment = process_environment(given, {})
    assert "_ROS_WHEELS_BOOTSTRAP_COMPLETE" not in environment
    assert environment["LD_LIBRARY_PATH"] == "/opt/mine"


def test_library_paths_of_the_user_stay() -> None:
    environment = process_environment({"LD_LIBRARY_PATH": f"{sys.prefix}/lib"}, {})
    assert environment["LD_LIBRARY_PATH"] == f"{sys.prefix}/lib"


def test_the_implementation_of_rmw_is_that_of_the_wheels_where_ros_comes_from_wheels() -> None:
    sourced = {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}
    assert process_environment(sourced, {})["RMW_IMPLEMENTATION"] == "rmw_fastrtps_cpp"


def test_the_implementation_of_rmw_is_that_of_the_environment_where_another_ros_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(node_command, "_BOOTSTRAPPER", "no_wheels_of_ros")
    image = {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}
    assert process_environment(image, {})["RMW_IMPLEMENTATION"] == "rmw_cyclonedds_cpp"
    assert "RMW_IMPLEMENTATION" not in process_environment({}, {})


def test_both_outputs_are_appended_to_the_log(run: Run) -> None:
    node = run.node("snn")
    (run.folder / "snn/node.log").write_text("before\n")
    run.end("import os; os.write(1, b'one\\n'); os.write(2, b'two\\n')", [node])
    assert run.log("snn/node.log") == "before\none\ntwo\n"


@pytest.mark.parametrize(
    ("program", "words"),
    [
        ("raise SystemExit(3)", "exit code 3"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "killed by SIGKILL"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGRTMIN + 1)", "killed by signal 35"),
    ],
)
def test_how_a_host_ended_is_said_in_words(run: Run, program: str, words: str) -> None:
    assert run.end(program, [run.node("snn")]) == [words]


def test_terminate_asks_and_kill_does_not(run: Run) -> None:
    asked, killed = run.start(SLEEP, [run.node("snn"), run.node("robot")])
    assert asked.poll() is None
    asked.terminate()
    assert asked.wait(10) == "killed by SIGTERM"
    killed.kill()
    assert killed.wait(10) == "killed by SIGKILL"
    killed.kill()
    killed.terminate()  # too late, and no error


def test_kill_takes_the_children_along(run: Run) -> None:
    program = "import os, time; print(os.fork() or 0, flush=True); time.sleep(60)"
    (host,) = run.start(program, [run.node("snn")])
    wait_until(lambda: run.log("snn/node.log").count("\n") == 2)
    child = max(int(line) for line in run.log("snn/node.log").split())
    host.kill()
    host.wait(10)
    wait_until(lambda: not is_alive(child))


def _children_of(pid: int) -> list[int]:
    return [int(text) for text in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def test_a_program_that_does_not_exist_is_a_fault_and_the_others_do_not_stay(run: Run) -> None:
    nowhere, here = Path("/nowhere/python"), Path(sys.executable)
    program = NodeProgram(
        program=command(SLEEP),
        pythons={"a": here, "b": nowhere},
        guardian=run.guardian,
    )
    with pytest.raises(EnvironmentFault, match=r"process of b: .*No such file.*/nowhere/python"):
        ProcessLauncher(program).start([run.node("a"), run.node("b")], {})
    assert not any(is_alive(pid) for pid in _children_of(run.guardian.pid))


def test_what_no_process_can_be_given_is_a_fault_and_the_next_one_starts(run: Run) -> None:
    with pytest.raises(EnvironmentFault, match=r"process of snn: .*null"):
        run.start(SLEEP, [run.node("snn", BAD="a\0b")])
    assert run.end("pass", [run.node("robot")]) == ["exit code 0"]


def test_how_a_process_ended_is_not_known_when_its_guardian_was_killed(run: Run) -> None:
    (host,) = run.start(SLEEP, [run.node("snn")])
    os.kill(run.guardian.pid, signal.SIGKILL)
    wait_until(lambda: not run.guardian.is_on_duty)
    assert host.poll() is None
    host.kill()
    assert host.wait(10) == "how is not known, since the guardian was killed"
    with pytest.raises(EnvironmentFault, match="process of robot: the guardian was killed"):
        run.start(SLEEP, [run.node("robot")])


def test_a_script_runs_first_in_the_environment_of_its_node(run: Run) -> None:
    script = run.script("be fore.sh", 'echo "script: $RATE $NEUROS_RUN_DIR"; export RATE=1; cd /')
    assert run.end(SAY, [run.node("snn", script, RATE="a 'quoted' \"$50\"")]) == ["exit code 0"]
    first, _, rest = run.log("snn/node.log").partition("\n")
    assert first == f"script: a 'quoted' \"$50\" {run.folder}/snn"
    said = json.loads(rest)
    assert said["environment"]["RATE"] == "a 'quoted' \"$50\"", "its changes are its own"
    assert said["folder"] == str(run.folder)
    assert said["session"], "the host is the process that was started"


def test_an_executable_script_chooses_its_own_interpreter(run: Run) -> None:
    script = run.script("it", f"#!{sys.executable} -S\nprint('python')", 0o755)
    run.end("pass", [run.node("snn", script)])
    assert run.log("snn/node.log") == "python\n"


def test_a_script_that_fails_ends_the_node_and_is_named(run: Run) -> None:
    script = run.script("bad.sh", "echo no such device >&2; exit 7")
    how = f"script {script} of 'snn' failed: exit code 7"
    assert run.end("print('never')", [run.node("snn", script)]) == [how]
    output, last = run.log("snn/node.log").splitlines()
    assert output == "no such device"
    assert last.startswith("[FATAL] [")
    assert last.endswith(f"[snn]: script {script} failed: exit code 7")


def test_in_process_all_scripts_run_each_in_its_environment(run: Run) -> None:
    script = run.script("say.sh", 'echo "$WHO $SHARED"')
    nodes = [run.node("a", script, WHO="x"), run.node("b"), run.node("c", script, WHO="y")]
    assert run.end("print('host')", nodes, in_process=True) == ["exit code 0"]
    assert run.log("host.log") == "host\n"
    assert run.log("a/node.log") == "x run\n"
    assert run.log("c/node.log") == "y run\n"


def test_in_process_a_script_that_fails_is_named_with_its_node(run: Run) -> None:
    script = run.script("bad.sh", "echo no such device >&2; exit 7")
    (how,) = run.end("print('never')", [run.node("a"), run.node("b", script)], in_process=True)
    assert how == f"script {script} of 'b' failed: exit code 7"
    assert run.log("b/node.log") == "no such device\n"


def test_terminate_during_a_script_ends_both(run: Run) -> None:
    script = run.script("slow.sh", "echo $$; exec sleep 60")
    (host,) = run.start("print('never')", [run.node("snn", script)])
    wait_until(lambda: bool(run.log("snn/node.log")))
    child = int(run.log("snn/node.log"))
    host.terminate()
    assert host.wait(10) == "killed by SIGTERM"
    wait_until(lambda: not is_alive(child))


def test_what_would_be_started_can_be_described(run: Run) -> None:
    nodes = [run.node("snn"), run.node("robot")]
    program = NodeProgram(program=["python", "-m", "host"])
    lines = ProcessLauncher(program).describe(nodes)
    assert lines[0] == (
        f"process snn: python -m host '{run.folder}/snn/node.json' (log: {run.folder}/snn/node.log)"
    )
    assert len(lines) == 2
    (line,) = InProcessLauncher(program).describe(nodes)
    assert line.startswith("one process for snn, robot: python -m host '")
    placed = NodeProgram(program=["python"], cores={"snn": (1,), "robot": (0, 2)})
    lines = ProcessLauncher(placed).describe(nodes)
    assert [line.partition(":")[0] for line in lines] == [
        "process snn on core 1",
        "process robot on cores 0, 2",
    ]
    (line,) = InProcessLauncher(placed).describe(nodes)
    assert line.startswith("one process for snn, robot on cores 0, 1, 2: ")
