"""NEST: its kernel, exact steps of simulated time, and devices for spikes in and out.

There is one kernel per process, set up so that runs with one seed give equal spikes. Simulated time
is a whole number of its steps, so that nothing drifts. Devices take the :class:`Stepper` of the
network, to know the time and to be able to clear a recorder; neurons are counted from 0 in the
order of the ``NodeCollection``. NEST is licensed under the GPL and is no part of NeuROS: it is
imported with the first call.
"""

from __future__ import annotations

import math
import os
import warnings
from dataclasses import dataclass
from types import ModuleType
from typing import Any, ClassVar

import numpy as np

from neuros.distribution import install_command
from neuros.errors import EnvironmentFault, NodeError
from neuros.snn.coding import (
    Floats,
    Indices,
    Spikes,
    checked_indices,
    checked_positive,
    checked_rates,
)

LARGEST_SEED = 2**32 - 1
NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000


def import_nest() -> ModuleType:
    """NEST, quiet, with the number of OpenMP's threads fixed first.

    Without ``OMP_NUM_THREADS`` in the environment NEST crashes or hangs where one thread imports it
    and another one simulates: it is set to 1 unless it is there. Import and simulate in one thread,
    as hooks do.

    Raises:
        EnvironmentFault: NEST is not installed in the node's Python.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("PYNEST_QUIET", "1")
    try:
        import nest
    except ModuleNotFoundError as error:
        if error.name != "nest":
            raise
        raise EnvironmentFault(
            "NEST is not installed in this Python: give the node the container neuros_nest, "
            f"or run {install_command('nest')}"
        ) from error
    nest.verbosity = nest.VerbosityLevel.ERROR
    return nest  # type: ignore[no-any-return]


def derive_seed(seed: int, *names: str | int) -> int:
    """A seed of its own for a part of a run, 1 to 2**32 - 1: of a node, of a population, of noise.

    ``derive_seed(seed, node.name)`` lets one number seed a whole project; no two nodes draw equal
    numbers, in one run or in the next. Equal arguments give equal seeds on every machine.

    Source: ``numpy.random.SeedSequence`` mixes; after O'Neill, PCG, seed_seq_fe (2015).
    """
    # Zeros at the end would be the same as none: a 1 ends it.
    words = [seed, *(word for name in names for word in _words(name)), 1]
    state = np.random.SeedSequence(words).generate_state(1, np.uint32)
    return max(1, int(state[0]))


def _words(name: str | int) -> list[int]:
    """As integers; the leading one keeps 1 apart from "1", and "ab", "c" from "a", "bc"."""
    if isinstance(name, int):
        return [0, name]
    return [1 + len(name.encode()), int.from_bytes(name.encode(), "little")]


def threads_of_node() -> int:
    """Number of cores that NeuROS has given this node: ``OMP_NUM_THREADS``, 1 without it.

    A node with ``"affinity": [2, 3]`` has 2. See docs/placement.md.
    """
    try:
        return max(1, int(os.environ.get("OMP_NUM_THREADS", "1")))
    except ValueError:
        return 1


def reset_kernel(seed: int, *, resolution_ms: float = 0.1, threads: int = 1) -> ModuleType:
    """An empty kernel; returns the module ``nest``. Everything that was in it is gone.

    The spikes are a function of the network, the steps (see :class:`Stepper`),
    ``seed`` **and** ``threads``: every *virtual process* (without MPI there are ``threads`` of
    them) draws from a stream of its own, for its neurons. So one seed gives other spikes with
    another number of threads.

    Args:
        seed: 1 to 2**32 - 1; :func:`derive_seed` makes one.
        resolution_ms: NEST's time step, in milliseconds.
        threads: 1 keeps a run comparable on every machine. More want cores of the node's own:
            ``affinity`` in the node file and ``threads=threads_of_node()``. Beyond the cores there
            are it is up to ten times slower, which is warned of.

    Raises:
        EnvironmentFault: NEST is not installed.
        ValueError: an argument is out of range.
    """
    if not 1 <= seed <= LARGEST_SEED:
        raise ValueError(f"NEST takes seeds from 1 to {LARGEST_SEED}: got {seed}")
    checked_positive(resolution_ms, "resolution_ms")
    checked_positive(threads, "threads")
    nest = import_nest()
    cores = len(os.sched_getaffinity(0))
    if threads > cores:
        warnings.warn(
            f"{threads} NEST threads on {cores} cores: up to ten times slower than {cores}",
            RuntimeWarning,
            stacklevel=2,
        )
    nest.ResetKernel()
    Stepper.resets += 1
    nest.set(resolution=resolution_ms, local_num_threads=threads, rng_seed=seed, print_time=False)
    return nest


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

    Time is counted in whole steps of NEST's resolution, as integers, without drift. A step that is
    no whole number of resolutions is an error, before anything is simulated.

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

    resets: ClassVar[int] = 0
    """Of the kernel: there is one per process."""

    def __init__(self, *, strict: bool = False) -> None:
        self._nest: ModuleType = import_nest()
        self._strict = strict
        self._resets = Stepper.resets
        self._is_prepared = self._is_closed = self._knows_delays = False
        self._look_at_delays()
        # Not from zero: the network may have been simulated before.
        time_ns = nanoseconds_of_ms(float(self._nest.biological_time))
        self._steps = round(time_ns / self._grid.resolution_ns)

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
        self._check_kernel()
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
        if not self._is_prepared:
            self._nest.Prepare()
            self._is_prepared = True
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
        if not self._is_closed and self._resets == Stepper.resets:
            self._clean_up()
        self._is_closed = True

    def __enter__(self) -> Stepper:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check_kernel(self) -> None:
        """Raise ``NodeError`` where another node has reset the kernel: two cannot share it."""
        if self._resets != Stepper.resets:
            raise NodeError(
                "NEST's kernel has been reset, and there is one per process: two nodes with "
                "NEST need a process each (--backend process), and a node has one network at a time"
            )

    def _clean_up(self) -> None:
        self._check_kernel()
        if self._is_prepared:
            self._is_prepared = False
            self._nest.Cleanup()

    def _look_at_delays(self) -> None:
        # Once, and not at every step: asking NEST takes 0.1 ms.
        if not self._knows_delays:
            self._grid = StepGrid(
                nanoseconds_of_ms(self._nest.resolution), nanoseconds_of_ms(self._nest.min_delay)
            )


class RateInput:
    """Poisson spikes for every neuron, at rates that may change with every step.

    One ``poisson_generator`` per neuron: each keeps a rate of its own. (One generator for several
    neurons would give each of them other spikes of the same rate.) The generators draw from the
    kernel's random numbers: see :func:`reset_kernel`.

    Args:
        neurons: ``NodeCollection`` that receives.
        weight: of each synapse, in the unit of the neuron model (pA for current-based ones).
        delay_ms: from generator to neuron; a multiple of the resolution. It counts for the
            ``min_delay`` of the network.
    """

    def __init__(self, neurons: Any, weight: float, delay_ms: float = 1.0) -> None:
        nest = import_nest()
        self._generators = nest.Create("poisson_generator", len(neurons))
        nest.Connect(self._generators, neurons, "one_to_one", {"weight": weight, "delay": delay_ms})
        self._rates_hz = np.zeros(len(neurons))

    def set_rates(self, rates_hz: object) -> None:
        """From the next step on, in Hz, ``(n,)``. What has not changed costs nothing.

        Raises ``ValueError`` if the shape is wrong, or a rate is negative or not finite.
        """
        rates = checked_rates(rates_hz, self._rates_hz.size)
        changed = np.flatnonzero(rates != self._rates_hz)
        if changed.size:  # all at once: one by one takes ten times as long
            self._generators[changed].rate = rates[changed]
        self._rates_hz = rates.copy()


class SpikeInput:
    """Given spikes, such as those of a coder, for every neuron: a ``spike_generator`` each.

    Args:
        neurons: ``NodeCollection`` that receives.
        stepper: of the network.
        weight, delay_ms: as of :class:`RateInput`.
    """

    def __init__(
        self, neurons: Any, stepper: Stepper, weight: float, delay_ms: float = 1.0
    ) -> None:
        nest = import_nest()
        self._stepper = stepper
        stepper.release()
        self._generators = nest.Create("spike_generator", len(neurons))
        nest.Connect(self._generators, neurons, "one_to_one", {"weight": weight, "delay": delay_ms})
        self._loaded: Indices = np.zeros(0, dtype=np.int64)

    def play(self, spikes: Spikes) -> None:
        """Fire these in the steps to come, in place of what was to be played before.

        Times are simulated seconds; each is moved to the end of the resolution step that it lies
        in, at most one resolution later, and several of a neuron that fall on one step all count.

        Raises ``ValueError`` where a spike lies in the past, or the population has no such neuron.
        """
        index = checked_indices(spikes, len(self._generators))
        steps = self._steps_of(spikes.time_s)
        if steps.size and steps.min() <= self._stepper.steps:
            raise ValueError(
                f"a spike at {float(spikes.time_s.min())!r} s: the network is at "
                f"{self._stepper.time_s!r} s already"
            )
        firing = np.unique(index)
        changed = np.union1d(self._loaded, firing)
        if changed.size:
            trains = [self._train(steps[index == neuron]) for neuron in changed]
            self._generators[changed].set(trains)
        self._loaded = firing

    def _train(self, steps: Indices) -> dict[str, Any]:
        """The parameters of one generator."""
        own, multiplicities = np.unique(steps, return_counts=True)
        times_ms = own * self._stepper.resolution_ns / NS_PER_MS
        return {"spike_times": times_ms, "spike_multiplicities": multiplicities.astype(np.int64)}

    def _steps_of(self, time_s: Floats) -> Indices:
        """The step that each time lies in: (k - 1, k] is k, and the start of a step is in it."""
        time_ns = np.round(time_s * NS_PER_S).astype(np.int64)
        steps = -(-time_ns // self._stepper.resolution_ns)
        # A coder's window holds its first moment: that is the first step after it.
        return np.where(time_ns == self._stepper.time_ns, self._stepper.steps + 1, steps)


class SpikeReader:
    """The spikes of a population since the last look.

    A ``spike_recorder`` that is cleared by each :meth:`read`: a read costs as much as there are new
    spikes, and memory does not grow as long as one reads. (NEST itself gives all spikes since the
    recorder was made, every time.)

    Args:
        neurons: ``NodeCollection``.
        stepper: of the network.
        delay_ms: of the recorder's connections. They count for ``min_delay``: where all delays of
            the network are longer than 1 ms, say so here.
    """

    def __init__(self, neurons: Any, stepper: Stepper, delay_ms: float = 1.0) -> None:
        nest = import_nest()
        self._stepper = stepper
        stepper.release()
        self._recorder = nest.Create("spike_recorder")
        nest.Connect(neurons, self._recorder, syn_spec={"delay": delay_ms})
        ids = np.array(neurons.tolist())
        self._order = np.argsort(ids)
        self._ids = ids[self._order]

    def read(self) -> Spikes:
        """The spikes since the last read, in the order in which NEST has recorded them."""
        events = self._recorder.events
        senders = np.asarray(events["senders"], dtype=np.int64)
        # By whole nanoseconds: the times of NEST are milliseconds with rounding in the last digit.
        time_ns = np.round(np.asarray(events["times"], dtype=np.float64) * NS_PER_MS)
        if senders.size:
            self._stepper.clear(self._recorder)
        return Spikes(self._order[np.searchsorted(self._ids, senders)], time_ns / NS_PER_S)
