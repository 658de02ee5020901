"""Observers of a run: programs on its control channel that may pause, step and end it.

They see what nodes show when asked (they ask while a user looks), and take no part in the
run: when the last one has gone, a run that was paused goes on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from neuros.control import Lines
from neuros.launcher.channels import Channels
from neuros.launcher.outcome import Outcome, Output, Phase


class Pause:
    """The pause of a run, and the time that it has been paused in all.

    Args:
        send: to all nodes.
        clock: monotonic, seconds.
    """

    def __init__(self, send: Callable[..., object], clock: Callable[[], float]) -> None:
        self._send = send
        self._clock = clock
        self._since_s: float | None = None
        self._before_s = 0.0

    @property
    def is_on(self) -> bool:
        """Whether the run stands still."""
        return self._since_s is not None

    @property
    def since_s(self) -> float | None:
        """Since when it stands still, on the clock."""
        return self._since_s

    @property
    def total_s(self) -> float:
        """Seconds of pause so far."""
        since_s = self._since_s
        return self._before_s + (0.0 if since_s is None else self._clock() - since_s)

    def begin(self) -> None:
        """Let no hook start."""
        if self._since_s is None:
            self._since_s = self._clock()
            self._send("pause")

    def end(self) -> None:
        """Let the run go on."""
        if self._since_s is not None:
            self.forget()
            self._send("resume")

    def forget(self) -> None:
        """The pause is over without a request: nodes that drain go on by themselves."""
        self._before_s, self._since_s = self.total_s, None

    def step(self, count: int, *, is_driven: bool) -> None:
        """Let a run that stands still do so many steps."""
        if self._since_s is not None and count > 0:
            self._send("step", count=count, is_driven=is_driven)


class Observers:
    """The observers of one run.

    Args:
        is_driven: whether some node starts hooks unasked, and so drives the project.
        end: ends the run, drained: ``end(reason)``.
    """

    def __init__(
        self,
        channels: Channels,
        pause: Pause,
        is_driven: Callable[[], bool],
        end: Callable[[str], None],
    ) -> None:
        self._channels = channels
        self._pause = pause
        self._is_driven = is_driven
        self._end = end
        self._lines: dict[int, Lines] = {}  # by their numbers, which are not given out again
        self._count = 0
        self._told: tuple[str, bool] | None = None
        self.handlers: dict[str, Callable[[Lines, Mapping[str, Any]], None]] = {
            "watch": self._on_watch,
            "look": self._on_look,
            "node_status": self._on_node_status,
            "pause": lambda *_: pause.begin(),
            "resume": lambda *_: pause.end(),
            "step": self._on_step,
            "end": lambda _, message: end(str(message["reason"])),
        }

    def tell(self, kind: str, **fields: Any) -> None:
        """Send to all observers."""
        for lines in self._lines.values():
            self._channels.send_to(lines, kind, **fields)

    def look_at(self, phase: Phase) -> None:
        """Tell them of a change of phase; if the last one has gone, end a pause."""
        if phase is not Phase.RUNNING and self._pause.is_on:
            self._pause.forget()
        if not self._lines:
            return
        self._lines = {n: lines for n, lines in self._lines.items() if self._channels.has(lines)}
        if not self._lines:
            self._pause.end()
        now = (phase.value, self._pause.is_on)
        if now != self._told:
            self._told = now
            self.tell("phase", phase=now[0], is_paused=now[1])

    def part(self, outcome: Outcome) -> None:
        """Tell them how it has ended."""
        self.tell(
            "ended",
            exit_code=outcome.exit_code,
            reason=outcome.reason,
            reports=outcome.reports,
            running_s=outcome.running_s,
        )

    def _on_watch(self, lines: Lines, _: Mapping[str, Any]) -> None:
        self._count += 1
        self._lines[self._count] = lines
        self._told = None

    def _on_look(self, asking: Lines, message: Mapping[str, Any]) -> None:
        for number, lines in self._lines.items():
            if lines is asking:
                self._channels.send("look", wanted=message["wanted"], asker=number)

    def _on_node_status(self, _: Lines, message: Mapping[str, Any]) -> None:
        lines = self._lines.get(message["asker"])
        if lines is not None:
            self._channels.send_to(lines, **message)

    def _on_step(self, _: Lines, message: Mapping[str, Any]) -> None:
        self._pause.step(int(message["count"]), is_driven=self._is_driven())


class Overheard:
    """An output for people whose records observers see, too: ``tell(kind, **fields)``."""

    def __init__(self, output: Output, tell: Callable[..., object]) -> None:
        self._output = output
        self._tell = tell

    def log(self, severity: str, text: str) -> None:
        self._output.log(severity, text)
        self._tell("log", severity=severity, text=text)

    def poll(self) -> object:
        return self._output.poll()
