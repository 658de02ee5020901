"""What each back end guarantees, on small projects that ``neuros launch --backend`` runs."""

from __future__ import annotations

import ast
import itertools
import json
import re
import signal
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from deadlines import wait_until

from neuros.backends.run_processes import RunProcesses
from neuros.backends.sessions import sessions
from neuros.distribution import python_command

PROJECTS = Path(__file__).parents[1] / "integration" / "back_ends"
COUNT = 200
TIMEOUT_S = 60.0
# SHA-256 of all that the sink of the project ``pipeline`` receives, by input.
_DIGESTS = (
    "1cad2308551c756f36c3900d44a500a37e7828edb7074631f8b6c3784938923e",
    "ef5505075c9899373c39e12a3073423136632fb906a0fffa59f5d49a80206c95",
)


@dataclass(frozen=True)
class Launched:
    """A run that is over: exit code and output of its launcher, its folder and ``run.json``."""

    exit_code: int
    output: str
    folder: Path
    record: Mapping[str, Any]

    def connection(self, name: str) -> Mapping[str, Any]:
        """The counters of ``"a.out -> b.in"``."""
        return next(dict(c) for c in self.record["connections"] if c["connection"] == name)

    def counts(self, name: str, *keys: str) -> list[int]:
        """Some of the counters of ``"a.out -> b.in"``."""
        return [self.connection(name)[key] for key in keys]

    def hooks(self, node: str) -> dict[str, int]:
        """How often each hook of a node has run."""
        hooks = self.record["nodes"][node]["hooks"]
        return {name: hook["executions"] for name, hook in hooks.items()}

    def read(self, path: str) -> str:
        """A file of the run folder."""
        return (self.folder / path).read_text("utf-8")


