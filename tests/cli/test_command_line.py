"""What the command line takes, refuses and answers; runs as such are in tests/integration."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from neuros.api.plan import Plan, check_machine
from neuros.api.request import Duration, Request, parse_duration
from neuros.api.run_folder import make_run_folder
from neuros.cli.launch import signals_noted
from neuros.cli.main import COMMANDS, main
from neuros.errors import EnvironmentFault, UsageError
from neuros.project.model import Node, Project
from neuros.registry import choose
from neuros.transport.dds_profile import MOST_LOCAL_PARTICIPANTS

PORT = "std_msgs/msg/Int32"
PLUGIN = "from neuros.hooks import *\n@neuros_initialise()\ndef begin(node): pass\n"


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)


def test_a_folder_whose_name_is_no_text_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / os.fsdecode(b"odd\xff")
    folder.mkdir()
    node = {"name": "a", "container": "neuros_python", "plugin": "a.py"}
    (folder / "project.json").write_text(json.dumps({"nodes": [node], "connections": []}))
    (folder / "a.py").write_text(PLUGIN)
    assert main(["validate", str(folder)]) == 0
    assert main(["launch", str(folder), "--dry-run"]) == 2
    assert (
        r"odd\udcff: the name is not UTF-8, as ROS needs it: rename it" in capsys.readouterr().err
    )


@pytest.mark.parametrize("command", ["validate", "launch", "report", "logs", "bag info", "types"])
def test_a_name_that_is_too_long_is_one_sentence(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command.split(), "a" * 5000]) == 2
    assert "cannot be opened (File name too long)" in capsys.readouterr().err


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Two connected nodes, ``a`` and ``b``."""
    (tmp_path / "plugin.py").write_text(PLUGIN)
    nodes = [
        {
            "name": name,
            "container": "neuros_python",
            "plugin": "plugin.py",
            side: [{"name": port, "type": PORT}],
        }
        for name, side, port in (("a", "outputs", "o"), ("b", "inputs", "x"))
    ]
    connection = {
        "source_node": "a",
        "source_output": "o",
        "destination_node": "b",
        "destination_input": "x",
    }
    file = tmp_path / "project.json"
    file.write_text(json.dumps({"nodes": nodes, "connections": [connection]}))
    return file


# ------------------------------------------------------------------ help


def test_help_needs_nothing_that_takes_long_to_import() -> None:
    program = (
        "import sys\n"
        "from neuros.cli.main import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "heavy = {'rclpy', 'jsonschema', 'numpy', 'mujoco', 'tabulate', 'neuros.cli.launch'}\n"
        "assert not heavy & {*sys.modules}, heavy & {*sys.modules}\n"
    )
    subprocess.run(
        [sys.executable, "-c", program], check=True, stdout=subprocess.DEVNULL, timeout=30
    )


@pytest.mark.parametrize("arguments", [["--help"], ["launch", "--help"]])
def test_help_documents_the_exit_codes(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 0
    text = capsys.readouterr().out
    for code in ("0", "1", "2", "3", "4", "130", "143"):
        assert f"\n  {code:<4} " in text


# ------------------------------------------------------------------ usage: exit code 2


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ([], "name a project"),
        ([".", "-p", "other"], "two projects are named"),
        ([".", "-n", "c"], "-n c: no such node; the project has a, b"),
        ([".", "--duration", "soon"], "--duration soon: give seconds"),
        ([".", "--duration", "0"], "--duration 0: give seconds"),
        ([".", "-d", "300"], "-d/--domain-id: '300' is not a ROS domain id"),
        ([".", "--backend", "in-process", "-n", "a"], "-n leaves out one end of a.o -> b.x"),
        ([".", "--peers", "10.0.0.7,2.3"], "--peers 10.0.0.7,2.3: '2.3' is neither an IPv4"),
        ([".", "--peers", "a b,"], "--peers a b,: 'a b', '' is neither an IPv4"),
        ([".", "--peers", "224.0.0.1"], "--peers 224.0.0.1: '224.0.0.1' is neither an IPv4"),
        ([".", "--isolate", "--network"], "--isolate with --network: nodes elsewhere cannot"),
        ([".", "--isolate", "-n", "a"], "--isolate with -n: nodes elsewhere cannot reach the run"),
        ([".", "--isolate", "-z"], "--isolate with -g, -z or --viewer: they cannot see into"),
        ([".", "-o", "plugin.py"], "-o plugin.py: is not an empty folder"),
        ([".", "-o", "."], "-o .: is not an empty folder"),
    ],
)
def test_wrong_usage_is_one_sentence(
    project: Path, arguments: list[str], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["launch", *arguments]) == 2
    output = capsys.readouterr()
    assert output.err.startswith(f"neuros: {reason}")
    assert output.err.count("\n") == 1
    assert not Path("runs").exists()


