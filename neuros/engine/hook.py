"""One hook of a running node: its readiness, its counters and the check of its results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from neuros.engine.connection_ends import HookInput, SendWindow
from neuros.engine.metrics import TickIntervals
from neuros.engine.node_ports import Output
from neuros.errors import HookError, WrongValue
from neuros.hooks import HookKind, HookSpec, OutputSpec
from neuros.project.suggest import counted

_SEVERAL = (tuple, list)  # each use of a union would create it anew


class Hook:
    """A hook and its state. Counters keep its readiness up to date.

    Attributes:
        blocked: number of its blocked send windows.
        is_due: False for a tick between due times, and for a source with nothing to send.
        is_enabled: whether the phase of the node lets the hook run.
        turn: grows in the order of priority: least recently executed first.
        candidates: of the whole node, the hooks that are enabled, due and have all inputs; each
            hook and its inputs add and remove it.
        is_open: whether it is enabled and due.
        lacking: the number of inputs that lack a packet.
        consumers: by input, what returns the argument for a start.
        drives: whether it starts again and again without a packet: a tick, or a main loop.
        executions: their number.
        busy_ns: their duration in all.
        ticks: the intervals between starts, of a hook with a period.
    """

    __slots__ = (
        "_is_due",
        "_is_enabled",
        "_results",
        "_single",
        "_windows",
        "blocked",
        "busy_ns",
        "candidates",
        "consumers",
        "drives",
        "due_ns",
        "executions",
        "inputs",
        "is_open",
        "lacking",
        "loops",
        "missed_ticks",
        "name",
        "outputs",
        "period_ns",
        "spec",
        "ticks",
        "turn",
    )

    def __init__(
        self, spec: HookSpec, inputs: Sequence[HookInput], outputs: Mapping[str, Output]
    ) -> None:
        self.spec = spec
        self.name = spec.name
        self.inputs = tuple(inputs)
        self.consumers = tuple(each.consumer() for each in inputs)
        self.outputs = tuple(outputs[port.name] for port in spec.outputs)
        self._windows = tuple(window for output in self.outputs for window in output.windows)
        self._results = tuple((outputs[port.name], port.is_optional) for port in spec.outputs)
        # The output and its type, of a hook with one.
        types = tuple((o, o.packet_type) for o in self.outputs if o.packet_type is not None)
        self._single = types[0] if len(types) == len(self.outputs) == 1 else None
        is_main_loop = all(port.is_optional for port in spec.inputs)
        self.drives = spec.kind is HookKind.TICK or (
            spec.kind is HookKind.FUNCTION and is_main_loop
        )
        self.blocked = 0
        self.turn = 0
        self.candidates: set[Hook] = set()
        self._is_due = spec.period_s is None
        self._is_enabled = self.is_open = False
        self.lacking = sum(hook_input.missing > 0 for hook_input in self.inputs)
        for hook_input in self.inputs:
            hook_input.hook = self
        self.executions = 0
        self.busy_ns = 0
        self.due_ns = 0
        self.missed_ticks = 0
        self.period_ns = 0 if spec.period_s is None else max(1, round(spec.period_s * 1e9))
        self.ticks = TickIntervals(self.period_ns) if self.period_ns else None
        # The connections from this hook to itself.
        self.loops = tuple(
            (window, hook_input, queue)
            for window in self._windows
            for hook_input in self.inputs
            for queue in hook_input.queues
            if queue.subscription.key is window.connection
        )
        for window in self._windows:
            window.hooks.append(self)
            self.blocked += window.is_blocked

    @property
    def is_due(self) -> bool:
        """Whether the timer lets the hook run."""
        return self._is_due

    @is_due.setter
    def is_due(self, is_due: bool) -> None:
        self._is_due = is_due
        self._update_candidates()

    @property
    def is_enabled(self) -> bool:
        """Whether the phase of the node lets the hook run."""
        return self._is_enabled

    @is_enabled.setter
    def is_enabled(self, is_enabled: bool) -> None:
        self._is_enabled = is_enabled
        self._update_candidates()

    def windows(self) -> list[SendWindow]:
        """Every connection that the hook may send on."""
        return list(self._windows)

    def is_ready(self) -> bool:
        """Whether the hook may start now, by inputs, outputs, timer and the node's phase."""
        return self.is_open and not self.lacking and self.can_send()

    def can_send(self) -> bool:
        """Whether no send window is blocked, but by packets that its own start would consume."""
        if not self.blocked:
            return True
        return bool(self.loops) and len(self._freed_windows()) == self.blocked

    def awaited_input(self) -> HookInput | None:
        """The first required input without a packet, if the hook waits for inputs alone."""
        if self.lacking and self.is_open:
            for hook_input in self.inputs:  # next() over a generator takes thrice as long
                if hook_input.missing:
                    return hook_input
        return None

    def blocking_windows(self) -> list[SendWindow]:
        """The send windows that keep the hook from running."""
        freed = self._freed_windows() if self.loops else ()
        return [window for window in self._windows if window.is_blocked and window not in freed]

    def has_reliable_packet(self) -> bool:
        """Whether a packet of a reliable connection waits for the hook."""
        return any(hook_input.has_reliable_packet() for hook_input in self.inputs)

    def set_due(self, start_ns: int, now_ns: int) -> None:
        """Set the next due time, ``start + k * period`` after now; passed ones coalesce."""
        ticks_passed = (now_ns - start_ns) // self.period_ns
        if self.due_ns:
            self.missed_ticks += ticks_passed - (self.due_ns - start_ns) // self.period_ns
        self.due_ns = start_ns + (ticks_passed + 1) * self.period_ns
        self.is_due = False

    def postpone(self, duration_ns: int) -> None:
        """Move the next due time of a tick by a duration that does not count."""
        self.due_ns += duration_ns
        if self.ticks is not None:
            self.ticks.skip(duration_ns)

    def packets_of(self, result: Any) -> Sequence[tuple[Output, Any]]:
        """The packets to be sent for the result of the hook, each with its output.

        Raises:
            HookError: if the count, a type or a value is wrong, or a required packet is missing.
        """
        results = self._results
        single = self._single
        if single is not None and isinstance(result, single[1].kind):  # the result of most hooks
            try:
                return ((single[0], single[1].check(result)),)
            except WrongValue as error:
                raise self._wrong_value(single[0], error) from None
        packets: Sequence[Any]
        if not results:
            if result is not None:
                raise self.error(f"returned {_kind(result)}, but declares no outputs")
            return ()
        if result is None:
            packets = (None,) * len(results)
        else:
            packets = result if isinstance(result, _SEVERAL) else (result,)
        if len(packets) != len(results) == 1 and self.outputs[0].port.array:
            raise self._no_packet(self.outputs[0], result)
        if len(packets) != len(results):
            names = ", ".join(output.port.name for output in self.outputs)
            raise self.error(
                f"returned {counted(len(packets), 'packet')}, but declares"
                f" {counted(len(results), 'output')} ({names})"
            )
        found = []
        for (output, is_optional), packet in zip(results, packets):  # noqa: B905, it costs time
            if packet is None:
                if not is_optional:
                    raise self.error(
                        f"returned no packet for output '{output.port.name}': return one, or"
                        f' declare it as Optional("{output.port.name}")'
                    )
                continue
            wanted = output.packet_type
            if wanted is None:
                found.append((output, packet))
                continue
            if not isinstance(packet, wanted.kind):
                raise self._no_packet(output, packet)
            try:
                found.append((output, wanted.check(packet)))
            except WrongValue as error:
                raise self._wrong_value(output, error) from None
        return found

    def error(self, text: str) -> HookError:
        """A ``HookError`` with the name and line of this hook."""
        return HookError(text, hook=self.name, where=self.spec.where)

    def _wrong_value(self, output: Output, error: WrongValue) -> HookError:
        return self.error(f"packet for output '{output.port.name}': {error}")

    def _no_packet(self, output: Output, found: object) -> HookError:
        """The error for something that is no packet of an output."""
        port = output.port
        make = f", or numpy.asarray(values, '{port.array.dtype}')" if port.array else ""
        return self.error(
            f"returned {_kind(found)} for output '{port.name}', which carries {port.type}:"
            f' use node.make_packet("{port.name}"){make}'
        )

    def _update_candidates(self) -> None:
        self.is_open = self._is_enabled and self._is_due
        if self.is_open and not self.lacking:
            self.candidates.add(self)
        else:
            self.candidates.discard(self)

    def _freed_windows(self) -> list[SendWindow]:
        """The blocked send windows that a start of the hook would free: loops to itself."""
        return [
            window
            for window, hook_input, queue in self.loops
            if window.is_blocked
            and hook_input.would_consume(queue)
            and window.frees(queue.subscription.position_if_consumed(queue))
        ]