def launcher(project: Path, folder: Path, *arguments: str) -> subprocess.Popen[str]:
    """``neuros launch`` in a session of its own; the run goes into ``folder``."""
    return subprocess.Popen(
        python_command("neuros.cli", "launch", str(project), "-o", str(folder), *arguments),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def finish(process: subprocess.Popen[str], folder: Path) -> Launched:
    """Wait for the end of a launcher; one that does not come to it is killed, and a failure."""
    try:
        output, _ = process.communicate(timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        output, _ = process.communicate()
        raise AssertionError(f"no end after {TIMEOUT_S:g} s:\n{output}") from None
    file = folder / "run.json"
    record = json.loads(file.read_text("utf-8")) if file.exists() else {}
    return Launched(process.returncode, output, folder, record)


class BackEndChecks:
    """What a back end guarantees; pytest collects the methods from a derived class.

    Attributes:
        back_end: its name.
        options: further options of ``neuros launch``.
    """

    back_end: str
    options: Sequence[str] = ()
    _runs: dict[tuple[str, ...], Launched]

    def __init_subclass__(cls) -> None:
        cls._runs = {}

    @pytest.fixture
    def run(self, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Launched]:
        """Runs a project with some arguments, once."""

        def run_once(project: str, *arguments: str) -> Launched:
            key = (project, *arguments)
            if key not in self._runs:
                folder = tmp_path_factory.mktemp(self.back_end) / "run"
                launched = finish(self.start(project, folder, *arguments), folder)
                assert launched.exit_code == 0, launched.output
                self._runs[key] = launched
            return self._runs[key]

        return run_once

    def start(self, project: str, folder: Path, *arguments: str) -> subprocess.Popen[str]:
        """Start a project of the suite on the back end."""
        options = ("--backend", self.back_end, *self.options, *arguments)
        return launcher(PROJECTS / project, folder, *options)

    # ------------------------------------------------------------------ connections

    @pytest.fixture
    def pipeline(self, run: Callable[..., Launched]) -> Launched:
        return run("pipeline")

    @pytest.mark.parametrize(
        "connection",
        [
            "source.number -> relay.number",
            "source.series -> relay.series",
            "relay.number -> sink.number",
            "relay.total -> sink.total",
        ],
    )
    def test_a_lossless_connection_loses_nothing_up_to_the_drained_end(
        self, pipeline: Launched, connection: str
    ) -> None:
        assert pipeline.counts(connection, "sent", "received", "consumed") == [COUNT] * 3
        assert pipeline.counts(connection, "discarded", "unread") == [0, 0]

    def test_a_discard_limit_is_never_exceeded(self, pipeline: Launched) -> None:
        counters = pipeline.connection("source.number -> limited.number")
        assert counters["sent"] == counters["received"] == COUNT
        assert 0 < counters["discarded"] < COUNT
        assert counters["longest_discard"] <= 2
        taken = [0, *map(int, pipeline.read("limited/taken").split())]
        assert len(taken) - 1 == counters["consumed"]
        assert max(b - a for a, b in itertools.pairwise(taken)) <= 3

    def test_a_connection_without_limit_holds_up_nobody(self, pipeline: Launched) -> None:
        counters = pipeline.connection("source.number -> unlimited.number")
        assert counters["sent"] == COUNT
        assert 0 < counters["received"] <= COUNT
        taken = list(map(int, pipeline.read("unlimited/taken").split()))
        assert taken == sorted(set(taken))

    def test_the_counters_add_up(self, pipeline: Launched) -> None:
        for counters in pipeline.record["connections"]:
            settled = counters["consumed"] + counters["discarded"] + counters["unread"]
            assert counters["received"] == settled
            assert counters["sent"] >= counters["received"]
            if counters["discard_limit"] is not None:
                assert counters["sent"] == counters["received"]

    def test_each_hook_runs_as_often_as_it_should(self, pipeline: Launched) -> None:
        assert pipeline.hooks("source") == {"begin": 1, "emit": COUNT}
        assert pipeline.hooks("relay") == {"begin": 1, "relay": COUNT}
        assert pipeline.hooks("sink") == {"begin": 1, "take_number": COUNT, "take_total": COUNT}

    def test_the_times_of_a_node_add_up(self, pipeline: Launched) -> None:
        for node in pipeline.record["nodes"].values():
            spent = node["accounting"]
            parts = sum(
                sum(part.values()) if isinstance(part, dict) else part
                for name, part in spent.items()
                if name != "total"
            )
            assert parts == pytest.approx(spent["total"], rel=1e-6)
            assert node["report"] == "final"

    def test_a_reproducible_project_sends_the_same_bytes_on_every_back_end(
        self, pipeline: Launched
    ) -> None:
        assert tuple(pipeline.read("sink/digest").split()) == _DIGESTS

    # ------------------------------------------------------------------ joins

    @pytest.fixture
    def joins(self, run: Callable[..., Launched]) -> Launched:
        return run("joins")

    def test_all_gives_one_packet_of_each_source_in_the_order_of_the_project(
        self, joins: Launched
    ) -> None:
        expected = [f"e{i},a{i},b{i}" for i in range(1, 11)]
        assert joins.read("chair/rounds").split() == expected

    def test_a_connection_to_itself_is_lossless_too(self, joins: Launched) -> None:
        counts = joins.counts("chair.round -> chair.round", "sent", "received", "consumed")
        assert counts == [10, 10, 10]

    def test_one_output_feeds_several_receivers_losslessly(self, joins: Launched) -> None:
        for receiver in ("ann", "bob", "eve"):
            name = f"chair.question -> {receiver}.question"
            assert joins.counts(name, "sent", "received", "consumed") == [10, 10, 10]

    def test_optional_inputs_are_taken_when_they_are_there(self, joins: Launched) -> None:
        seen = ast.literal_eval(joins.read("watcher/seen"))
        votes = [vote for vote, _ in seen]
        extra = [extra for _, extra in seen if extra]
        assert votes == [f"a{i}" for i in range(1, 11)]
        assert extra == [f"b{i}" for i in range(1, len(extra) + 1)]
        left = joins.connection("bob.vote -> watcher.extra")
        assert left["consumed"] == len(extra)
        assert left["unread"] == 10 - len(extra)

    # ------------------------------------------------------------------ surroundings

    @pytest.fixture
    def surroundings(self, run: Callable[..., Launched]) -> Launched:
        """Its plugin fails at once if it sees anything of the other node; see there."""
        return run("surroundings")

    def test_nodes_of_one_plugin_share_neither_globals_nor_environment_nor_modules(
        self, surroundings: Launched
    ) -> None:
        for node in ("ann", "bob"):
            *_, last = surroundings.read(f"{node}/notes").splitlines()
            assert last == "finalise after 5 strokes and 5 calls"

    def test_initialise_and_finalise_hooks_run_once(self, surroundings: Launched) -> None:
        for node in ("ann", "bob"):
            notes = surroundings.read(f"{node}/notes").splitlines()
            assert [note.split()[0] for note in notes] == ["initialise", "finalise"]

    def test_what_a_node_says_is_in_its_own_log_up_to_the_end(self, surroundings: Launched) -> None:
        for node, other in (("ann", "bob"), ("bob", "ann")):
            log = surroundings.read(f"{node}/node.log")
            assert log.count(f"print on import: {node}\n") == 1
            assert log.count(f"print in hook: {node}\n") == 5
            assert log.count(f"print in a callback: {node}\n") == 1
            assert log.count(f"child of {node}, ") == 5
            said = rf"\[INFO\] \[[\d.]+\] \[{node}\]: log in hook: {node}\n"
            assert len(re.findall(said, log)) == 5
            assert log.count(f"print at the end: {node}\n") == 1
            assert other not in log.replace("standard", "")

    def test_a_variable_of_one_node_hides_that_of_the_process_for_that_node_only(
        self, surroundings: Launched
    ) -> None:
        assert surroundings.read("ann/node.log").count("home /ann\n") == 5
        assert "home /ann\n" not in surroundings.read("bob/node.log")

    def test_everything_that_nodes_say_reaches_the_console(self, surroundings: Launched) -> None:
        for node in ("ann", "bob"):
            assert surroundings.output.count(f"log in hook: {node}") == 5
            assert f"print at the end: {node}" in surroundings.output

    # ------------------------------------------------------------------ time

    def test_ticks_keep_their_schedule_and_a_duration_in_wall_time_ends_drained(
        self, run: Callable[..., Launched]
    ) -> None:
        launched = run("time", "--duration", "2")
        ticks = launched.record["nodes"]["clock"]["hooks"]["step"]
        # 200 ticks of 10 ms; a machine with other work to do may miss some, and end the run later.
        most = launched.record["wall_s"] / 0.01 + 2
        assert 140 <= ticks["executions"] <= most
        assert 198 <= ticks["executions"] + ticks["missed_ticks"] <= most
        sent, consumed = launched.counts("clock.clock -> reader.clock", "sent", "consumed")
        assert sent == consumed == ticks["executions"]

    def test_a_duration_in_simulated_time_ends_exactly_there(
        self, run: Callable[..., Launched]
    ) -> None:
        launched = run("time", "--duration", "0.25sim")
        assert launched.record["sim_s"] == pytest.approx(0.25)
        connection = "clock.clock -> reader.clock"
        assert launched.counts(connection, "sent", "received", "consumed") == [25, 25, 25]

    # ------------------------------------------------------------------ beginning and end

    def test_the_record_names_the_back_end(self, pipeline: Launched) -> None:
        assert pipeline.record["backend"] == self.back_end

    def test_what_would_be_started_is_described_and_not_started(self, tmp_path: Path) -> None:
        folder = tmp_path / "run"
        described = finish(self.start("time", folder, "--dry-run"), folder)
        assert described.exit_code == 0, described.output
        assert f"back end {self.back_end};" in described.output
        assert "clock" in described.output
        assert not folder.exists()

    @pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
    def test_a_signal_ends_the_run_in_order(
        self, tmp_path: Path, number: signal.Signals, code: int
    ) -> None:
        process = self.start("time", tmp_path / "run")
        self._await_packets(tmp_path / "run", process)
        process.send_signal(number)
        launched = finish(process, tmp_path / "run")
        assert launched.exit_code == code, launched.output
        assert all(node["report"] == "final" for node in launched.record["nodes"].values())

    def test_of_a_node_that_is_killed_it_is_said_where_it_stood(self, tmp_path: Path) -> None:
        process = self.start("stuck", tmp_path / "run")
        self._await_packets(tmp_path / "run", process)
        process.send_signal(signal.SIGINT)
        assert process.stdout is not None
        assert any("a second one kills at once" in line for line in process.stdout)
        process.send_signal(signal.SIGINT)
        launched = finish(process, tmp_path / "run")
        assert launched.exit_code == 130, launched.output
        assert "in compute" in launched.record["nodes"]["reader"]["stack"], launched.output

    def test_nothing_is_left_of_a_run_whose_launcher_was_killed(self, tmp_path: Path) -> None:
        folder = tmp_path / "run"
        process = self.start("time", folder)
        self._await_packets(folder, process)
        (run_id,) = (each.run for each in sessions() if each.folder == str(folder))
        processes = RunProcesses(run_id)
        assert processes.alive()
        process.send_signal(signal.SIGKILL)
        finish(process, folder)
        wait_until(lambda: not processes.alive(), TIMEOUT_S)
        wait_until(lambda: not any(each.run == run_id for each in sessions()), TIMEOUT_S)

    def _await_packets(self, folder: Path, process: subprocess.Popen[str]) -> None:
        """Until nodes run: the reader has written down a packet."""
        seen = folder / "reader" / "seen"
        wait_until(lambda: seen.exists() or process.poll() is not None, TIMEOUT_S)
        assert process.poll() is None, process.communicate()[0]
