"""Runs the real plugin on the real engine, on what a run has recorded of it."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from neuros.core.engine import Engine
from neuros.core.journal import is_whole
from neuros.core.replay import Player, ReplayedEngine, ReplayOver, ReplayParted, Script
from neuros.errors import NeurosError
from neuros.hooks import HookSpec
from neuros.observe.recorded_node import RecordedNode
from neuros.project.model import Connection, NodeFile
from neuros.replay.comparison import Comparison
from neuros.replay.debugging import is_quit
from neuros.runtime.node import NodeRuntime
from neuros.runtime.scope import Stage
from neuros.transport.alone import Alone, HeldLoop
from neuros.transport.messages import decode, message_class

_LOOK_S = 0.1

Around = Callable[[Callable[[], None], Sequence[HookSpec]], None]
"""Runs an action, given the hooks of the plugin."""


class ReplayedNode:
    """One node of a run.

    Attributes:
        comparison: of what it sends.
        failure: what has ended it, ``None`` so far.
        notes: what the user should know.
        difference: where it has left the way of the run, in a sentence; ``None`` so far.
    """

    def __init__(self, file: NodeFile, recorded: RecordedNode) -> None:
        self._file, self._recorded = file, recorded
        self._script = Script(recorded.journal)
        self._loop = HeldLoop(self._script.deliveries.append, self._note_loop_back)
        self._middleware = Alone(file, self._loop)
        lacking = recorded.lacking()
        self.comparison = Comparison(recorded.sent(), recorded.message, lacking)
        self.failure: NeurosError | None = None
        self.notes = [
            f"the bag has {there} of {sent} packets on {name}: the others are not compared"
            for name, (there, sent) in lacking.items()
        ]
        self.difference: str | None = None
        self._is_cut_off = False
        self._runtime = NodeRuntime(
            file,
            self._middleware,
            Stage(),
            tell=lambda *_, **__: None,
            fail=self._fail,
            tap=self.comparison,
            log_file=None,
            duration_sim_s=None,
            make_engine=partial(ReplayedEngine, self._script),
        )
        self._types = {
            str(c): file.node.input(c.destination_input).type
            for c in file.connections
            if c.destination_node == file.node.name
        } | {port.name: port.type for port in file.node.inputs}

    @property
    def starts(self) -> int:
        return self._script.started

    @property
    def expects_start(self) -> bool:
        """Whether more hooks have started in the run."""
        return self._script.expects_start

    @property
    def has_outputs(self) -> bool:
        """Whether the node can send anything to anybody."""
        name = self._file.node.name
        is_sender = any(c.source_node == name for c in self._file.connections)
        return is_sender or any(port.external_topic for port in self._file.node.outputs)

    def run(self, around: Around) -> None:
        """Replay to the end of what was recorded, or the first difference."""
        try:
            self._runtime.load()
        except NeurosError as error:
            self._fail(self._file.node.name, error)
        if self.failure is None:
            around(self._play, self._runtime.specs)
        with suppress(KeyboardInterrupt):
            self._runtime.finalise()
        self._middleware.close()

    # ------------------------------------------------------------------ source

    def packet(self, key: Connection | str, number: int) -> Any:
        """The packet that arrived as the ``number``-th on a connection or external topic."""
        data = self._recorded.arrived(key, number)
        if data is None:
            self.notes.append(
                f"the bag ends before packet {number} that arrived on {key}: the replay ends there"
            )
            self._is_cut_off = True
            raise ReplayOver
        return decode((message_class(self._types[str(key)]), data))

    def offer(self) -> None:
        """Wait for packets from the plugin's thread, and offer them to the engine."""
        self._engine.has_offer = False
        while not self._engine.has_offer:
            try:
                event = self._loop.from_threads.get(timeout=_LOOK_S)
            except queue.Empty:
                if _has_threads():
                    continue
                raise ReplayParted(
                    "a thread of the plugin sent packets in the run, and none does in the replay"
                ) from None
            event()

    # ------------------------------------------------------------------ inside

    @property
    def _engine(self) -> ReplayedEngine:
        engine: Engine | None = self._runtime.engine
        assert isinstance(engine, ReplayedEngine)
        return engine

    def _note_loop_back(self, event: Callable[[], None]) -> None:
        self._script.loop_back = event

    def _play(self) -> None:
        player = Player(self._script, self._engine, self._runtime, self)
        try:
            for event in self._script.events():
                player.play(event)
                if self.failure is not None or self.comparison.difference is not None:
                    break
            else:
                self._end()
        except ReplayOver:
            self._end()
        except ReplayParted as parted:
            self.difference = str(parted)
        if self.comparison.difference is not None:
            self.difference = self.comparison.difference

    def _end(self) -> None:
        """The journal is at its end."""
        if not is_whole(self._recorded.journal):
            self.notes.append(
                f"the run's list of what happened to the node ends after {self.starts} starts of"
                " hooks (it was killed, or ran for very long): what it sent later is not compared"
            )
        elif self._is_cut_off:
            return
        elif self._script.expects_start:
            self.difference = (
                f"{self.starts} hooks have started, and more did in the run: a hook is not ready"
                " where it was"
            )
        else:
            self.comparison.find_missing()

    def _fail(self, _: str, error: NeurosError) -> None:
        self.failure = error
        if not is_quit(error):
            self._runtime.failures.log(error)


def _has_threads() -> bool:
    """Whether a thread besides this one is there."""
    return threading.active_count() > 1


def files_changed_since(run_folder: Path, file: NodeFile) -> list[Path]:
    """The plugin, and Python files beside it, that were changed after the run had begun."""
    begun = (run_folder / "project.json").stat().st_mtime
    beside = sorted(file.node.plugin.parent.glob("*.py"))
    return [path for path in beside if path.stat().st_mtime > begun]
