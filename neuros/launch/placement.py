"""Which cores each node of a run may use, decided once, before the start.

A pure function of the project, of the cores that the launcher itself may use, and of where a run
begins to count them. The back ends apply it: a process gets a mask, a container a set of cores. The
measurements behind the rule are in ``docs/placement.md``.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType

from neuros.project.model import Node

_NOTHING: Mapping[str, str] = MappingProxyType({})

Cores = tuple[int, ...]
"""Numbers of cores, ascending."""

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)
"""How many threads the usual numerical libraries start."""


def place(
    nodes: Sequence[Node],
    cores: Collection[int],
    environ: Mapping[str, str] = _NOTHING,
    *,
    begin: int = 0,
) -> Mapping[str, Cores]:
    """The cores of each node that is not left to the kernel, by name.

    A node with ``affinity`` keeps exactly that, also where ``cores`` lacks some. The others divide
    what is left, in the order of the project, if each of them can have as many cores as it has
    threads: then no sender shares a core with its receiver, and no node waits for a core that it
    could have had. Where cores are too few, a division is right only for those who know how much
    each node computes: the kernel, which sees it, moves them about.

    Args:
        nodes: those that are started on this machine.
        cores: what the launcher may use.
        environ: the launcher's environment, which nodes inherit.
        begin: how many cores to go on before the first node gets its own, round and round: with
            another number for each run, the first nodes of two runs are not on the same core.
    """
    chosen = {node.name: tuple(sorted(node.affinity)) for node in nodes if node.affinity}
    free = sorted(set(cores).difference(*chosen.values()))
    others = [node for node in nodes if not node.affinity]
    threads = {node.name: _threads(node, environ) for node in others if not _renders(node)}
    if len(threads) == len(others) and sum(threads.values()) <= len(free) > 0:
        turn = begin % len(free)
        free = [*free[turn:], *free[:turn]]
        chosen |= _divided(threads, free)
    return chosen


def thread_limits(nodes: Sequence[Node]) -> dict[str, str]:
    """The environment that keeps numerical libraries to the cores that nodes have asked for.

    Nodes of one process run one at a time: what the widest of them asked for is enough.
    """
    count = max((len(node.affinity) for node in nodes), default=0)
    return dict.fromkeys(THREAD_VARIABLES, str(count)) if count else {}


def on_cores(cores: Cores | None) -> str:
    """Where it runs, to be read after what runs; nothing where the kernel chooses."""
    if not cores:
        return ""
    return f" on core{'s' if len(cores) > 1 else ''} {', '.join(map(str, cores))}"


def _threads(node: Node, environ: Mapping[str, str]) -> int:
    """How many cores a node can use at once: its hooks never overlap, its libraries may."""
    given = {**environ, **node.environment}
    counts = [given.get(name, "") for name in THREAD_VARIABLES]
    return max([1, *(int(count) for count in counts if count.isascii() and count.isdigit())])


def _renders(node: Node) -> bool:
    """Whether it draws images: in software, that takes every core that there is."""
    return any(port.mujoco.get("sensor") == "camera" for port in node.outputs)


def _divided(threads: Mapping[str, int], cores: Sequence[int]) -> dict[str, Cores]:
    """All cores, those in a row for each node, spare ones in proportion to the threads."""
    total = sum(threads.values())
    spare, before, result = len(cores) - total, 0, {}
    for name, count in threads.items():
        after = before + count
        start, end = (edge + spare * edge // total for edge in (before, after))
        result[name], before = tuple(sorted(cores[start:end])), after
    return result
