"""NEST: its kernel, exact steps of simulated time, and devices for spikes in and out.

There is one kernel per process, set up so that runs with one seed give equal spikes. Simulated time
is a whole number of its steps, so it does not drift. Devices need the :class:`Stepper` of the
network: for the time, and to clear a recorder. Neurons are counted from 0 in the order of the
``NodeCollection``. NEST is licensed under the GPL and no part of NeuROS: the first call imports it.
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
    """Import NEST, quiet, with a fixed number of OpenMP threads.

    Without ``OMP_NUM_THREADS`` NEST crashes or hangs where one thread imports it and another one
    simulates: the variable is set to 1 unless it is there. Import and simulate in one thread, as
    hooks do.

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
    """A seed, 1 to 2**32 - 1, for a part of a run: a node, a population, a source of noise.

    ``derive_seed(seed, node.name)`` lets one number seed a whole project, with different numbers
    for each node and each seed. Equal arguments give equal seeds on every machine.

    Source: ``numpy.random.SeedSequence`` mixes; after O'Neill, PCG, seed_seq_fe (2015).
    """
    # SeedSequence ignores zeros at the end: a 1 keeps them apart.
    words = [seed, *(word for name in names for word in _words(name)), 1]
    state = np.random.SeedSequence(words).generate_state(1, np.uint32)
    return max(1, int(state[0]))


def _words(name: str | int) -> list[int]:
    """A name as integers; the first one keeps 1 apart from "1", and "ab", "c" from "a", "bc"."""
    if isinstance(name, int):
        return [0, name]
    return [1 + len(name.encode()), int.from_bytes(name.encode(), "little")]


def threads_of_node() -> int:
    """The number of cores of this node: ``OMP_NUM_THREADS``, 1 without it.

    A node with ``"affinity": [2, 3]`` has 2. See docs/placement.md.
    """
    try:
        return max(1, int(os.environ.get("OMP_NUM_THREADS", "1")))
    except ValueError:
        return 1


def reset_kernel(seed: int, *, resolution_ms: float = 0.1, threads: int = 1) -> ModuleType:
    """Empty the kernel, and return the module ``nest``.

    The spikes are a function of the network, the steps (see :class:`Stepper`),
    ``seed`` **and** ``threads``: every *virtual process* (without MPI there are ``threads`` of
    them) draws from a stream of its own, for its neurons. So one seed gives other spikes with
    another number of threads.

    Args:
        seed: 1 to 2**32 - 1; :func:`derive_seed` makes one.
        resolution_ms: NEST's time step, in milliseconds.
        threads: 1 keeps a run comparable on every machine. More need cores of the node's own:
            ``affinity`` in the node file and ``threads=threads_of_node()``. More threads than
            cores are up to ten times slower, and cause a warning.

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
    """The lengths that a step may have.

    Args:
        resolution_ns: the simulator's own step, in nanoseconds.
        min_delay_ns: the shortest delay of the network, which is the period at which its spikes
            are exchanged; a whole number of resolutions.

    Raises:
        ValueError: the delay is not a whole number of resolutions, or an argument is not above 0.
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
        """The number of resolutions in a duration.

        Raises ``ValueError``, with the nearest possible lengths, if it is not whole.
        """
        steps, rest_ns = divmod(duration_ns, self.resolution_ns)
        if steps < 1 or rest_ns:
            raise ValueError(self._refusal(duration_ns, self.resolution_ns, "the resolution"))
        return steps

    def partial_delay(self, duration_ns: int) -> str:
        """Why a step is not a whole number of shortest delays; empty if it is."""
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
    """The whole nanoseconds nearest to a duration; exact for multiples of 1 ns up to 52 days.

    Raises ``ValueError`` where it is not finite.
    """
    if not math.isfinite(seconds):
        raise ValueError(f"a duration must be finite: got {seconds!r} s")
    return round(seconds * NS_PER_S)


def nanoseconds_of_ms(milliseconds: float) -> int:
    """The whole nanoseconds nearest to a duration in milliseconds, NEST's unit."""
    return round(milliseconds * NS_PER_MS)