class Source(Hook):
    """A hook in the place of a thread (of a simulator), which offers packets for its outputs.

    A source is due while it holds offers, which it sends in their order. ``where``: the plugin's
    file.
    """

    __slots__ = ("_accepted", "_offers", "_where")

    def __init__(self, names: Sequence[str], outputs: Mapping[str, Output], where: str) -> None:
        spec = HookSpec(HookKind.FUNCTION, _nothing, (), tuple(OutputSpec(name) for name in names))
        super().__init__(spec, (), outputs)
        self.name = f"submit({', '.join(names)})"
        self._where = where
        self._offers: dict[object, tuple[Sequence[Any], Callable[[], None]]] = {}
        self._accepted: Callable[[], None] = _nothing
        self.is_due = False

    def offer(self, packets: Sequence[Any], accepted: Callable[[], None]) -> Callable[[], None]:
        """Add packets, one per output; returns a function that withdraws them."""
        ticket = object()
        self._offers[ticket] = (packets, accepted)
        self.is_due = True

        def withdraw() -> None:
            self._offers.pop(ticket, None)
            self.is_due = bool(self._offers)

        return withdraw

    def consume(self) -> Sequence[Any]:
        """Remove and return the packets of the oldest offer."""
        packets, self._accepted = self._offers.pop(next(iter(self._offers)))
        self.is_due = bool(self._offers)
        return packets

    def accept(self) -> None:
        """Report that the packets removed last have been sent."""
        accepted, self._accepted = self._accepted, _nothing
        accepted()

    def error(self, text: str) -> HookError:
        """A ``HookError``; an offer comes from no line of the plugin, but from its file."""
        return HookError(text, hook=self.name, where=self._where)


def _nothing() -> None:
    """The function of a source, and the callback of no offer."""


def _kind(value: object) -> str:
    kind = type(value)
    return kind.__name__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__name__}"
