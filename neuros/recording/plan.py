"""Recording plan: the file in the run folder that tells nodes and recorder what to record."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from neuros.errors import UsageError

PLAN_NAME = "recording.json"
BAG_NAME = "bag"
LISTENER = ".listener"
"""Folder of the packets that no node sees; it is named like none can be."""

_VERSION = 1


@dataclass(frozen=True)
class Topic:
    """A topic of the bag.

    Attributes:
        name: as on the ROS graph.
        type: in ROS notation.
        is_reliable, depth, is_latched: of the quality of service that its sender offers.
        connection: ``a.out -> b.in``, or ``None`` for an external topic.
    """

    name: str
    type: str
    is_reliable: bool = True
    depth: int = 10
    connection: str | None = None
    is_latched: bool = False


@dataclass(frozen=True)
class Stream:
    """Packets that one node keeps: how they pass it (``neuros.ports.Way``), and the topics that
    they belong to, by their places in the plan."""

    way: str
    name: str
    topics: tuple[int, ...]


@dataclass(frozen=True)
class RecordingPlan:
    """All that is recorded of a run.

    Attributes:
        streams: by node, in the order of the numbers that they have in its spool.
        listen: topics that the recorder subscribes to itself.
        wanted: those of them that were asked for by name.
        time_owner: the one node that owns simulated time; ``None`` if none or several do.
        custom: for the metadata of the bag.
    """

    storage: str
    topics: tuple[Topic, ...]
    streams: Mapping[str, tuple[Stream, ...]]
    listen: tuple[str, ...] = ()
    wanted: tuple[str, ...] = ()
    time_owner: str | None = None
    custom: Mapping[str, str] = field(default_factory=dict)

    def save(self, run: Path) -> None:
        """Write it into the run folder. Raises ``OSError``."""
        content = {"version": _VERSION, **asdict(self)}
        (run / PLAN_NAME).write_text(json.dumps(content, indent=2) + "\n", "utf-8")


def load_plan(run: Path) -> RecordingPlan:
    """The plan of a run.

    Raises:
        UsageError: if there is none, or this version of NeuROS cannot read it.
    """
    path = run / PLAN_NAME
    try:
        content: dict[str, Any] = json.loads(path.read_text("utf-8"))
        version = content.pop("version")
        if version != _VERSION:
            raise UsageError(
                f"{path} is of version {version}, and this NeuROS reads version {_VERSION}"
            )
        content["topics"] = tuple(Topic(**topic) for topic in content["topics"])
        content["streams"] = {
            node: tuple(Stream(s["way"], s["name"], tuple(s["topics"])) for s in streams)
            for node, streams in content["streams"].items()
        }
        for key in ("listen", "wanted"):
            content[key] = tuple(content[key])
        return RecordingPlan(**content)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise UsageError(_why_no_plan(run)) from error
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UsageError(f"{path} is damaged: {error}") from error


def _why_no_plan(run: Path) -> str:
    """Say why a path is no folder of a recorded run."""
    if not run.exists():
        return f"{run}: there is no such file or folder"
    if not run.is_dir():
        return f"{run} is a file: give the folder of a run, or of a bag (with metadata.yaml)"
    if (run / "run.json").exists() or any(run.glob("*/node.json")):
        return f"{run} was not recorded: launch the project with -r, or name topics with -t"
    files = sorted(each.name for pattern in ("*.mcap", "*.db3") for each in run.glob(pattern))
    if files:
        return f"{run} has {files[0]}, but no metadata.yaml: `ros2 bag reindex` writes it anew"
    return f"{run} is the folder of neither a run nor a bag: it has no run.json, no metadata.yaml"
