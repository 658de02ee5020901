"""Options of ``neuros launch`` and ``neuros export``, which are arguments of the Python API, too.

Each field declares its flag, its argument, its help, and whether ``run.json`` has its value.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from neuros.errors import UsageError
from neuros.options import option, options_of, positive_number, positive_seconds
from neuros.project.model import bytes_of
from neuros.project.timing import REAL, VIRTUAL

if TYPE_CHECKING:
    from neuros.recording.recording_plan import RecordingRequest

_RECORDING = "recording: NAME is a topic, an output (node.output) or a connection; * stands for any"


def _back_ends() -> Iterable[str]:
    from neuros.registry import AUTO, BACK_ENDS

    return [AUTO, *BACK_ENDS]


@dataclass(frozen=True, kw_only=True)
class ProjectOptions:
    """Changes to a project, for every command that reads one."""

    set: Mapping[str, Any] | Sequence[str] | None = option(
        "--set",
        is_repeatable=True,
        metavar="PATH=VALUE",
        help="change a key of the project: nodes.NAME.KEY...=VALUE,"
        " connections.SRC.OUT.DST.IN.KEY=VALUE or budgets.KEY=VALUE; VALUE is read as JSON, or as"
        " text if it is no JSON; in environment it is always text; PATH= without a VALUE removes"
        " the key",
    )
    namespace: str | None = option(
        "--namespace",
        metavar="NS",
        default_help="the project's",
        page="external_nodes.md#two-copies-of-a-project",
        help="run in this namespace of the ROS graph, such as /left, so that two copies of a"
        " project can share a domain; / removes the namespace that the project sets",
    )
    remap: Sequence[str] = option(
        "--remap",
        is_repeatable=True,
        metavar="FROM:=TO",
        help="rename an external topic, or a topic or service of a plugin, as in ROS;"
        " NODE:FROM:=TO renames it for one node only",
    )
    time: str | None = option(
        "--time",
        choices=(REAL, VIRTUAL),
        default_help="the project's",
        page="time.md#virtual-time",
        help="the clock of the run: that of the machine, or one that only declared durations of"
        " hooks and delays of connections move on, so that the run can be repeated exactly",
    )
    timing: str | os.PathLike[str] | None = option(
        "--timing",
        metavar="FILE",
        page="time.md#virtual-time",
        help="replace durations and delays of the project in virtual time by those of this file",
    )


@dataclass(frozen=True, kw_only=True)
class Request(ProjectOptions):
    """How to run a project.

    Raises:
        UsageError: for wrong values.
    """

    nodes: Sequence[str] = option(
        "-n",
        "--node",
        is_repeatable=True,
        metavar="NAME",
        default_help="all",
        help="start only this node; the others may run elsewhere",
    )
    domain_id: int | None = option(
        "-d",
        "--domain-id",
        parse=int,
        metavar="ID",
        page="command_line.md#ros-domain",
        default_help="ROS_DOMAIN_ID; else 0 for a project with external topics, or with -n or"
        " --network; else the first free domain from 1 to 101",
        help="use this ROS domain",
    )
    network: bool = option(
        "--network",
        default=False,
        page="network.md",
        help="also connect to nodes on other machines; every machine of the network can then read"
        " and send packets of the run",
    )
    peers: str | None = option(
        "--peers",
        metavar="HOST,...",
        page="network.md",
        help="name the other machines, by address or name, where multicast does not reach them;"
        " implies --network",
    )
    peer_timeout: int | None = option(
        "--peer-timeout",
        parse=positive_number,
        metavar="SECONDS",
        default_help="wait for ever",
        page="network.md#how-it-ends",
        help="end with exit code 4 if a node that runs elsewhere, and that a connection leads to,"
        " was not found within this time",
    )
    deployment: str | os.PathLike[str] | None = option(
        "--deployment",
        metavar="FILE",
        is_recorded=False,
        page="network.md",
        help="run nodes on the machines that this file gives them, over ssh; all other nodes, and"
        " all other processes of the run, stay on this machine",
    )
    isolate: bool = option(
        "--isolate",
        default=False,
        page="security.md#a-network-of-the-runs-own",
        help="give the run a network of its own, so that no other program of this machine can read"
        " or send its packets; not possible with nodes elsewhere or with external inputs; from"
        " Python, only with the back end docker",
    )
    backend: str | None = option(
        "--backend",
        default="auto",
        variable="NEUROS_BACKEND",
        suggestions=_back_ends,
        metavar="NAME",
        page="back_ends.md",
        help="run nodes on this back end: each in a container (docker), each in a process"
        " (process), or all in one process (in-process); auto: docker where an engine has the"
        " images, else process; other Python packages may add back ends",
    )
    backend_options: Mapping[str, Any] | None = option(
        page="back_ends.md",
        help="options of the back end, by name; on the command line they are flags",
    )
    duration: float | str | None = option(
        "--duration",
        metavar="SECONDS",
        default_help="no limit",
        help="end the run this long after its first hook started, and let packets under way"
        " arrive: 30 means seconds, 30sim simulated seconds",
    )
    real_time_factor: float | None = option(
        "--real-time-factor",
        parse=positive_seconds,
        metavar="FACTOR",
        default_help="as fast as the machine allows",
        page="time.md#virtual-time",
        help="let at most this many seconds of virtual time pass per second of the machine",
    )
    output: str | os.PathLike[str] | None = option(
        "-o",
        "--output",
        metavar="DIR",
        default_help="runs/<project>/<utc time> in the current folder",
        is_recorded=False,
        help="write the run into this folder, which must be new or empty",
    )
    restore: Mapping[str, Any] | Sequence[str] = option(
        "--restore",
        is_repeatable=True,
        metavar="NODE.NAME=RUN",
        is_recorded=False,
        page="plugins.md#what-is-kept",
        help="give back to a node what its plugin has kept by this name in an earlier run (see"
        " node.keep); RUN is the folder of that run, or a file",
    )
    finalise_s: float | None = option(
        "--finalise-s",
        parse=positive_seconds,
        metavar="SECONDS",
        default_help="the project's; 5",
        page="plugins.md#finalising",
        help="kill a node only if it has made no progress with its finalise hooks for this long",
    )
    placement: bool = option(
        "--no-placement",
        default=True,
        page="placement.md",
        help="ignore affinity: the kernel chooses the cores of every node",
    )
    portable: bool | None = option(
        "--portable",
        is_negatable=True,
        default_help="the project's; off",
        page="deterministic_runs.md#on-another-processor",
        help="fix what glibc, NumPy, OpenBLAS and MKL choose by the processor, and numbers of"
        " threads, so that a deterministic run has the same packets on every x86-64 machine with"
        " the same libraries; linear algebra is slower",
    )
    monitor_system_load: bool = option(
        "-m",
        "--monitor-system-load",
        default=False,
        page="command_line.md#system-load",
        help="write the load of the machine and of each node to system_load.csv in the run"
        " folder, once per second: processor, memory, network, threads",
    )
    digests: bool = option(
        "--digests",
        default=False,
        page="command_line.md#neuros-verify",
        help="keep a digest of every packet, for `neuros verify`. All back ends but in-process"
        " always do that. In-process must serialise packets for it; without this option, it keeps"
        " digests only if all connections are lossless and digests take under 2 %% of the"
        " processor time",
    )
    packet_log: str = option(
        "--packet-log",
        default="1g",
        metavar="SIZE",
        page="command_line.md#latency-and-digests",
        help="keep times and digests of the newest packets, in files of at most this size for the"
        " whole run, such as 512m or 2g; 0 keeps none, so that there is no latency and nothing for"
        " `neuros verify`",
    )
    record: bool | Sequence[str] = option(
        "-r",
        "--record",
        default=False,
        group=_RECORDING,
        page="recording.md",
        help="record every connection, the external topics and /clock into RUN/bag",
    )
    topics: Sequence[str] = option(
        "-t",
        "--topic",
        is_repeatable=True,
        metavar="NAME",
        group=_RECORDING,
        page="recording.md",
        help="record this topic, of the project or not; without -r, only the topics of -t are"
        " recorded",
    )
    exclude: Sequence[str] = option(
        "--exclude",
        is_repeatable=True,
        metavar="NAME",
        group=_RECORDING,
        help="do not record this topic",
    )
    flush_interval: float = option(
        "--flush-interval",
        parse=positive_seconds,
        default=1.0,
        metavar="SECONDS",
        group=_RECORDING,
        page="recording.md#what-to-record",
        help="bring packets to the disk in this interval; a power failure loses those since the"
        " last one",
    )
    progress: bool | None = option(
        "--progress",
        is_negatable=True,
        is_recorded=False,
        default_help="on if the run has a known end",
        page="command_line.md#progress",
        help="show the progress of the run: in a terminal on the last line, elsewhere on a new"
        " line every 10 s",
    )
    verbose: bool = option(
        "-v",
        "--verbose",
        default=False,
        is_recorded=False,
        help="also show log records of the severity DEBUG",
    )

    def __post_init__(self) -> None:
        for each in options_of(self):
            given = getattr(self, each.name)
            if each.is_repeatable and isinstance(given, str):
                object.__setattr__(self, each.name, (given,))
            elif given is None and each.variable:
                object.__setattr__(self, each.name, each.value(None))
            elif given is not None and each.parse is positive_seconds:
                try:
                    positive_seconds(str(given))
                except ValueError:
                    text = f"{each.all_flags[0]} {given}: give a number above 0"
                    raise UsageError(text) from None
        _ = self.end, self.recording, self.packet_log_bytes  # to raise their errors

    @property
    def end(self) -> Duration:
        """When to end the run."""
        return parse_duration(self.duration)

    @property
    def packet_log_bytes(self) -> int:
        """The largest size of all packet logs of the run, in bytes; 0: none is kept."""
        if self.packet_log == "0" and self.digests:
            raise UsageError("--digests: --packet-log 0 keeps no digests; leave one of them out")
        try:
            return 0 if self.packet_log == "0" else bytes_of(self.packet_log)
        except ValueError:
            raise UsageError(
                f"--packet-log {self.packet_log}: give a whole number and its unit (k, m, g), as in"
                " 512m or 2g, or 0 for none"
            ) from None

    @property
    def recording(self) -> RecordingRequest | None:
        """The request for a recording, ``None``: nothing is recorded."""
        everything = self.record is True
        named = () if isinstance(self.record, bool) else self.record
        topics = (*((named,) if isinstance(named, str) else named), *self.topics)
        if not (everything or topics):
            if self.exclude:
                raise UsageError("--exclude: nothing is recorded; add -r, or name topics with -t")
            return None
        from neuros.recording.recording_plan import RecordingRequest

        return RecordingRequest(everything, topics, tuple(self.exclude), self.flush_interval)


@dataclass(frozen=True, kw_only=True)
class LaunchOptions(Request):
    """Options of the command line alone, besides those of every run."""

    dry_run: bool = option(
        "--dry-run",
        default=False,
        is_recorded=False,
        help="print what would be started, and start nothing",
    )


@dataclass(frozen=True)
class Duration:
    """Length of a run in wall or simulated seconds; without either, nodes end the run."""

    wall_s: float | None = None
    sim_s: float | None = None


def parse_duration(given: float | str | None) -> Duration:
    """Parse ``30``, ``0.5``, or ``30sim``.

    Raises:
        UsageError: for anything else.
    """
    if given is None:
        return Duration()
    match = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)(sim)?", str(given).strip())
    if match is None or float(match[1]) <= 0:
        raise UsageError(
            f"--duration {given}: give seconds, such as 30, or simulated seconds, such as 30sim"
        )
    seconds = float(match[1])
    return Duration(sim_s=seconds) if match[2] else Duration(wall_s=seconds)
