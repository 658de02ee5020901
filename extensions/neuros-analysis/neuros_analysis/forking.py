"""Forks: a run, or a session, executed again up to a moment, which goes on with a change there."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from neuros.api.changes import changes_of
from neuros.api.loading import override_texts
from neuros.api.packets import read_packets
from neuros.api.project import LOCAL, Project, StartOptions
from neuros.api.run import Run
from neuros.api.run_record import open_run
from neuros.api.verify import RecordedPackets, first_difference
from neuros.errors import RunError, UsageError
from neuros.options import options_of
from neuros.project.model import Project as Described
from neuros.project.names import SESSION
from neuros.project.repeatable import why_not_repeatable
from neuros.project.split import project_to_json

_INTERRUPTED = (130, 143)
_FINE = 1e-9


@dataclass(frozen=True)
class Fork:
    """A fork of a run that has ended.

    Attributes:
        run: the fork, a run of its own.
        compared: packets up to the moment, one that has several receivers once for each.
        difference: from the run up to there, in a sentence; empty: there is none.
    """

    run: Run
    compared: int
    difference: str


def moment(text: str) -> tuple[float, bool]:
    """The seconds of ``--at 12.4sim``, and whether they are simulated. Raises ``UsageError``."""
    match = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)(sim)?", text.strip())
    if match is None or float(match[1]) <= 0:
        raise UsageError(
            f"--at {text}: give simulated seconds above 0, such as 12.4sim; of a run in virtual"
            " time, seconds of its clock, such as 12.4"
        )
    return float(match[1]), bool(match[2])


def fork_run(
    folder: Path,
    at: str,
    settings: Mapping[str, Any] | None = None,
    **options: Any,
) -> Fork:
    """Execute a run again up to a moment, then go on with other settings to its end.

    Args:
        folder: of the run.
        at: simulated seconds (``12.4sim``), or those of virtual time (``12.4``).
        settings: by path, as for a reset of a session.
        options: arguments of :meth:`Project.start` that take the place of those of the run.

    Raises:
        UsageError: with all reasons why the run cannot be forked, or the settings not be made.
        ProjectError, EnvironmentFault: as for a start.
        RunError: if it ends before the time, or fails when the settings are made.
    """
    at_s, is_simulated = moment(at)
    past = open_run(folder)
    project, chosen = _again(past.record, folder, at, options)
    texts = override_texts(chosen.set)
    changes = changes_of(
        project.described(chosen),
        settings or {},
        lambda more: project.described(replace(chosen, set=[*texts, *override_texts(more)])),
    )
    about = {
        "run": str(folder),
        "run_id": past.record.get("run_id"),
        "at_sim_s" if is_simulated else "at_s": at_s,
        "set": dict(settings or {}),
    }
    if not is_simulated:
        run = project.forked(chosen, about, (at_s, changes))
        if (run.record.get("virtual_s") or 0.0) < at_s:
            raise RunError(f"the fork ended before {at_s:g} s: {run.reason}", 1)
        sent_ns = {name: read_packets(run.folder, ends).sent_ns for name, ends in run.ends.items()}
        counts = {name: int((each < round(at_s * 1e9)).sum()) for name, each in sent_ns.items()}
        compared, difference = first_difference(past, run, counts, RecordedPackets())
        return Fork(run, compared, difference)
    with project.held(chosen, about) as session:
        session.change(changes, only_checks=True)
        if not session.run(duration_sim_s=at_s):
            ended = session.close()
            raise RunError(f"the fork ended before {at_s:g} s: {ended.reason}", 1)
        counts = session.sent_counts()
        session.change(changes)
        run = session.finish()
    recorded = RecordedPackets()
    compared, difference = first_difference(past, run, counts, recorded)
    return Fork(run, compared, difference)


def _again(
    record: Mapping[str, Any], folder: Path, at: str, options: Mapping[str, Any]
) -> tuple[Project, StartOptions]:
    """The project of a run, and the options with which it began.

    Raises:
        UsageError: with all reasons why it cannot be forked.
    """
    told = json.dumps(record["expanded_project"])
    file = Path(record["file"])
    if record["backend"] == LOCAL or SESSION in told:
        raise UsageError(f"{folder} is the run of a session: fork that in its program (fork())")
    if record.get("fork", {}).get("set"):
        raise UsageError(
            f"{folder}: it is a fork with settings itself: fork the run that it began with,"
            f" {record['fork']['run']}"
        )
    if not file.is_file():
        raise UsageError(
            f"{folder}: its project file is gone, or it was described in Python: {file}"
        )
    known = {each.name for each in options_of(StartOptions)}
    given = {key: value for key, value in record["options"].items() if key in known}
    restored = {
        f"{node}.{name}": folder / node / "restored" / f"{name}.npz"
        for node, figures in record["nodes"].items()
        for name in figures.get("restored", {})
    }
    given |= {"restore": restored, "digests": given.get("packet_log") != "0"}
    given |= {key: value for key, value in options.items() if value is not None}
    chosen = StartOptions(**given)
    project = Project.from_file(file)
    described = project.described(chosen)
    at_s, is_simulated = moment(at)
    why = why_not_repeatable(described)
    if described.is_virtual == is_simulated:
        clock = ("simulated seconds, as in 12.4sim", "seconds of virtual time, as in 12.4")
        why.append(f"--at {at}: it is in {described.time} time: give {clock[is_simulated]}")
    if json.dumps(project_to_json(described), sort_keys=True) != json.dumps(
        record["expanded_project"], sort_keys=True
    ):
        why.insert(0, f"{file} was changed after the run: it describes another project now")
    if chosen.nodes or record["options"].get("network"):
        why.append("its nodes ran at several places: a fork runs all of them here")
    if not described.is_virtual:
        why += _time_problems(described, record, chosen, at_s)
    elif at_s > (record.get("virtual_s") or 0.0) - _FINE:
        why.append(f"it ended at {record.get('virtual_s') or 0:g} s of its clock: fork it before")
    if record["exit_code"] in _INTERRUPTED and chosen.duration is None:
        why.append(f"{record['reason']}: give --duration with simulated seconds (30sim)")
    if why:
        raise UsageError("\n".join([f"{folder} cannot be forked:", *(f"  {each}" for each in why)]))
    return project, chosen


def _time_problems(
    project: Described, record: Mapping[str, Any], chosen: StartOptions, at_s: float
) -> Iterator[str]:
    owners = [node.name for node in project.nodes if node.owns_time]
    if len(owners) != 1:
        yield f"one node has to own simulated time, but {', '.join(owners) or 'none'} does"
    elif at_s > (record["sim_s"] or 0.0) - _FINE:
        yield f"it ended at {record['sim_s'] or 0:g} s of simulated time: fork it before"
    if chosen.duration is not None and chosen.end.sim_s is None:
        yield "it ends after a wall time: give --duration with simulated seconds (30sim)"