class Stepper:
    """Simulates the built network in steps of simulated time.

    ::

        nest = reset_kernel(seed=1)
        ...                                   # Create, Connect
        with Stepper() as stepper:            # or close() at the end
            stepper.advance_s(0.02)
            stepper.advance_to_ns(stamp_ns)

    Time is counted in whole steps of NEST's resolution, as integers, without drift. A step that is
    not a whole number of resolutions is an error, raised before anything is simulated.

    **Steps and delays.** Spikes are exchanged once per shortest delay of the network
    (``min_delay``). Steps of whole delays give the spikes of one long step, bit for bit. A step
    that ends between two exchanges changes the order in which the sources of randomness draw their
    numbers: the spikes are as right as those of another seed, but depend on the steps. NEST says so
    once, on its console; here it is a :class:`PartialDelayWarning`, or with ``strict`` an error.

    NEST stays prepared from step to step (``Prepare``, ``Run``, ``Run``, ...). Changes that NEST
    refuses meanwhile are possible by :meth:`clear` (recorders) and after :meth:`release` (create,
    connect, ``Simulate``); the next step prepares NEST again, without a change of spikes.

    Args:
        strict: refuse steps that are not a whole number of ``min_delay``.
    """

    resets: ClassVar[int] = 0
    """Resets of the one kernel of this process."""

    def __init__(self, *, strict: bool = False) -> None:
        self._nest: ModuleType = import_nest()
        self._strict = strict
        self._resets = Stepper.resets
        self._is_prepared = self._is_closed = self._knows_delays = False
        self._read_delays()
        # The network may have been simulated before.
        time_ns = nanoseconds_of_ms(float(self._nest.biological_time))
        self._steps = round(time_ns / self._grid.resolution_ns)

    @property
    def resolution_ns(self) -> int:
        """NEST's time step in nanoseconds."""
        return self._grid.resolution_ns

    @property
    def min_delay_ns(self) -> int:
        """The shortest delay of the network in nanoseconds."""
        self._read_delays()
        return self._grid.min_delay_ns

    @property
    def steps(self) -> int:
        """Number of simulated resolutions."""
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
        """Simulate seconds, rounded to a nanosecond. Errors as of :meth:`advance_ns`."""
        self._advance(nanoseconds(duration_s))

    def advance_to_ns(self, time_ns: int) -> None:
        """Simulate until a point of simulated time. Errors as of :meth:`advance_ns`."""
        self._advance(time_ns - self.time_ns)

    def advance_ns(self, duration_ns: int) -> None:
        """Simulate nanoseconds.

        Raises:
            ValueError: the duration is not a whole number of resolutions above 0, or, with
                ``strict``, of ``min_delay``; or the stepper is closed. Nothing was simulated then.
            NodeError: the kernel has been reset elsewhere.
        """
        self._advance(duration_ns)

    def _advance(self, duration_ns: int) -> None:
        self._check_kernel()
        if self._is_closed:
            raise ValueError("the stepper is closed")
        self._read_delays()
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
        """Let the network be changed until the next step, which reads its delays again."""
        self._clean_up()
        self._knows_delays = False

    def clear(self, recorder: Any) -> None:
        """Delete the records of a ``spike_recorder`` or ``multimeter``."""
        self._clean_up()
        recorder.n_events = 0

    def close(self) -> None:
        """Release the kernel for good; one that was reset elsewhere is left alone."""
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

    def _read_delays(self) -> None:
        # Only after a change of the network: asking NEST takes 0.1 ms.
        if not self._knows_delays:
            self._grid = StepGrid(
                nanoseconds_of_ms(self._nest.resolution), nanoseconds_of_ms(self._nest.min_delay)
            )


