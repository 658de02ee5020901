"""What the recorder has heard itself: a spool like that of a node, and a list of its topics.

Which types and qualities of service these have is known only when somebody publishes; so the list
is written before the first packet of each, for whoever reads the spool.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from neuros.observe.recording.plan import LISTENER, Topic
from neuros.observe.recording.spool import NO_TIME, SpoolWriter

_LIST = "topics.json"


class ListenedSpool:
    """Keeps packets of topics that become known as the run goes on."""

    def __init__(self, run: Path) -> None:
        self._folder = run / LISTENER
        self._topics: list[Topic] = []
        self._spool = SpoolWriter(self._folder, ())

    def add(self, topic: Topic) -> int:
        """The number of a new topic. Raises ``OSError``."""
        self._topics.append(topic)
        self._folder.mkdir(exist_ok=True)
        text = json.dumps([asdict(each) for each in self._topics])
        new = self._folder / f"{_LIST}.new"
        new.write_text(text, "utf-8")
        new.replace(self._folder / _LIST)
        return len(self._topics) - 1

    def keep(self, number: int, wall_ns: int, data: bytes) -> None:
        """Keep a packet. Raises ``OSError``."""
        self._spool.append(wall_ns, NO_TIME, number, data)

    def close(self) -> None:
        """Keep nothing any more."""
        self._spool.close()


def listened_topics(run: Path) -> list[Topic]:
    """The topics that have been heard so far, in the order of their numbers."""
    try:
        return [Topic(**each) for each in json.loads((run / LISTENER / _LIST).read_text("utf-8"))]
    except FileNotFoundError:
        return []


def forget_listened(run: Path) -> None:
    """Remove the list; its spool must have been removed before."""
    for name in (_LIST, f"{_LIST}.new"):
        (run / LISTENER / name).unlink(missing_ok=True)
    if (run / LISTENER).is_dir():
        (run / LISTENER).rmdir()
