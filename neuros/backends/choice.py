"""Choice of ``--backend``, and the back ends of runs that are over."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from neuros.errors import EnvironmentFault, NeurosError, UsageError
from neuros.ports import BackEnd, Deployment, Notice
from neuros.project.model import Node, Project
from neuros.registry import AUTO, BACK_ENDS


@dataclass(frozen=True)
class Chosen:
    """A back end, made ready, and what the user should know of the choice."""

    back_end: BackEnd
    deployment: Deployment
    notices: Sequence[Notice] = ()


def choose(
    wanted: str, project: Project, nodes: Sequence[Node], options: Mapping[str, Any]
) -> Chosen:
    """Make a back end ready for nodes: the one of that name, or for ``auto`` the best usable one.

    Args:
        options: of the back end, by name; ``auto`` gives each of those that it tries its own.

    Raises:
        UsageError: if there is none of that name, or it has no such option.
        EnvironmentFault: if it lacks something, or for ``auto``, if every one of them does.
    """
    if wanted != AUTO:
        back_end = BACK_ENDS.load(wanted)
        _check_names(back_end, options)
        return Chosen(back_end, back_end.prepare(project, nodes, option_values(back_end, options)))
    candidates, notices = _candidates()
    reasons: list[tuple[BackEnd, str]] = []
    for back_end in candidates:
        try:
            deployment = back_end.prepare(project, nodes, option_values(back_end, options))
        except EnvironmentFault as fault:
            reasons.append((back_end, back_end.why_not(fault)))
            continue
        notices += [
            ("INFO", f"each node runs in {back_end.place}, not in {other.place}: {reason}")
            for other, reason in reasons
        ]
        return Chosen(back_end, deployment, notices)
    raise EnvironmentFault("\n".join(f"{other.name}: {reason}" for other, reason in reasons))


def _check_names(back_end: BackEnd, options: Mapping[str, Any]) -> None:
    known = [each.name for each in back_end.options]
    for name in options:
        if name not in known:
            raise UsageError(
                f"the back end {back_end.name} has no option '{name}':"
                f" {', '.join(known) if known else 'it has none'}"
            )


def option_values(back_end: BackEnd, options: Mapping[str, Any]) -> dict[str, Any]:
    """The value of each option of a back end: what is given, the environment's, the default."""
    return {each.name: each.value(options.get(each.name)) for each in back_end.options}


def _candidates() -> tuple[list[BackEnd], list[Notice]]:
    """The back ends that ``auto`` tries, in this order, and notices on those that are broken."""
    found: list[tuple[int, BackEnd]] = []
    notices: list[Notice] = []
    for name in BACK_ENDS:
        try:
            back_end = BACK_ENDS.load(name)
        except EnvironmentFault as fault:
            notices.append(("WARN", str(fault)))
            continue
        if back_end.rank is not None:
            found.append((back_end.rank, back_end))
    return [each for _, each in sorted(found, key=lambda pair: -pair[0])], notices


def back_end_of(record: Mapping[str, Any]) -> BackEnd | None:
    """The back end of a run that is over, by its ``run.json``; ``None`` if it is not registered."""
    try:
        return BACK_ENDS.load(record.get("backend", ""))
    except NeurosError:
        return None


def ran_in_one_process(record: Mapping[str, Any]) -> bool:
    """Whether all nodes of a run shared a process; records of earlier versions do not say."""
    if "is_one_process" in record:
        return bool(record["is_one_process"])
    back_end = back_end_of(record)
    return back_end is not None and back_end.is_one_process
