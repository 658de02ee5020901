"""NEST in steps that stay exact."""

from __future__ import annotations

import warnings
from types import ModuleType, TracebackType
from typing import Any

from neuros.snn.kernel import KernelInUse, import_nest
from neuros.snn.steps import (
    NS_PER_MS,
    NS_PER_S,
    PartialDelayWarning,
    StepGrid,
    nanoseconds,
    nanoseconds_of_ms,
)


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
    the steps. NEST says so once, where nobody looks; here it is a
    :class:`~neuros.snn.steps.PartialDelayWarning`, or with ``strict`` an error.

    NEST stays prepared from step to step (``Prepare``, ``Run``, ``Run``, ...). What it refuses
    meanwhile is possible with :meth:`clear` (recorders) and after :meth:`release` (create, connect,
    ``Simulate``); the next step prepares it again, and the spikes are the same.

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
            NodeError: somebody else has reset the kernel.
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
        """Release the kernel for good. A kernel that somebody else has reset is left alone."""
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