def test_an_isolated_run_has_no_inputs_from_outside(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = json.loads(project.read_text())
    content["nodes"][1]["inputs"].append({"name": "y", "type": PORT, "external_topic": "/odom"})
    project.write_text(json.dumps(content))
    assert main(["launch", ".", "--isolate"]) == 2
    error = capsys.readouterr().err
    assert "--isolate: other programs cannot reach the external inputs b.y (/odom)" in error
    content["nodes"][0]["outputs"].append({"name": "p", "type": PORT, "external_topic": "/odom"})
    project.write_text(json.dumps(content))
    assert main(["launch", ".", "--isolate", "--dry-run", "--backend", "process"]) == 0


def test_no_command_at_all_gives_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert capsys.readouterr().err.startswith("usage: neuros")


@pytest.mark.parametrize("arguments", [["fly"], ["launch", ".", "-d", "x"], ["launch", "--x"]])
def test_wrong_options_end_with_2_as_well(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2


@pytest.mark.parametrize(
    ("option", "hint"),
    [
        ("--projct", " (did you mean '--project'?)"),
        ("--namspace=/a", " (did you mean '--namespace'?)"),
        ("x", ""),
    ],
)
def test_an_unknown_option_is_refused_with_the_usage_of_its_command(
    option: str, hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["graph", "project.json", option])
    error = capsys.readouterr().err
    assert caught.value.code == 2
    assert error.startswith("usage: neuros graph")
    assert f"neuros graph: error: unrecognized arguments: {option}{hint}" in error


def test_a_container_that_is_not_there_is_named_and_an_image_of_ones_own_has_a_version(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = project.read_text().replace("neuros_python", "neuros_pyton", 1)
    project.write_text(text.replace("neuros_python", "pytorch"))
    assert main(["validate", "project.json"]) == 3
    first, second, last = capsys.readouterr().err.splitlines()
    assert "/nodes/0/container: there is no container 'neuros_pyton' (did you mean" in first
    assert "/nodes/1/container: there is no container 'pytorch' (there are neuros_mujoco" in second
    assert "'pytorch:latest'" in second
    assert last == "2 problems; nothing was started"
    project.write_text(text.replace("neuros_python", "pytorch:2").replace("neuros_pyton", "o/x"))
    assert main(["validate", "project.json"]) == 0
    assert capsys.readouterr().err == ""


def test_without_a_command_the_commands_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert "run a project" in capsys.readouterr().err


def test_a_plugin_in_place_of_its_project_is_refused_as_such(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["launch", "plugin.py"]) == 3
    text = "plugin.py:1:1: /: is a plugin, not a project (name its project.json, or their folder)"
    assert text in capsys.readouterr().err


def test_a_folder_that_cannot_be_written_to_is_one_sentence(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.chdir("/proc")  # where even root can make no folder
    assert main(["launch", str(project)]) == 2
    error = capsys.readouterr().err
    assert re.search(r"cannot be made \(.+\): name another with -o", error)


def test_nor_one_that_is_no_folder(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["launch", ".", "-o", "/proc/1/no/such/folder"]) == 2
    assert "cannot be made (" in capsys.readouterr().err


# ------------------------------------------------------------------ projects: exit code 3


def test_simulated_time_needs_a_node_that_owns_it(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["launch", ".", "--duration", "3sim"]) == 3
    assert "needs exactly one node that owns time: none" in capsys.readouterr().err


def test_a_project_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["launch", "nowhere"]) == 3
    output = capsys.readouterr()
    assert "nowhere" in output.err
    assert "Traceback" not in output.err


# ------------------------------------------------------------------ machine: exit code 4


def test_a_machine_without_rclpy_is_one_sentence(
    project: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("neuros.api.plan.find_spec", lambda name: None)
    assert main(["launch", "."]) == 4
    output = capsys.readouterr()
    assert output.err.startswith("neuros: rclpy, the Python library of ROS 2, is not installed")
    assert not Path("runs").exists()


# ------------------------------------------------------------------ without running


def test_a_dry_run_starts_nothing_and_writes_nothing(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(project.parent.rglob("*"))
    assert main(["launch", ".", "--dry-run"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("back end process; ROS domain ")
    names = [line.partition(":")[0].partition(" on ")[0] for line in lines[1:]]
    assert names == ["process a", "process b"]
    assert sorted(project.parent.rglob("*")) == before


def test_a_dry_run_in_process_is_one_process(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["launch", ".", "--dry-run", "--backend", "in-process"]) == 0
    assert capsys.readouterr().out.splitlines()[1].startswith("one process for a, b: ")


def test_a_dry_run_shows_the_cores_that_nodes_ask_for(
    project: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def shown(*options: str) -> list[str]:
        assert main(["launch", ".", "--dry-run", *options]) == 0
        return [line.partition(":")[0] for line in capsys.readouterr().out.splitlines()[1:]]

    monkeypatch.setattr("neuros.api.plan.usable_cores", lambda: frozenset({2, 3, 5, 7}))
    affinity = ("--set", "nodes.b.affinity=[3]")
    assert shown() == ["process a", "process b"]
    assert shown(*affinity) == ["process a", "process b on core 3"]
    assert shown("--no-placement", *affinity) == ["process a", "process b"]
    assert shown("-n", "b", *affinity) == ["process b on core 3"]
    assert shown("--backend", "in-process") == ["one process for a, b"]
    assert shown("--backend", "in-process", *affinity) == ["one process for a, b on core 3"]


def test_validate_says_that_all_is_well(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["validate", "."]) == 0
    assert capsys.readouterr().out.endswith("valid: 2 nodes, 1 connection\n")


@pytest.mark.parametrize("form", ["text", "mermaid"])
def test_graph_names_every_node(
    project: Path, form: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["graph", ".", "--format", form]) == 0
    text = capsys.readouterr().out
    assert "a" in text
    assert "b" in text


# ------------------------------------------------------------------ streams


def test_a_reader_that_has_gone_is_no_traceback(project: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    process = subprocess.run(
        [sys.executable, "-m", "neuros.cli", "graph", str(project)],
        stdout=writer,
        stderr=subprocess.PIPE,
        text=True,
        timeout=30,
        check=False,
    )
    os.close(writer)
    assert process.stderr == ""


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_standard_streams_may_be_closed(project: Path, closed: str) -> None:
    command = f'"{sys.executable}" -m neuros.cli launch . --dry-run {closed}'
    assert subprocess.call(["/bin/sh", "-c", command], timeout=30) == 0


def test_ctrl_c_without_a_run_is_no_traceback(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(options: object) -> int:
        os.kill(os.getpid(), signal.SIGINT)
        return 0

    monkeypatch.setattr("neuros.cli.projects._validate", interrupted)
    assert main(["validate", "."]) == 130


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("words", ["--version", "ps --help", "ps", "graph PROJECT"])
def test_output_that_has_no_room_is_an_error_without_a_traceback(
    words: str, unbuffered: str
) -> None:
    project = str(Path(__file__).parents[2] / "examples/1_tick/clock")
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "neuros.cli", *words.replace("PROJECT", project).split()],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONUNBUFFERED": unbuffered},
            check=False,
        )
    assert done.returncode == 4
    (line,) = done.stderr.splitlines()
    assert line == ("neuros: the output, or a file, could not be written (No space left on device)")


def test_ctrl_c_after_a_run_is_over_changes_nothing() -> None:
    heeded = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    handlers = [signal.getsignal(number) for number in heeded]
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])  # as launch.py does
    try:
        with signals_noted() as (signals, _):
            signal.raise_signal(signal.SIGINT)
            assert signals == [signal.SIGINT]
        signal.raise_signal(signal.SIGINT)
        assert signal.sigwait([signal.SIGINT]) == signal.SIGINT, "it waits, and is never heeded"
        ends = [signal.getsignal(number) for number in heeded]
        assert ends == [signal.SIG_IGN] * len(heeded), "in threads that do not have it wait"
    finally:
        for number, handler in zip(heeded, handlers, strict=True):
            signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


# ------------------------------------------------------------------ parts


@pytest.mark.parametrize(
    ("text", "duration"),
    [
        (None, Duration()),
        ("30", Duration(wall_s=30.0)),
        ("0.5", Duration(wall_s=0.5)),
        (".5", Duration(wall_s=0.5)),
        ("30sim", Duration(sim_s=30.0)),
        (" 1.sim ", Duration(sim_s=1.0)),
    ],
)
def test_durations(text: str | None, duration: Duration) -> None:
    assert parse_duration(text) == duration


@pytest.mark.parametrize("text", ["", "-1", "0sim", "1e3", "nan", "30 s", "sim", "1,5"])
def test_what_is_no_duration(text: str) -> None:
    with pytest.raises(UsageError, match="give seconds, such as 30, or simulated"):
        parse_duration(text)


def test_run_folders_are_named_by_project_and_time(tmp_path: Path) -> None:
    first, second = make_run_folder(None, "tennis"), make_run_folder(None, "tennis")
    assert first != second
    assert first.parent == tmp_path / "runs" / "tennis"
    assert first < second


def test_a_given_run_folder_is_taken_exactly(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    assert make_run_folder("empty", "tennis") == tmp_path / "empty"
    assert make_run_folder("deep/er", "tennis") == tmp_path / "deep" / "er"


def plan_of(count: int, backend: str) -> Plan:
    nodes = tuple(Node(f"node{i}", "neuros_python", Path("plugin.py")) for i in range(count))
    project = Project("many", nodes, (), Path("project.json"))
    chosen = choose(backend, project, nodes, {})
    return Plan(project, tuple(n.name for n in nodes), chosen, Request())


def test_more_processes_than_find_each_other_are_refused_and_the_ways_out_are_named() -> None:
    too_many = MOST_LOCAL_PARTICIPANTS + 1
    with pytest.raises(EnvironmentFault, match="--backend in-process, or --network"):
        check_machine(plan_of(too_many, "process"), {})
    check_machine(plan_of(MOST_LOCAL_PARTICIPANTS, "process"), {})
    check_machine(plan_of(too_many, "in-process"), {})
    check_machine(plan_of(too_many, "process"), {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"})


def test_a_core_that_this_machine_lacks_is_named_with_its_place_and_the_ways_out(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    project.write_text(project.read_text().replace('"name": "b"', '"affinity": [999], "name": "b"'))
    assert main(["launch", "."]) == 4
    assert re.search(
        r"project\.json:1:\d+: /nodes/1/affinity: node 'b' asks for core 999\n"
        r"NeuROS may use cores? [\d, ]+ here: choose others with --set"
        r" nodes\.NAME\.affinity=\[\.\.\.\], or leave it to the kernel with --no-placement",
        capsys.readouterr().err,
    )
    assert main(["validate", "."]) == 0, "it may be right for another machine"


def test_what_could_not_be_started_is_recorded_and_leaves_nothing(
    project: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "executable", "/no/such/python")
    assert main(["launch", ".", "-o", "out"]) == 4
    output = capsys.readouterr()
    assert "Traceback" not in output.err
    assert output.err.startswith("neuros: the guardian process cannot be started: ")
    assert not Path("out/control.sock").exists()


@pytest.mark.parametrize("size", ["1", "2GB", "-1m", "0m", "much"])
def test_a_size_of_the_packet_log_has_a_unit(
    project: Path, size: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["launch", ".", f"--packet-log={size}"]) == 2
    assert f"--packet-log {size}: give a whole number and its unit" in capsys.readouterr().err


def test_digests_need_a_packet_log(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["launch", ".", "--digests", "--packet-log", "0"]) == 2
    assert "--packet-log 0 keeps no digests" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("lauch p", "there is no command 'lauch' (did you mean 'launch'?)"),
        ("bag inf p", "there is no action 'inf' (did you mean 'info'?)"),
        ("verify a b --format jsn", "'json', but is 'jsn' (did you mean 'json'"),
        ("launch p --flush-interval 0", "'0' is not a number above 0"),
        ("launch p --peer-timeout x", "'x' is not a whole number from 1 on"),
        ("replay p --rate fast", "'fast' is not a number"),
        ("launch p -o", "argument -o/--output: needs a value"),
        ("launch p --progress=3", "takes no value, but is given '3'"),
        ("bag info", "it is missing: RUN"),
    ],
)
def test_a_mistyped_command_line_is_answered_in_words(
    line: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(line.split())
    assert ended.value.code == 2
    assert said in capsys.readouterr().err


def test_no_command_that_only_neuros_starts_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["qqqq"])
    said = capsys.readouterr().err
    assert "launch" in said
    hidden = [name for name, command in COMMANDS.items() if not command.help]
    assert hidden
    assert not {*hidden} & {*re.findall(r"[\w-]+", said)}


def test_a_plugin_that_is_run_as_a_program_says_what_to_run(tmp_path: Path) -> None:
    plugin = tmp_path / "brain.py"
    plugin.write_text("from neuros.hooks import *\n@neuros_tick(1)\ndef f(node): ...\n")
    run = partial(subprocess.run, capture_output=True, text=True, check=True)
    said = run([sys.executable, str(plugin)]).stderr
    assert f"{plugin} is a plugin" in said
    assert f"neuros launch {tmp_path}\n" in said
    program = "import neuros.testing\nneuros.testing.PluginHarness\n"
    plugin.write_text(program + plugin.read_text())
    assert run([sys.executable, str(plugin)]).stderr == ""
