"""Stepper of NEST: simulated time is a whole number of its steps, so that nothing drifts."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from types import ModuleType, TracebackType
from typing import Any

from neuros.snn.kernel import KernelInUse, import_nest

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000


class PartialDelayWarning(UserWarning):
    """A step is a whole number of the resolution, but not of the shortest delay."""


@dataclass(frozen=True)
class StepGrid:
    """Lengths that a step may have.

    Args:
        resolution_ns: the simulator's own step, in nanoseconds.
        min_delay_ns: the shortest delay of the network, a whole number of resolutions: so often its
            spikes are exchanged.

    Raises:
        ValueError: the delay is not a whole number of resolutions, or one of them is not above 0.
    """

    resolution_ns: int
    min_delay_ns: int

    def __post_init__(self) -> None:
        if self.resolution_ns <= 0 or self.min_delay_ns <= 0:
            raise ValueError(f"resolution and delay must be above 0 ns: got {self}")
        if self.min_delay_ns % self.resolution_ns:
            raise ValueError(
                f"a delay of {self.min_delay_ns} ns is not a whole number of {self.resolution_ns}"
            )

    def steps(self, duration_ns: int) -> int:
        """So many resolutions make up a duration.

        Raises ``ValueError``, with the nearest lengths that do, where that is no whole number.
        """
        steps, rest_ns = divmod(duration_ns, self.resolution_ns)
        if steps < 1 or rest_ns:
            raise ValueError(self._refusal(duration_ns, self.resolution_ns, "the resolution"))
        return steps

    def partial_delay(self, duration_ns: int) -> str:
        """The complaint about a step of no whole number of shortest delays; empty if it is one."""
        if duration_ns % self.min_delay_ns == 0:
            return ""
        return self._refusal(duration_ns, self.min_delay_ns, "the shortest delay")

    @staticmethod
    def _refusal(duration_ns: int, unit_ns: int, name: str) -> str:
        below = max(0, duration_ns) // unit_ns * unit_ns
        near = [f"{length / NS_PER_MS:g} ms" for length in (below, below + unit_ns) if length > 0]
        return (
            f"a step of {duration_ns / NS_PER_MS:.9g} ms is not a whole number of "
            f"{unit_ns / NS_PER_MS:g} ms, {name}: {' and '.join(near)} "
            f"{'are' if len(near) > 1 else 'is'}"
        )


def nanoseconds(seconds: float) -> int:
    """The whole nanoseconds nearest to a duration. Exact for every multiple of 1 ns up to 52 days.

    Raises ``ValueError`` where it is not finite.
    """
    if not math.isfinite(seconds):
        raise ValueError(f"a duration must be finite: got {seconds!r} s")
    return round(seconds * NS_PER_S)


def nanoseconds_of_ms(milliseconds: float) -> int:
    """The whole nanoseconds nearest to a duration in milliseconds, as NEST counts."""
    return round(milliseconds * NS_PER_MS)


class Stepper:
    """Simulates the network that has been built, in steps of simulated time.

    ::

        nest = reset_kernel(seed=1)
        ...                                   # Create, Connect
        with Stepper() as stepper:            # or close() at the end
            stepper.advance_s(0.02)
            stepper.advance_to_ns(stamp_ns)

    Time is counted in whole steps of NEST's resolution, as integers: after hours of steps of 20 ms
    it is where it should be, to the nanosecond. A step that is no whole number of resolutions is an
    error, before anything is simulated.

    **Steps and delays.** Spikes are exchanged once per shortest delay of the network
    (``min_delay``). Steps of whole delays give the spikes of one long step, bit for bit. A step
    that ends between two exchanges changes the order in which the sources of randomness draw their
    numbers: the spikes are other ones, as right as those of another seed, but they then depend on
    the steps. NEST says so once, on its console; here it is a
    :class:`PartialDelayWarning`, or with ``strict`` an error.

    NEST stays prepared from step to step (``Prepare``, ``Run``, ``Run``, ...). What it refuses
    meanwhile is possible with :meth:`clear` (recorders) and after :meth:`release` (create, connect,
    ``Simulate``); the next step prepares it again, without a change of spikes.

    Args:
        strict: refuse steps that are no whole number of ``min_delay``.
    """

    def __init__(self, *, strict: bool = False) -> None:
        self._nest: ModuleType = import_nest()
        self._strict = strict
        self._kernel = KernelInUse()
        self._is_prepared = self._is_closed = self._knows_delays = False
        self._read_grid()
        # Not from zero: the network may have been simulated before.
        self._steps = self._grid_steps(float(self._nest.biological_time))

    @property
    def resolution_ns(self) -> int:
        """NEST's time step in nanoseconds."""
        return self._grid.resolution_ns

    @property
    def min_delay_ns(self) -> int:
        """The shortest delay of the network in nanoseconds."""
        self._look_at_delays()
        return self._grid.min_delay_ns

    @property
    def steps(self) -> int:
        """Resolutions that have been simulated."""
        return self._steps

    @property
    def time_ns(self) -> int:
        """Simulated time in nanoseconds."""
        return self._steps * self._grid.resolution_ns

    @property
    def time_s(self) -> float:
        """Simulated time in seconds."""
        return self.time_ns / NS_PER_S

    def advance_s(self, duration_s: float) -> None:
        """Simulate so many seconds, rounded to a nanosecond. Errors as of :meth:`advance_ns`."""
        self._advance(nanoseconds(duration_s))

    def advance_to_ns(self, time_ns: int) -> None:
        """Simulate until a point of simulated time. Errors as of :meth:`advance_ns`."""
        self._advance(time_ns - self.time_ns)

    def advance_ns(self, duration_ns: int) -> None:
        """Simulate so many nanoseconds.

        Raises:
            ValueError: that is no whole number of resolutions above 0, or, with ``strict``, of
                ``min_delay``; or the stepper is closed. Nothing has been simulated then.
            NodeError: the kernel has been reset elsewhere.
        """
        self._advance(duration_ns)

    def _advance(self, duration_ns: int) -> None:
        self._kernel.check()
        if self._is_closed:
            raise ValueError("the stepper is closed")
        self._look_at_delays()
        steps = self._grid.steps(duration_ns)
        partial = self._grid.partial_delay(duration_ns)
        if partial and self._strict:
            raise ValueError(partial)
        if partial:
            warnings.warn(
                f"{partial}; the spikes depend on the steps then", PartialDelayWarning, stacklevel=3
            )
        self._knows_delays = True
        self._prepare()
        self._nest.Run(steps * self._grid.resolution_ns / NS_PER_MS)
        self._steps += steps

    def release(self) -> None:
        """Let the network be changed until the next step, which looks at its delays anew."""
        self._clean_up()
        self._knows_delays = False

    def clear(self, recorder: Any) -> None:
        """Forget what a ``spike_recorder`` or ``multimeter`` has recorded."""
        self._clean_up()
        recorder.n_events = 0

    def close(self) -> None:
        """Release the kernel for good. A kernel that was reset elsewhere is left alone."""
        if not self._is_closed and self._kernel.is_ours:
            self._clean_up()
        self._is_closed = True

    def __enter__(self) -> Stepper:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _prepare(self) -> None:
        if not self._is_prepared:
            self._nest.Prepare()
            self._is_prepared = True

    def _clean_up(self) -> None:
        self._kernel.check()
        if self._is_prepared:
            self._is_prepared = False
            self._nest.Cleanup()

    def _look_at_delays(self) -> None:
        # Once, and not at every step: asking NEST takes 0.1 ms.
        if not self._knows_delays:
            self._read_grid()

    def _read_grid(self) -> None:
        self._grid = StepGrid(
            nanoseconds_of_ms(self._nest.resolution), nanoseconds_of_ms(self._nest.min_delay)
        )

    def _grid_steps(self, time_ms: float) -> int:
        return round(nanoseconds_of_ms(time_ms) / self._grid.resolution_ns)
