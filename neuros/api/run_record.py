"""Record of a run (``run.json``): made from the last reports of its nodes, checked, shown, read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuros.api.kept import record_of_values
from neuros.engine.metrics import in_flight_and_lost, time_budget_of
from neuros.errors import EnvironmentFault
from neuros.project.model import Budgets, Connection, NodeFile, Project
from neuros.project.split import project_to_json
from neuros.recording.run_file import FORMAT, RUN_FILE, read_object, read_run_file

if TYPE_CHECKING:
    from neuros.launcher.outcome import Outcome

EXIT_ENVIRONMENT, EXIT_BUDGET = 4, 5
_COUNTS = ("sent", "received", "consumed", "discarded", "lost")
_STATES = ("executing", "waiting", "blocked", "idle")


def run_record(
    project: Project,
    files: Sequence[NodeFile],
    ended: Outcome,
    wall_s: float,
    run_folder: Path,
) -> dict[str, Any]:
    """The content of ``run.json`` that comes from the nodes; times in seconds."""
    sim_times = [r.sim_time for r in ended.reports.values() if r.sim_time is not None]
    sim_s, running_s = max(sim_times, default=None), ended.running_s
    all_metrics = {**ended.elsewhere, **{n: r.metrics or {} for n, r in ended.reports.items()}}
    return {
        "format": FORMAT,
        "project": project.name,
        "file": str(project.file),
        "exit_code": ended.exit_code,
        "reason": ended.reason,
        "wall_s": wall_s,
        "sim_s": sim_s,
        "running_s": running_s,
        **({"virtual_s": ended.virtual_s} if project.is_virtual else {}),
        "paused_s": ended.paused_s,
        "real_time_factor": ended.real_time_factor,
        "timeline": {
            name: _timeline(points, ended) for name, points in ended.timelines.items() if points
        },
        "connections": [
            _connection(c, all_metrics, ended, run_folder)
            for c in sorted({c for file in files for c in file.connections}, key=lambda c: c.index)
        ],
        "nodes": {
            name: {
                **_node(name, ended),
                "results": _results(run_folder / name),
                **record_of_values(run_folder, file),
                **({"stack": ended.stacks[name]} if name in ended.stacks else {}),
            }
            for name, file in ((file.node.name, file) for file in files)
        },
        "expanded_project": project_to_json(project),
    }


def run_table(record: Mapping[str, Any]) -> str:
    """The record as text: connections, nodes, system load, and times."""
    from tabulate import tabulate

    counts = [*_COUNTS]
    if any(c.get("in_flight") for c in record["connections"]):
        counts.append("in_flight")
    connections = [[c["connection"], *(c[key] for key in counts)] for c in record["connections"]]
    nodes = []
    for name, node in record["nodes"].items():
        spent = time_budget_of(node, record["running_s"])
        if spent is None:
            nodes.append([name, *("?" for _ in _STATES), "never reported"])
            continue
        shares = spent.shares.values() if spent.total_s else ()
        cells = [f"{share:.0%}" for share in shares] or ["-" for _ in _STATES]
        nodes.append([name, *cells, "" if node["report"] == "final" else node["report"]])
    parts = []
    for rows, header, numbers in (
        (connections, ["connection", *(count.replace("_", " ") for count in counts)], counts),
        (nodes, ["node", *_STATES, "remark"], _STATES),
    ):
        if rows:
            align = ["left", *("right" for _ in numbers)]
            parts.append(
                tabulate(rows, header, missingval="?", disable_numparse=True, colalign=align)
            )
    if "system_load" in record:
        from neuros.recording.system_load import load_table  # images of nodes have no psutil

        parts.append(load_table(record["system_load"]))
    parts += [
        f"{c['connection']}: {c['bytes'] / 1e6:.3g} MB compressed to"
        f" {c['compressed_bytes'] / 1e6:.3g} MB"
        for c in record["connections"]
        if "bytes" in c
    ]
    parts += [
        f"{node}.{name} was {how}: {value['bytes']} bytes, SHA-256 {value['sha256'][:12]}"
        for node, figures in record["nodes"].items()
        for how in ("restored", "kept")
        for name, value in figures.get(how, {}).items()
        if value["sha256"]
    ]
    times = f"wall time {record['wall_s']:.2f} s"
    if record.get("virtual_s") is not None:
        times = f"virtual time {record['virtual_s']:.2f} s, {times}"
    if record.get("paused_s"):  # missing in records of earlier versions
        times += f" ({record['paused_s']:.2f} s of it paused)"
    if record["sim_s"] is not None:
        times = (
            f"simulated time {record['sim_s']:.2f} s, {times}, real-time factor"
            f" {record['real_time_factor'] or 0:.2f} ({record['running_s'] or 0:.2f} s without"
            " initialisation and ending)"
        )
    return "\n\n".join([*parts, times])


def _timeline(points: Sequence[Sequence[float]], ended: Outcome) -> list[list[float]]:
    """Simulated and wall time in seconds from the first hook on, a point per simulated second.

    Simulated time goes back at a reset.
    """
    start_s = (ended.started_s if ended.virtual_s is None else None) or 0.0
    found: list[list[float]] = []
    for sim_s, wall_s in points:
        if not found or int(sim_s) > int(found[-1][0]) or sim_s < found[-1][0]:
            found.append([round(sim_s, 6), round(wall_s - start_s, 6)])
    return found


def _connection(
    connection: Connection,
    all_metrics: Mapping[str, Mapping[str, Any]],
    ended: Outcome,
    run_folder: Path,
) -> dict[str, Any]:
    from neuros.api.packets import may_have_lost, packet_figures, read_packets

    key = str(connection)
    outgoing = all_metrics.get(connection.source_node, {}).get("outgoing", {}).get(key, {})
    incoming = all_metrics.get(connection.destination_node, {}).get("incoming", {}).get(key, {})
    fields = ("received", "consumed", "discarded", "unread", "longest_discard")
    sent, received = outgoing.get("sent"), incoming.get("received")
    # The last counts of a killed node are older than those of the node at the other end.
    in_flight, lost, running_s, reports = None, None, ended.running_s, ended.reports
    nodes = {connection.source_node, connection.destination_node} & {*reports}
    is_known = all(reports[node].is_final for node in nodes)
    if is_known and sent is not None and received is not None:
        in_flight, lost = in_flight_and_lost(
            sent, received, outgoing["outstanding"], ended.has_drained
        )
    figures = {
        "connection": key,
        "index": connection.index,
        "discard_limit": connection.discard_limit,
        "queue_size": connection.queue_size,
        "sent": sent,
        "rate_hz": sent / running_s if sent is not None and running_s else None,
        "in_flight": in_flight,
        "lost": lost,
        **{field: incoming.get(field) for field in fields},
    }
    packets = read_packets(run_folder, connection)
    figures |= packet_figures(packets, may_lose=may_have_lost(figures))
    for report in reports.values():
        if key in report.compressed:
            figures["bytes"], figures["compressed_bytes"] = report.compressed[key]
    return figures


def _node(name: str, ended: Outcome) -> dict[str, Any]:
    report = ended.reports.get(name)
    if report is None or report.metrics is None:
        return {"report": None}
    age_s = ended.ended_s - ended.report_times_s[name]
    metrics = report.metrics
    return {
        "accounting": metrics["accounting"],
        "hooks": metrics["hooks"],
        "sim_time": report.sim_time,
        "report": "final" if report.is_final else f"last report {age_s:.1f} s before the end",
    }


def _results(node_folder: Path) -> dict[str, Any]:
    try:
        return read_object(node_folder / "results.json")
    except (FileNotFoundError, EnvironmentFault):
        return {}


@dataclass(frozen=True, eq=False)
class PastRun:
    """The folder of a run and its ``run.json``.

    Attributes:
        record: ``run.json``, or as much of it as the project and the packet lists give.
    """

    folder: Path
    record: Mapping[str, Any]

    @cached_property
    def nodes(self) -> dict[str, Mapping[str, Any]]:
        """The figures of each node by name: ``hooks``, and ``accounting`` if it has reported."""
        return {name: dict(node) for name, node in self.record.get("nodes", {}).items()}

    @cached_property
    def connections(self) -> dict[str, Mapping[str, Any]]:
        """The figures of each connection, by ``a.out -> b.in``: ``sent``, ``consumed``, ..."""
        return {each["connection"]: each for each in self.record.get("connections", ())}

    @cached_property
    def ends(self) -> dict[str, Connection]:
        """The connections as the project has them, by name."""
        return {name: connection_of(figures) for name, figures in self.connections.items()}


def connection_of(figures: Mapping[str, Any]) -> Connection:
    """A connection of the project, from its figures in ``run.json``."""
    ends = figures["connection"].split(" -> ")
    (source, output), (destination, input_) = (end.split(".") for end in ends)
    limit, queue_size = figures.get("discard_limit"), figures.get("queue_size", 1)
    return Connection(source, output, destination, input_, limit, queue_size, figures["index"])


def open_run(folder: Path) -> PastRun:
    """Read a run folder.

    Raises:
        UsageError: if there is no run, it has not ended, or another version of NeuROS wrote it.
        EnvironmentFault: if ``run.json`` is damaged.
    """
    run = PastRun(folder, read_run_file(folder))
    if "connections" not in run.record:
        raise EnvironmentFault(f"{folder / RUN_FILE} is broken: it has no connections")
    return run


def open_whole(folder: Path) -> PastRun:
    """Read a run folder, or a folder that holds those of all parts of one run.

    Raises:
        UsageError, EnvironmentFault: as :func:`open_run`.
    """
    files = sorted(folder.glob(f"*/{RUN_FILE}"))
    if (folder / RUN_FILE).exists() or not files:
        return open_run(folder)
    parts = [open_run(file.parent) for file in files]
    connections: dict[str, dict[str, Any]] = {}
    for figures in (each for part in parts for each in part.record["connections"]):
        known = connections.setdefault(figures["connection"], {**figures})
        known |= {key: value for key, value in figures.items() if known.get(key) is None}
    ordered = sorted(connections.values(), key=lambda figures: figures["index"])
    nodes = {name: node for part in parts for name, node in part.nodes.items()}
    return PastRun(folder, {**parts[0].record, "connections": ordered, "nodes": nodes})


def losses(record: Mapping[str, Any]) -> list[str]:
    """A sentence for each lossless connection that lost packets, or may have lost some."""
    found = []
    for connection in record["connections"]:
        lost, sent, received = (connection[key] for key in ("lost", "sent", "received"))
        if connection["discard_limit"] != 0 or lost == 0 or not _has_begun(connection, record):
            continue
        name = connection["connection"]
        if lost is not None:
            packets = "packet" if lost == 1 else "packets"
            found.append(f"{name} lost {lost} {packets}, though it is lossless (discard_limit 0)")
            continue
        if sent is None:
            why = "the number of packets that were sent is not known"
        elif received is None:
            why = f"it is not known how many of {sent} packets arrived"
        else:
            why = (
                "the number of packets that it lost is not known: the last report of a node is"
                " missing"
            )
        found.append(f"{name} is lossless (discard_limit 0), but {why}")
    return found


def judge(
    record: dict[str, Any], ended: Outcome, budgets: Budgets, *, is_partial: bool = False
) -> list[str]:
    """Fail a run that has lost packets of lossless connections, or has broken budgets.

    Adds the end of the run to its record. Returns a sentence for each connection that lost packets.
    """
    # A run with another exit code was not drained.
    lost = losses(record) if ended.exit_code in (0, EXIT_ENVIRONMENT) else []
    for text in lost:
        ended.fail(text)
    broken = broken_budgets(record, budgets, is_partial=is_partial)
    for text in broken:
        ended.fail(f"budget broken: {text}", EXIT_BUDGET)
    record |= {"exit_code": ended.exit_code, "reason": ended.reason, "broken_budgets": broken}
    return lost


def broken_budgets(
    record: Mapping[str, Any], budgets: Budgets, *, is_partial: bool = False
) -> list[str]:
    """A sentence for each budget that a run has broken, from its ``run.json``.

    An unknown figure breaks its budget, unless ``is_partial``: another part of the run may know it.
    """
    found: list[str] = []
    for connection in record["connections"]:
        name, lost, discarded = (connection[key] for key in ("connection", "lost", "discarded"))
        limit = budgets.lost_packets.get(name)
        if limit is None or not _has_begun(connection, record):
            continue
        if lost is None or discarded is None:
            found.append(f"it is not known how many packets {name} lost; the limit is {limit}")
        elif lost + discarded > limit:
            found.append(
                f"{name} lost {lost + discarded} packets ({lost} on their way,"
                f" {discarded} discarded); the limit is {limit}"
            )
    nodes, factor = record["nodes"], record["real_time_factor"]
    if budgets.real_time_factor is not None:
        text = f"the real-time factor must be at least {budgets.real_time_factor:g}, but"
        owners = [name for name, node in nodes.items() if node.get("sim_time") is not None]
        if any(nodes[name].get("report") != "final" for name in owners):
            found.append(
                f"{text} is not known: the last report of {' and '.join(owners)} is missing"
            )
        elif factor is None and not is_partial:
            found.append(
                f"{text} there was none: no node owns simulated time, or the node that does never"
                " ran a hook"
            )
        elif factor is not None and factor < budgets.real_time_factor:
            found.append(
                f"the real-time factor was {factor:.3g}, but must be at least"
                f" {budgets.real_time_factor:g}"
            )
    for node, metrics in nodes.items() if budgets.tick_error_ms is not None else ():
        limit_text = f"the limit is {budgets.tick_error_ms:g} ms"
        ticks_of = {hook: each.get("ticks") for hook, each in (metrics.get("hooks") or {}).items()}
        if any(ticks_of.values()) and metrics.get("report") != "final":
            found.append(
                f"it is not known how far ticks of {node} were off their period; {limit_text}"
            )
            continue
        for hook, ticks in ticks_of.items():
            if ticks and ticks["largest_error_ms"] > budgets.tick_error_ms:
                found.append(
                    f"a tick of '{hook}' of {node} was off its period by"
                    f" {ticks['largest_error_ms']:.3g} ms; {limit_text}"
                )
    return found


def _has_begun(connection: Mapping[str, Any], record: Mapping[str, Any]) -> bool:
    """Whether a packet may have been sent: the nodes at both ends have begun."""
    ends = (end.partition(".")[0] for end in connection["connection"].split(" -> "))
    here = [record["nodes"][node] for node in ends if node in record["nodes"]]
    if len(here) < 2 and not (connection["sent"] or connection["received"]):
        return False  # the node elsewhere never came, as far as is known here
    return all(node["report"] is not None for node in here)
