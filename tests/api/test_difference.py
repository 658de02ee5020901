"""Where two runs part."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from neuros.api.run_record import PastRun, open_run, open_whole
from neuros.api.verify import RunComparison, compare, differing_fields
from neuros.errors import EnvironmentFault, UsageError

FIRST, SECOND = "a.out -> b.in", "b.out -> c.in"


def run(
    folder: Path,
    sent: dict[str, list[int]],
    *,
    taken: dict[str, list[int]] | None = None,
    discard_limit: int | None = 0,
    has_digests: bool = True,
) -> PastRun:
    """A run whose packets have these digests; a packet is sent every 10 ns, and taken 5 ns later.

    ``taken`` has the places of those that were taken, by default all.
    """
    connections = []
    for index, (name, digests) in enumerate(sent.items()):
        source, destination = (end.split(".")[0] for end in name.split(" -> "))
        places = (taken or {}).get(name, list(range(1, len(digests) + 1)))
        times = np.arange(len(digests), dtype=np.int64) * 10 + index
        lists: list[tuple[str, str, Any]] = [
            (source, "sent_ns", times),
            (destination, "taken", np.array(places, np.int64)),
            (destination, "taken_ns", np.array([times[place - 1] + 5 for place in places])),
        ]
        if has_digests:
            lists += [(end, "digests", np.array(digests, "u8")) for end in (source, destination)]
        for node, what, numbers in lists:
            (folder / node / "packets").mkdir(parents=True, exist_ok=True)
            (folder / node / "packets" / f"{index}.{what}").write_bytes(numbers.tobytes())
        connections.append(
            {
                "connection": name,
                "index": index,
                "discard_limit": discard_limit,
                "queue_size": 1,
                "sent": len(digests),
                "received": len(digests),
                "consumed": len(digests),
            }
        )
    (folder / "run.json").write_text(json.dumps({"format": 2, "connections": connections}))
    return open_run(folder)


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    found = tmp_path / "A", tmp_path / "B"
    for folder in found:
        folder.mkdir()
    return found


@dataclass
class Bags:
    """What was recorded, by run: digests by connection, and messages by connection and number."""

    digests_in: dict[Path, dict[str, list[int]]] = field(default_factory=dict)
    messages: dict[tuple[Path, str, int], Any] = field(default_factory=dict)
    are_small: bool = True

    def message(self, run: Path, connection: str, number: int) -> Any:
        return self.messages.get((run, connection, number))

    def digests(self, run: Path, connection: str) -> Any:
        found = self.digests_in.get(run, {}).get(connection)
        return None if found is None else np.array(found, np.uint64)

    def are_as_of_nodes(self, run: Path, connection: str) -> bool:
        return self.are_small


def verdict(a: PastRun, b: PastRun, bags: Bags | None = None) -> RunComparison:
    return compare(a, b, bags or Bags())


def test_runs_with_the_same_packets_are_identical(folders: tuple[Path, Path]) -> None:
    a, b = (run(folder, {FIRST: [1, 2], SECOND: [3]}) for folder in folders)
    assert verdict(a, b) == RunComparison(None, (), 3)


def test_the_first_packet_that_differs_is_named(folders: tuple[Path, Path]) -> None:
    a = run(folders[0], {FIRST: [1, 2, 3, 4]})
    b = run(folders[1], {FIRST: [1, 2, 9, 9]})
    found = verdict(a, b)
    assert found.difference is not None
    assert found.difference.startswith(f"{FIRST}: packet 3 differs")
    assert found.compared == 2


def test_of_several_connections_the_one_that_parted_first_is_named(
    folders: tuple[Path, Path],
) -> None:
    a = run(folders[0], {FIRST: [1, 2, 3], SECOND: [4, 5, 6]})
    b = run(folders[1], {FIRST: [1, 2, 9], SECOND: [4, 9, 6]})
    found = verdict(a, b)
    assert found.difference is not None
    assert found.difference.startswith(f"{SECOND}: packet 2 differs")
    assert found.remarks == ("1 more connection differs, from a later moment on",)


def test_a_run_that_ends_earlier_is_not_identical(folders: tuple[Path, Path]) -> None:
    a, b = run(folders[0], {FIRST: [1, 2, 3]}), run(folders[1], {FIRST: [1, 2]})
    assert verdict(a, b).difference == f"{FIRST}: run B ends after packet 2, run A has more (1)"


def test_a_lossless_connection_must_have_been_read_alike(folders: tuple[Path, Path]) -> None:
    a = run(folders[0], {FIRST: [1, 2]})
    b = run(folders[1], {FIRST: [1, 2]}, taken={FIRST: [1]})
    difference = verdict(a, b).difference
    assert difference == f"{FIRST}: hooks took 2 packets in run A, and 1 in run B"


def test_hooks_that_share_an_input_do_not_make_its_packets_early(
    folders: tuple[Path, Path],
) -> None:
    sent = {FIRST: [1, 2, 3, 4, 5, 6], SECOND: [7, 8, 9, 10, 11, 12]}
    twice = [1, 1, 2, 2, 3, 3, 4, 4, 5, 5]  # two hooks on each
    a = run(folders[0], sent, taken={FIRST: [*twice, 6, 6], SECOND: [1, 2, 3, 4, 5, 6]})
    b = run(folders[1], sent, taken={FIRST: twice, SECOND: [1, 2, 3, 5, 6]})
    found = verdict(a, b).difference
    assert found == f"{SECOND}: hooks took different packets as number 4"


def test_what_a_node_that_never_reported_has_sent_is_not_said_to_be_identical(
    folders: tuple[Path, Path],
) -> None:
    runs = [run(folder, {FIRST: [1, 2]}, has_digests=False) for folder in folders]
    for each in runs:
        each.connections[FIRST]["sent"] = None  # type: ignore[index]
    found = verdict(*runs)
    assert found.compared == 0
    assert "not compared" in found.remarks[0]


@pytest.mark.parametrize(
    ("listed_in_b", "compared", "difference"),
    [([1, 2], 2, None), ([1, 9], 1, f"{FIRST}: packet 2 differs")],
)
def test_packets_that_are_counted_and_not_listed_are_not_said_to_be_identical(
    folders: tuple[Path, Path], listed_in_b: list[int], compared: int, difference: str | None
) -> None:
    a, b = run(folders[0], {FIRST: [1, 2, 3]}), run(folders[1], {FIRST: listed_in_b})
    b.connections[FIRST].update(sent=3, consumed=3)  # type: ignore[attr-defined]
    found = verdict(a, b)
    assert found.compared == compared
    assert found.remarks == (f"{FIRST}: compared up to packet 2; later packets have no digests",)
    assert (found.difference or "").startswith(difference or "")
    assert (found.difference is None) == (difference is None)
    assert found.not_compared == (FIRST,)


def test_one_that_may_lose_packets_may_have_lost_others(folders: tuple[Path, Path]) -> None:
    a = run(folders[0], {FIRST: [1, 2]}, discard_limit=None)
    b = run(folders[1], {FIRST: [1, 2]}, taken={FIRST: [2]}, discard_limit=None)
    found = verdict(a, b)
    assert found.difference is None
    assert "may lose packets" in found.remarks[0]
    assert found.consumed_differently == (FIRST,)


def virtual(run_: PastRun, **nodes: Any) -> PastRun:
    return PastRun(run_.folder, {**run_.record, "virtual_s": 1.0, "nodes": nodes})


def test_in_virtual_time_no_run_may_lose_others(folders: tuple[Path, Path]) -> None:
    a = virtual(run(folders[0], {FIRST: [1, 2]}, discard_limit=None))
    b = virtual(run(folders[1], {FIRST: [1, 2]}, taken={FIRST: [2]}, discard_limit=None))
    assert "hooks took different packets as number 1" in (verdict(a, b).difference or "")


def test_in_virtual_time_the_starts_of_hooks_are_compared(folders: tuple[Path, Path]) -> None:
    a, b = (run(folder, {FIRST: [1, 2]}) for folder in folders)
    late = np.array([5, 16], np.int64)
    (b.folder / "b" / "packets" / "0.taken_ns").write_bytes(late.tobytes())
    assert verdict(a, b).difference is None
    found = verdict(virtual(a), virtual(b)).difference
    start = "the hook of start 2 started at 1.5e-08 s in run A, and at 1.6e-08 s in run B"
    assert found == f"{FIRST}: {start}"


def test_in_virtual_time_executions_are_compared(folders: tuple[Path, Path]) -> None:
    hooks = [{"hooks": {"tick": {"executions": n, "busy_s": 0.5}}} for n in (3, 4)]
    a, b = (virtual(run(f, {FIRST: [1]}), a=h) for f, h in zip(folders, hooks, strict=True))
    found = verdict(a, b).difference
    counts = "3 times, for 0.5 s in run A, and 4 times, for 0.5 s in run B"
    assert found == f"hook 'tick' of a ran {counts}"


def test_counters_tell_what_lists_of_packets_do_not(folders: tuple[Path, Path]) -> None:
    a, b = (run(folder, {FIRST: [1, 2]}, discard_limit=None) for folder in folders)
    assert verdict(a, b).consumed_differently == ()
    b.connections[FIRST]["consumed"] = 1  # type: ignore[index]
    found = verdict(a, b)
    assert found.consumed_differently == (FIRST,)
    assert "hooks took 2 packets in run A, and 1 in run B" in found.remarks[0]


def test_a_connection_that_only_one_run_has_is_a_difference(folders: tuple[Path, Path]) -> None:
    a, b = run(folders[0], {FIRST: [1]}), run(folders[1], {FIRST: [1], SECOND: [2]})
    assert verdict(a, b).difference == f"{SECOND}: only run B has this connection"


def test_without_digests_nothing_is_said_to_be_identical(folders: tuple[Path, Path]) -> None:
    a = run(folders[0], {FIRST: [1]})
    b = run(folders[1], {FIRST: [1]}, has_digests=False)
    found = verdict(a, b)
    assert found.compared == 0
    assert found.remarks[0].startswith(f"{FIRST}: not compared, since {folders[1]} has neither")


@pytest.mark.parametrize(("in_b", "difference"), [([1, 2], None), ([1, 9], "packet 2 differs")])
def test_without_digests_packets_are_taken_from_bags(
    folders: tuple[Path, Path], in_b: list[int], difference: str | None
) -> None:
    a, b = (run(folder, {FIRST: [1, 2]}, has_digests=False) for folder in folders)
    bags = Bags({a.folder: {FIRST: [1, 2]}, b.folder: {FIRST: in_b}})
    found = verdict(a, b, bags)
    assert found.compared == (2 if difference is None else 1)
    assert found.remarks == ()
    assert (found.difference or "None").startswith(
        f"{FIRST}: {difference}" if difference else "None"
    )


@pytest.mark.parametrize("are_small", [True, False])
def test_a_bag_stands_beside_digests_where_both_are_made_alike(
    folders: tuple[Path, Path], are_small: bool
) -> None:
    a, b = run(folders[0], {FIRST: [1, 2]}), run(folders[1], {FIRST: [1, 2]}, has_digests=False)
    for first, second in ((a, b), (b, a)):
        found = verdict(first, second, Bags({b.folder: {FIRST: [1, 2]}}, are_small=are_small))
        assert found.difference is None
        assert found.compared == (2 if are_small else 0)
    bags = Bags({a.folder: {FIRST: [7, 8]}, b.folder: {FIRST: [7, 8]}}, are_small=are_small)
    assert verdict(a, b, bags) == RunComparison(None, (), 2), "both are taken from their bags"


def test_what_is_missing_in_a_bag_is_not_said_to_be_identical(folders: tuple[Path, Path]) -> None:
    a, b = (run(folder, {FIRST: [1, 2, 3]}, has_digests=False) for folder in folders)
    found = verdict(a, b, Bags({a.folder: {FIRST: [1, 2, 3]}, b.folder: {FIRST: [1, 2]}}))
    assert found.compared == 2
    assert "compared up to packet 2" in found.remarks[0]


@dataclass
class Stamp:
    sec: int = 0


@dataclass
class Message:
    stamp: Stamp = field(default_factory=Stamp)
    values: Any = field(default_factory=lambda: np.zeros(3))
    name: str = ""


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        (Message(), Message(), []),
        (Message(Stamp(1)), Message(Stamp(2)), ["stamp.sec: 1 in A, 2 in B"]),
        (Message(name="x"), Message(name="y"), ["name: 'x' in A, 'y' in B"]),
        (Message(values=[1, 2]), Message(values=[1, 3]), ["values[1]: 2 in A, 3 in B"]),
        (Message(values=[1]), Message(values=[1, 3]), ["values: 1 elements in A, 2 in B"]),
        (Message(values=[float("nan")]), Message(values=[float("nan")]), []),
    ],
)
def test_fields_that_differ_are_named(a: Message, b: Message, expected: list[str]) -> None:
    assert list(differing_fields(a, b)) == expected


def test_what_was_recorded_tells_the_field(folders: tuple[Path, Path]) -> None:
    a, b = run(folders[0], {FIRST: [1, 2]}), run(folders[1], {FIRST: [1, 9]})

    stamps = zip(folders, (3, 4), strict=True)
    bags = Bags(messages={(folder, FIRST, 2): Message(Stamp(sec)) for folder, sec in stamps})
    difference = verdict(a, b, bags).difference
    assert difference == f"{FIRST}: packet 2 differs in stamp.sec: 3 in A, 4 in B"


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, "not the folder of a run"),
        ('{"format": 1', "is broken"),
        ("[]", "is broken: it holds no object"),
        ('{"format": 2}', "is broken"),
        ('{"format": 2, "connections": [{}]}', "is broken"),
        ('{"project": "old"}', "has format None, and this version of NeuROS reads format 2"),
        ('{"format": 3}', "use the version that the run was made with"),
    ],
)
def test_what_is_no_run_of_this_version_is_refused(
    tmp_path: Path, content: str | None, reason: str
) -> None:
    if content is not None:
        (tmp_path / "run.json").write_text(content)
    with pytest.raises((UsageError, EnvironmentFault), match=reason):
        open_run(tmp_path)


def test_a_run_that_goes_on_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a/node.json").write_text("{}")
    with pytest.raises(UsageError, match="its run goes on"):
        open_run(tmp_path)


def test_a_run_in_parts_is_compared_as_a_whole(folders: tuple[Path, Path]) -> None:
    whole, parts = folders
    sent = {FIRST: [1, 2, 3], SECOND: [4, 5]}
    a = run(whole, sent)
    for part, nodes, lacks in (("a", "a", SECOND), ("desk", "bc", None)):
        (parts / part).mkdir()
        run(parts / part, sent)
        for node in {*"abc"} - {*nodes}:
            shutil.rmtree(parts / part / node)
        for node in nodes:
            (parts / part / node / "node.json").touch()
        record = json.loads((parts / part / "run.json").read_text())
        kept = [each for each in record["connections"] if each["connection"] != lacks]
        for each in kept:
            each |= {"sent": None} if each["connection"][0] not in nodes else {}
        (parts / part / "run.json").write_text(json.dumps({**record, "connections": kept}))
    verdict = compare(a, open_whole(parts), Bags())
    assert (verdict.difference, verdict.remarks, verdict.compared) == (None, (), 5)
    (parts / "a/a/packets/0.digests").write_bytes(np.array([1, 2, 4], "u8").tobytes())
    difference = compare(a, open_whole(parts), Bags()).difference
    assert difference is not None
    assert difference.startswith(f"{FIRST}: packet 3 differs")


def forget_the_first(folder: Path, count: int, *, ends: str = "ab") -> None:
    """Have the lists of the first connection begin later, as those of a long run do."""
    for node in ends:
        for file in (folder / node / "packets").glob("0.*"):
            numbers = file.read_bytes()
            file.unlink()
            file.with_name(f"{file.name}.{count}").write_bytes(numbers[8 * count :])


def test_packets_are_compared_from_the_first_that_both_runs_have_kept(
    folders: tuple[Path, Path],
) -> None:
    a = run(folders[0], {FIRST: [7, 2, 3, 4]})
    b = run(folders[1], {FIRST: [1, 2, 3, 4]})
    forget_the_first(folders[0], 1)
    forget_the_first(folders[1], 2)
    found = verdict(a, b)
    assert (found.difference, found.compared) == (None, 2)
    assert "compared from packet 3 on; the first 2 are not kept" in " ".join(found.remarks)


def test_a_difference_behind_packets_that_are_not_kept_has_its_number(
    folders: tuple[Path, Path],
) -> None:
    a = run(folders[0], {FIRST: [1, 2, 3, 4, 5]})
    b = run(folders[1], {FIRST: [1, 2, 3, 9]})
    forget_the_first(folders[1], 2)
    found = verdict(a, b)
    assert found.difference is not None
    assert found.difference.startswith(f"{FIRST}: packet 4 differs")
    assert found.compared == 1


def test_a_run_that_ends_before_what_the_other_has_kept_is_different(
    folders: tuple[Path, Path],
) -> None:
    a = run(folders[0], {FIRST: [1, 2]})
    b = run(folders[1], {FIRST: [1, 2, 3, 4]})
    forget_the_first(folders[1], 3)
    assert verdict(a, b).difference == f"{FIRST}: run A ends after packet 2, run B has more (2)"


def test_other_values_that_plugins_keep_are_a_note(tmp_path: Path) -> None:
    runs = []
    for name, kept, restored in (("a", "1", "2"), ("b", "1", "3"), ("c", "4", "2")):
        (tmp_path / name).mkdir()
        made = run(tmp_path / name, {FIRST: [7]})
        values = {"kept": {"w": {"sha256": kept, "bytes": 1}}}
        values |= {"restored": {"w": {"sha256": restored, "bytes": 1, "from": name}}}
        runs.append(PastRun(made.folder, {**made.record, "nodes": {"a": values, f"of_{name}": {}}}))
    a, b, c = runs
    assert compare(a, a, Bags()).remarks == ()
    verdict = compare(a, b, Bags())
    assert verdict.remarks == ("a.w: another value was restored in run B",)
    assert verdict.difference is None
    assert compare(a, c, Bags()).remarks == ("a.w: another value was kept in run B",)