class RateInput:
    """Poisson spikes for every neuron, at rates that may change with every step.

    One ``poisson_generator`` per neuron, each with its own rate. (One generator for several neurons
    would give each of them other spikes of the same rate.) The generators draw from the kernel's
    random numbers: see :func:`reset_kernel`.

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
        """Set the rates from the next step on, in Hz, ``(n,)``. Unchanged rates cost nothing.

        Raises ``ValueError`` if the shape is wrong, or a rate is negative or not finite.
        """
        rates = checked_rates(rates_hz, self._rates_hz.size)
        changed = np.flatnonzero(rates != self._rates_hz)
        if changed.size:  # all at once: one by one takes ten times as long
            self._generators[changed].rate = rates[changed]
        self._rates_hz = rates.copy()


class SpikeInput:
    """Plays given spikes, such as those of a coder, to every neuron: a ``spike_generator`` each.

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
        """Play spikes in the coming steps, in place of those not played yet.

        Times are simulated seconds; a spike moves to the end of its resolution step, at most one
        resolution later, and several of a neuron in one step all count.

        Raises ``ValueError`` where a spike lies in the past, or the population has no such neuron.
        """
        index = checked_indices(spikes, len(self._generators))
        resolution_ns = self._stepper.resolution_ns
        time_ns = np.round(spikes.time_s * NS_PER_S).astype(np.int64)
        # Step k covers (k - 1, k]. A coder's window includes its start, which lies in the step
        # before: a spike there moves to the next step.
        steps = -(-time_ns // resolution_ns)
        steps = np.where(time_ns == self._stepper.time_ns, self._stepper.steps + 1, steps)
        if steps.size and steps.min() <= self._stepper.steps:
            raise ValueError(
                f"a spike at {float(spikes.time_s.min())!r} s: the network is at "
                f"{self._stepper.time_s!r} s already"
            )
        firing = np.unique(index)
        changed = np.union1d(self._loaded, firing)
        trains = []
        for neuron in changed:
            own, counts = np.unique(steps[index == neuron], return_counts=True)
            times_ms = own * resolution_ns / NS_PER_MS
            trains.append({"spike_times": times_ms, "spike_multiplicities": counts})
        if trains:
            self._generators[changed].set(trains)
        self._loaded = firing


class SpikeReader:
    """The spikes of a population since the last :meth:`read`.

    Each read clears the ``spike_recorder``: it costs as much as there are new spikes, and memory
    does not grow. (NEST itself returns all spikes since the recorder was made, every time.)

    Args:
        neurons: ``NodeCollection``.
        stepper: of the network.
        delay_ms: of the recorder's connections. They count for ``min_delay``: raise it where all
            delays of the network are longer than 1 ms.
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
        """The spikes since the last read, in the order of NEST's recorder."""
        events = self._recorder.events
        senders = np.asarray(events["senders"], dtype=np.int64)
        # Rounded to nanoseconds: NEST's milliseconds have errors in the last digit.
        time_ns = np.round(np.asarray(events["times"], dtype=np.float64) * NS_PER_MS)
        if senders.size:
            self._stepper.clear(self._recorder)
        return Spikes(self._order[np.searchsorted(self._ids, senders)], time_ns / NS_PER_S)


class Weights:
    """The weights of the synapses from each neuron of one population to each of another one.

    Make it when the network is complete, before its first step: NEST sorts its synapses when it
    first prepares to simulate, and a handle from before then means another synapse.

    Args:
        sources, targets: ``NodeCollection`` of ``n`` and of ``m`` neurons.

    Raises:
        ValueError: the number of synapses is not ``n * m``.
    """

    def __init__(self, sources: Any, targets: Any) -> None:
        nest = import_nest()
        nest.Prepare()
        nest.Cleanup()
        self._synapses = nest.GetConnections(sources, targets)
        self._shape = len(sources), len(targets)
        if len(self._synapses) != len(sources) * len(targets):
            raise ValueError(
                f"{len(self._synapses)} synapses from {len(sources)} neurons to {len(targets)}: "
                "there must be one from each to each"
            )
        ends = self._synapses.get(["source", "target"])
        self._order = np.lexsort((ends["target"], ends["source"]))

    def read(self) -> Floats:
        """``(n, m)``, a row per source, in the unit of the model; neurons in the order of ids."""
        return np.array(self._synapses.weight, float)[self._order].reshape(self._shape)

    def write(self, values: object) -> None:
        """Set all weights, ``(n, m)``. Raises ``ValueError`` where the shape is another one."""
        given = np.asarray(values, float)
        if given.shape != self._shape:
            raise ValueError(f"weights of shape {given.shape}, not {self._shape}")
        weights = np.empty(given.size)
        weights[self._order] = given.ravel()
        self._synapses.weight = weights
