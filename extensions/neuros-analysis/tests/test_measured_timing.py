"""``neuros timing``: what it measures in the lists of a run, and the files that it writes."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from neuros_analysis.timing import ENOUGH, MOST_SAMPLES, Measured, by_chance, distance, measure
from run_folders import accounting, run_folder

from neuros.cli.main import main
from neuros.engine.schedule import MOST_EXECUTIONS
from neuros.errors import UsageError
from neuros.project.validate import mistake

MS = 1_000_000
WIRE = "a.out -> b.in"
START_NS = 5_000_000_000


@dataclass
class Lists:
    """The lists of a run, as its nodes write them; times in nanoseconds."""

    hooks: dict[str, list[tuple[str, str]]] = field(default_factory=dict)
    executions: dict[str, list[tuple[int, int, int]]] = field(default_factory=dict)
    credits: dict[str, list[tuple[int, int, int]]] = field(default_factory=dict)
    sent_ns: dict[str, list[int]] = field(default_factory=dict)
    taken: dict[str, list[tuple[int, int]]] = field(default_factory=dict)
    pauses: dict[str, list[tuple[int, int]]] = field(default_factory=dict)

    def execute(self, name: str, start_ns: int, end_ns: int, kind: str = "function") -> None:
        node, hook = name.split(".")
        hooks = self.hooks.setdefault(node, [])
        if (hook, kind) not in hooks:
            hooks.append((hook, kind))
        row = hooks.index((hook, kind)), start_ns, end_ns
        self.executions.setdefault(node, []).append(row)

    def write(
        self,
        folder: Path,
        limits: Mapping[str, int | None],
        moved: Mapping[str, Callable[[int], int]] | None = None,
        **record: Any,
    ) -> Path:
        """The folder of a run; ``moved``: by node, its own clock."""
        nodes = {node: accounting(executing={"f": 1.0}) for node in self.hooks}
        run_folder(folder, limits, nodes, **record)
        for node in nodes:
            own = (moved or {}).get(node, lambda time_ns: time_ns)
            packets = folder / node / "packets"
            for file in packets.iterdir():
                file.unlink()
            names = [{"name": name, "kind": kind} for name, kind in self.hooks[node]]
            (packets / "hooks.json").write_text(json.dumps(names))
            executions = [(hook, own(a), own(b)) for hook, a, b in self.executions[node]]
            credits = [(index, at, own(ns)) for index, at, ns in self.credits.get(node, ())]
            pauses = [(own(a), own(b)) for a, b in self.pauses.get(node, ())]
            rows: dict[str, Any] = {"executions": executions, "credits": credits, "pauses": pauses}
            for index, name in enumerate(limits):
                source, destination = (end.split(".")[0] for end in name.split(" -> "))
                if node == source:
                    rows[f"{index}.sent_ns"] = [own(ns) for ns in self.sent_ns[name]]
                if node == destination:
                    rows[f"{index}.taken"] = [at for at, _ in self.taken[name]]
                    rows[f"{index}.taken_ns"] = [own(ns) for _, ns in self.taken[name]]
            for file_name, numbers in rows.items():
                if numbers:
                    np.array(numbers, np.int64).tofile(packets / file_name)
        return folder


def pipeline(
    pauses_ns: Sequence[int], delays_ns: Sequence[int], works_ns: Sequence[int], answer_ns: int
) -> tuple[Lists, list[int]]:
    """``a.send`` takes 1 ms and sends to ``b.use``; also the delays of packets that find b free."""
    lists, now_ns, free_ns, arrival_ns, found = Lists(), START_NS, START_NS, 0, []
    lists.sent_ns[WIRE], lists.taken[WIRE], lists.credits["a"] = [], [], []
    for number, (pause, delay, work) in enumerate(
        zip(pauses_ns, delays_ns, works_ns, strict=True), 1
    ):
        lists.execute("a.send", now_ns, now_ns + MS)
        sent_ns = now_ns + MS
        now_ns = sent_ns + pause
        arrival_ns = max(sent_ns + delay, arrival_ns)
        start_ns = max(arrival_ns, free_ns)
        lists.sent_ns[WIRE].append(sent_ns)
        lists.taken[WIRE].append((number, start_ns))
        if free_ns <= sent_ns:
            found.append(start_ns - sent_ns)
        lists.execute("b.use", start_ns, start_ns + work)
        free_ns = start_ns + work
        lists.credits["a"].append((0, number, start_ns + answer_ns))
    return lists, found


times_ns = st.integers(1000, 50 * MS)
packets = st.lists(st.tuples(times_ns, times_ns, times_ns), min_size=ENOUGH, max_size=80)


@settings(max_examples=40)
@given(packets)
def test_the_delay_is_that_of_packets_that_found_their_receiver_free(
    tmp_path_factory: pytest.TempPathFactory, packets: list[tuple[int, int, int]]
) -> None:
    lists, found = pipeline(*zip(*packets, strict=True), answer_ns=2000)
    timing = measure(lists.write(tmp_path_factory.mktemp("run"), {WIRE: None}))
    works_ns = [work for _, _, work in packets]
    assert timing.hooks["b.use"].values_s == pytest.approx([work * 1e-9 for work in works_ns])
    assert timing.hooks["a.send"].values_s == pytest.approx([1e-3] * len(packets))
    if len(found) >= ENOUGH:
        assert timing.connections[WIRE].of == "packets"
        assert timing.connections[WIRE].values_s == pytest.approx([ns * 1e-9 for ns in found])


def busy(packets: int = 60) -> Lists:
    """Only the first packet finds b free; each acknowledgement needs 0.3 ms."""
    return pipeline([MS] * packets, [5 * MS] * packets, [40 * MS] * packets, 300_000)[0]


def test_of_a_receiver_that_is_always_busy_acknowledgements_show_the_delay(tmp_path: Path) -> None:
    lists = busy()
    lists.executions["a"] = lists.executions["a"][:1]  # then it only waits
    delay = measure(lists.write(tmp_path, {WIRE: 0})).connections[WIRE]
    assert delay.of == "acknowledgements"
    assert delay.values_s == pytest.approx([3e-4] * 60)


def test_a_few_packets_tell_more_than_a_few_acknowledgements(tmp_path: Path) -> None:
    lists = busy(ENOUGH - 1)
    lists.executions["a"] = lists.executions["a"][:1]
    delay = measure(lists.write(tmp_path, {WIRE: 0})).connections[WIRE]
    assert delay.of == "packets"
    assert delay.values_s == pytest.approx([5e-3])


def test_an_acknowledgement_that_found_its_sender_busy_does_not_count(tmp_path: Path) -> None:
    """The first 60 hooks of a sender end one after the other, and so do the waits for them."""
    lists = busy()
    lists.executions["a"] = [(0, START_NS, START_NS + 60_000 * MS)]
    assert measure(lists.write(tmp_path, {WIRE: 0})).connections[WIRE].of == "packets"


def free(packets: int = 40, delay_ns: int = 2 * MS) -> Lists:
    return pipeline([99 * MS] * packets, [delay_ns] * packets, [3 * MS] * packets, MS)[0]


def test_a_hook_that_also_starts_without_a_packet_does_not_wait_for_one(tmp_path: Path) -> None:
    lists = free()
    lists.execute("b.use", START_NS + 50 * MS, START_NS + 51 * MS)
    lists.credits = {}
    assert measure(lists.write(tmp_path, {WIRE: None})).missing == {
        WIRE: "no packet found 'b' free, or its hooks do not wait for packets"
    }


def test_a_tick_does_not_wait_for_a_packet(tmp_path: Path) -> None:
    lists = free()
    lists.hooks["b"] = [("use", "tick")]
    lists.credits = {}
    assert WIRE in measure(lists.write(tmp_path, {WIRE: None})).missing


def test_a_packet_during_a_pause_does_not_count(tmp_path: Path) -> None:
    lists = free()
    (_, first_ns), (_, second_ns), *_ = lists.taken[WIRE]
    lists.pauses["b"] = [(first_ns + 3 * MS, second_ns)]
    delay = measure(lists.write(tmp_path, {WIRE: None})).connections[WIRE]
    assert len(delay.values_s) == 39


def test_a_start_that_an_acknowledgement_may_have_caused_does_not_count(tmp_path: Path) -> None:
    lists = free()
    lists.credits["b"] = [(7, 1, lists.taken[WIRE][3][1] - 1)]
    delay = measure(lists.write(tmp_path, {WIRE: None})).connections[WIRE]
    assert len(delay.values_s) == 39


def test_of_a_hook_of_two_inputs_the_packet_that_was_sent_last_counts(tmp_path: Path) -> None:
    other = "c.out -> b.other"
    lists = free()
    lists.sent_ns[other] = [ns - MS // 2 for ns in lists.sent_ns[WIRE]]
    lists.taken[other] = lists.taken[WIRE]
    for ns in lists.sent_ns[other]:
        lists.execute("c.send", ns - MS, ns)
    timing = measure(lists.write(tmp_path, {WIRE: None, other: None}))
    assert timing.connections[WIRE].values_s == pytest.approx([2e-3] * 40)
    assert other in timing.missing


@pytest.mark.parametrize(("is_one_process", "count"), [(False, 40), (True, 39)])
def test_in_one_process_hooks_of_other_nodes_keep_a_receiver_busy(
    tmp_path: Path, is_one_process: bool, count: int
) -> None:
    lists = free()
    sent_ns = lists.sent_ns[WIRE][4]
    lists.execute("c.other", sent_ns + 1000, sent_ns + MS)
    lists.execute("a.send", sent_ns + 50 * MS, sent_ns + 50 * MS)
    folder = lists.write(tmp_path, {WIRE: None}, is_one_process=is_one_process)
    assert len(measure(folder).connections[WIRE].values_s) == count


def test_once_a_node_lists_no_more_hooks_nobody_in_its_process_counts_as_free(
    tmp_path: Path,
) -> None:
    lists = free()
    middle_ns = lists.taken[WIRE][20][1] + 10 * MS
    for number in range(MOST_EXECUTIONS):
        at_ns = middle_ns - MOST_EXECUTIONS + number
        lists.execute("c.quick", at_ns, at_ns)
    delay = measure(lists.write(tmp_path, {WIRE: None}, is_one_process=True)).connections[WIRE]
    assert len(delay.values_s) == 21


def test_initialise_hooks_and_threads_of_simulators_have_no_duration(tmp_path: Path) -> None:
    lists = free()
    lists.execute("b.start", START_NS - 9 * MS, START_NS, "initialise")
    lists.execute("a.submit(out)", START_NS - 9 * MS, START_NS)
    assert [*measure(lists.write(tmp_path, {WIRE: None})).hooks] == ["a.send", "b.use"]


# ---------------------------------------------------------------------- clocks


def in_parts(folder: Path, lists: Lists, moved: Callable[[int], int], limit: int | None) -> Path:
    """A run of two launchers, each with a clock of its own."""
    whole = lists.write(folder / "whole", {WIRE: limit}, {"b": moved})
    record = json.loads((whole / "run.json").read_text())
    for part in ("a", "b"):
        (folder / "parts" / f"on_{part}").mkdir(parents=True)
        (whole / part).rename(folder / "parts" / f"on_{part}" / part)
        (folder / "parts" / f"on_{part}" / part / "node.json").write_text("{}")
        own = {**record, "nodes": {part: record["nodes"][part]}, "project": part}
        (folder / "parts" / f"on_{part}" / "run.json").write_text(json.dumps(own))
    return folder / "parts"


def drifting(time_ns: int) -> int:
    """A clock that is ahead by a day and 20 microseconds per second."""
    return time_ns + 86_400_000 * MS + (time_ns - START_NS) // 50_000


def test_packets_and_their_acknowledgements_tell_how_two_clocks_differ(tmp_path: Path) -> None:
    """Both ways take 2 ms at least; the clocks drift apart by 1 ms within the run."""
    delays = [2 * MS + 100_000 * (number % 7) for number in range(500)]
    lists, found = pipeline([99 * MS] * 500, delays, [3 * MS] * 500, 2 * MS)
    timing = measure(in_parts(tmp_path, lists, drifting, 0))
    delay = timing.connections[WIRE]
    assert delay.of == "packets"
    assert delay.values_s == pytest.approx([ns * 1e-9 for ns in found], abs=5e-5)
    clock = timing.provenance["clocks"]["on_b"]
    assert clock["ahead_s"] == pytest.approx(86_400, abs=1e-3)
    assert clock["error_s"] == pytest.approx(2e-3, abs=1e-4)
    assert [run["project"] for run in timing.provenance["runs"]] == ["a", "b"]


def test_without_acknowledgements_two_clocks_cannot_be_compared(tmp_path: Path) -> None:
    lists = free()
    lists.credits = {}
    timing = measure(in_parts(tmp_path, lists, drifting, None))
    assert "clocks are not known to each other" in timing.missing[WIRE]
    assert "discard limit" in timing.missing[WIRE]
    assert [*timing.hooks] == ["a.send", "b.use"]


def test_one_part_alone_does_not_know_the_way_to_the_others(tmp_path: Path) -> None:
    part = in_parts(tmp_path, free(), drifting, 0) / "on_a"
    timing = measure(part)
    assert [*timing.hooks] == ["a.send"]
    assert timing.missing == {
        WIRE: "b ran in another part: name a folder that holds the run folders of all parts"
    }


def test_a_folder_of_several_runs_is_not_one_run(tmp_path: Path) -> None:
    for name in ("first", "second"):
        free().write(tmp_path / name, {WIRE: 0})
    with pytest.raises(UsageError, match="node 'a' ran in first, second: name one of them"):
        measure(tmp_path)


def test_times_of_a_deployment_are_on_one_clock_already(tmp_path: Path) -> None:
    machines = {"pi": {"nodes": ["b"], "clock_ahead_s": 0.5}}
    lists = free()
    lists.credits = {}
    timing = measure(lists.write(tmp_path, {WIRE: None}, machines=machines))
    assert timing.connections[WIRE].values_s == pytest.approx([2e-3] * 40)
    assert timing.provenance["runs"][0]["machines"] == {"pi": ["b"]}


LISTS = ("a/packets/executions", "a/packets/credits", "b/packets/executions", "b/packets/pauses")
LISTS += ("a/packets/0.sent_ns", "b/packets/0.taken", "b/packets/0.taken_ns")
numbers = st.lists(st.integers(0, 1) | st.integers(-(2**63), 2**63 - 1), max_size=40)


@settings(max_examples=40)
@given(st.sampled_from(LISTS), numbers)
def test_damaged_lists_give_what_a_file_can_have(
    tmp_path_factory: pytest.TempPathFactory, file: str, numbers: list[int]
) -> None:
    folder = free().write(tmp_path_factory.mktemp("run"), {WIRE: 0})
    np.array(numbers, np.int64).tofile(folder / file)
    timing = measure(folder)
    for kind in ("samples", "lognormal", "normal", "constant"):
        assert mistake(json.loads(timing.file(kind)), "project", "#/$defs/timing") == ""


# ---------------------------------------------------------------------- files


@pytest.mark.parametrize("kind", ["samples", "lognormal", "normal", "constant"])
def test_a_file_is_one_that_launch_reads(tmp_path: Path, kind: str) -> None:
    folder = free().write(tmp_path / "run", {WIRE: 0}, run_id="1f", machine={"name": "pi"})
    assert main(["timing", str(folder), "--as", kind, "-o", str(tmp_path / "t.json")]) == 0
    content = json.loads((tmp_path / "t.json").read_text())
    assert mistake(content, "project", "#/$defs/timing") == ""
    assert [*content["hooks"]] == ["a.send", "b.use"]
    assert [*content["connections"]] == [WIRE]
    provenance = content["provenance"]
    assert provenance["as"] == kind
    assert (provenance["runs"][0]["run_id"], provenance["runs"][0]["host"]) == ("1f", "pi")
    assert provenance["counts"][WIRE] == {"count": 40, "of": "packets"}


def test_fits_are_those_of_largest_likelihood() -> None:
    values_s = np.array([0.01, 0.02, 0.04])
    measured = Measured(values_s, "executions")
    assert measured.fit("samples").keys == {"samples": [0.01, 0.02, 0.04]}
    assert measured.fit("constant").keys == pytest.approx(values_s.mean(), abs=1e-9)
    median, sigma = measured.fit("lognormal").keys["lognormal"]
    assert (median, sigma) == pytest.approx((0.02, np.log([1, 2, 4]).std()), abs=1e-8)
    assert measured.fit("normal").keys["normal"] == pytest.approx(
        [values_s.mean(), values_s.std()], abs=1e-9
    )


@given(st.integers(0, 2**32), st.integers(MOST_SAMPLES + 1, 20_000))
def test_samples_are_bounded_and_keep_the_distribution(seed: int, count: int) -> None:
    values_s = np.random.default_rng(seed).lognormal(-5, 1, count)
    samples = Measured(values_s, "executions").fit("samples").values
    assert len(samples) == MOST_SAMPLES
    assert distance(values_s, np.array(samples)) < 2 / MOST_SAMPLES


samples = st.lists(st.integers(0, 20), min_size=1, max_size=50)


@given(samples, samples)
def test_the_distance_is_the_largest_gap_of_cumulative_shares(
    one: list[int], two: list[int]
) -> None:
    gaps = [
        abs(sum(x <= at for x in one) / len(one) - sum(x <= at for x in two) / len(two))
        for at in range(21)
    ]
    assert distance(np.array(one), np.array(two)) == pytest.approx(max(gaps))


def test_samples_of_one_distribution_are_seldom_further_apart_than_by_chance() -> None:
    draw = np.random.default_rng(7)
    far = [distance(draw.random(200), draw.random(300)) > by_chance(200, 300) for _ in range(400)]
    assert 4 <= sum(far) <= 36  # 5 % of 400 are 20


# ---------------------------------------------------------------------- the command


def test_two_runs_are_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = free().write(tmp_path / "robot", {WIRE: None})
    two = free(delay_ns=9 * MS).write(tmp_path / "laptop", {WIRE: None})
    picture = tmp_path / "pictures/both.svg"
    assert main(["timing", str(one), str(two), "--plot", str(picture)]) == 0
    lines = {line[:24].strip(): line.split() for line in capsys.readouterr().out.splitlines()}
    assert lines["b.use"][-2:] == ["0.000", "0.304"]
    assert lines[WIRE][-2:] == ["1.000", "0.304"]
    assert f"{WIRE}: latency" in lines
    text = picture.read_text()
    assert "robot" in text
    assert "laptop" in text


def test_json_has_the_rows_of_the_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = free().write(tmp_path / "run", {WIRE: None})
    assert main(["timing", str(run), "--as", "normal", "--format", "json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["runs"] == [str(run)]
    assert found["missing"] == [{}]
    row = next(row for row in found["rows"] if row["name"] == "b.use")
    assert (row["of"], row["count"], row["median / ms"]) == ("executions", 40, pytest.approx(3.0))


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["RUN", "RUN", "-o", "t.json"], "-o and --as need one run, and two are named"),
        (["RUN", "RUN", "--as", "normal"], "-o and --as need one run"),
        (["RUN", "--plot", "t.txt"], "--plot t.txt: its name must end in .png, .svg, .pdf"),
        (["RUN", "--as", "gamma"], "must be 'samples', 'lognormal', 'normal' or 'constant'"),
        (["nowhere"], "not the folder of a run"),
    ],
)
def test_a_wrong_command_says_what_to_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], reason: str
) -> None:
    run = str(free().write(tmp_path, {WIRE: None}))
    try:
        code = main(["timing", *(run if each == "RUN" else each for each in arguments)])
    except SystemExit as exit_:
        code = int(exit_.code or 0)
    assert code == 2
    assert reason in capsys.readouterr().err


def test_a_run_without_lists_says_how_to_get_them(tmp_path: Path) -> None:
    lists = free()
    lists.executions = {"a": [], "b": []}
    folder = lists.write(tmp_path, {WIRE: None}, options={"packet_log": "0"})
    with pytest.raises(UsageError, match="--packet-log 0: run the project again without"):
        measure(folder)
