"""NEST's kernel: one per process, set up so that runs with one seed give equal spikes.

NEST is licensed under the GPL and is no part of NeuROS: it is imported with the first call.
"""

from __future__ import annotations

import os
import warnings
from types import ModuleType

import numpy as np

from neuros.distribution import install_command
from neuros.errors import EnvironmentFault, NodeError
from neuros.snn.spikes import checked_positive

LARGEST_SEED = 2**32 - 1


class _Owner:
    """Count of resets: NEST has one kernel per process, so this is one per process, too."""

    resets = 0


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

    The spikes are a function of the network, the steps (see :class:`~neuros.snn.stepper.Stepper`),
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
    _Owner.resets += 1
    nest.set(resolution=resolution_ms, local_num_threads=threads, rng_seed=seed, print_time=False)
    return nest


class KernelInUse:
    """Notices when another node resets the kernel, which two nodes of a process cannot share."""

    def __init__(self) -> None:
        self._resets = _Owner.resets

    @property
    def is_ours(self) -> bool:
        """Whether :func:`reset_kernel` has not been called since."""
        return self._resets == _Owner.resets

    def check(self) -> None:
        """Raise ``NodeError`` once it has been."""
        if not self.is_ours:
            raise NodeError(
                "NEST's kernel has been reset, and there is one per process: two nodes with "
                "NEST need a process each (--backend process), and a node has one network at a time"
            )
