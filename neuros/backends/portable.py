"""Equal arithmetic on every x86-64 processor: the variables that fix what libraries choose.

glibc, NumPy, OpenBLAS and MKL look at the processor when they are loaded, and choose among several
versions of a function, whose results differ in the last bits. The variables here hold them to what
every processor of the level x86-64-v2 has. They must be set before the process starts.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from neuros.backends.node_command import THREAD_VARIABLES
from neuros.errors import UsageError
from neuros.project.model import Node, Project

TUNABLES = "GLIBC_TUNABLES"
_HWCAPS = "glibc.cpu.hwcaps"
# libm has variants for FMA, FMA4 and AVX2, libmvec also for AVX-512; glibc before 2.33 names those
# of libm with _Usable. Unknown names have no effect.
_FEATURES = (
    *("FMA", "FMA4", "AVX2", "AVX512F", "AVX512DQ"),
    *("FMA_Usable", "FMA4_Usable", "AVX2_Usable"),
)
# The names of NumPy 2.4, and of versions before. NumPy ignores unknown ones, and refuses those of
# x86-64-v2, which it cannot switch off.
_NUMPY_FEATURES = (
    *("X86_V3", "X86_V4", "AVX512_ICL", "AVX512_SPR"),
    *("AVX", "F16C", "XOP", "FMA4", "FMA3", "AVX2", "AVX512F", "AVX512CD"),
    *("AVX512_KNL", "AVX512_KNM", "AVX512_SKX", "AVX512_CLX", "AVX512_CNL"),
)
_FIXED = {
    "NPY_DISABLE_CPU_FEATURES": ",".join(_NUMPY_FEATURES),
    "NPY_ENABLE_CPU_FEATURES": "",  # NumPy refuses both at once
    "OPENBLAS_CORETYPE": "Nehalem",
    "MKL_CBWR": "COMPATIBLE",
}


def portable_variables(given: Mapping[str, str]) -> dict[str, str]:
    """The variables of a process; ``given`` are those that it has without them.

    Other tunables of glibc stay, and so do other features that are switched off there.
    """
    tunables = [entry for entry in given.get(TUNABLES, "").split(":") if entry]
    others = [entry for entry in tunables if not entry.startswith(f"{_HWCAPS}=")]
    switched = [
        feature
        for entry in tunables
        if entry not in others
        for feature in entry.partition("=")[2].split(",")
        if feature and feature.lstrip("-") not in _FEATURES
    ]
    hwcaps = ",".join([*switched, *(f"-{feature}" for feature in _FEATURES)])
    return {TUNABLES: ":".join([*others, f"{_HWCAPS}={hwcaps}"]), **_FIXED}


def common_variables(nodes: Sequence[Node], given: Mapping[str, str]) -> dict[str, str]:
    """The variables of a process for all these nodes, numbers of threads included."""
    return {**_threads(nodes), **portable_variables(given)}


def portable_project(project: Project, environ: Mapping[str, str]) -> Project:
    """The project with these variables in the environment of each node.

    Numbers of threads are those that the node asks for, else 1; those of the shell do not count.

    Args:
        environ: of the launcher.
    """
    nodes = (
        replace(
            node,
            environment={
                **_threads([node]),
                **node.environment,
                **portable_variables({**environ, **node.environment}),
            },
        )
        for node in project.nodes
    )
    return replace(project, nodes=tuple(nodes), is_portable=True)


def check_this_process(nodes: Sequence[Node]) -> None:
    """Check that this Python has been started with the variables.

    Raises:
        UsageError: if some are missing, with the command that sets them.
    """
    # The environment with which it was started, whatever Python has set since.
    started = Path("/proc/self/environ").read_bytes().split(b"\0")
    pairs = (os.fsdecode(variable).partition("=") for variable in started)
    given = {name: value for name, _, value in pairs}
    wanted = common_variables(nodes, given)
    missing = [name for name, value in wanted.items() if given.get(name, "") != value]
    if missing:
        command = shlex.join(["env", *(f"{name}={wanted[name]}" for name in missing)])
        raise UsageError(
            f"portable: this Python was started without {', '.join(missing)}, which libraries read"
            f" when they are loaded: start it by\n  {command} python PROGRAM\nor run the nodes in"
            ' a process of their own, with session(backend="in-process")'
        )


def _threads(nodes: Iterable[Node]) -> dict[str, str]:
    count = max((len(node.affinity) for node in nodes), default=0)
    return dict.fromkeys(THREAD_VARIABLES, str(count or 1))
