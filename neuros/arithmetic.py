"""Processor level and libraries, on which the last bits of floating-point results depend."""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import json
import os
import platform
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

ARITHMETIC = "arithmetic.json"
# By level, what it adds to the one before, as (leaf, register, bit) of glibc's table of features
# (sys/platform/x86.h; registers are EAX, EBX, ECX, EDX); the names are those of /proc/cpuinfo.
_LEVELS: Mapping[str, Mapping[str, tuple[int, int, int]]] = {
    "x86-64-v2": {
        "cx16": (0, 2, 13),
        "popcnt": (0, 2, 23),
        "sse4_1": (0, 2, 19),
        "sse4_2": (0, 2, 20),
        "ssse3": (0, 2, 9),
    },
    "x86-64-v3": {
        "avx": (0, 2, 28),
        "avx2": (1, 1, 5),
        "bmi1": (1, 1, 3),
        "bmi2": (1, 1, 8),
        "f16c": (0, 2, 29),
        "fma": (0, 2, 12),
        "movbe": (0, 2, 22),
    },
    "x86-64-v4": {
        "avx512f": (1, 1, 16),
        "avx512dq": (1, 1, 17),
        "avx512cd": (1, 1, 28),
        "avx512bw": (1, 1, 30),
        "avx512vl": (1, 1, 31),
    },
}
_DECIDING = ("avx", "avx2", "fma", "avx512f")
"""Features that change results, and are named beside a level that lacks them."""
_LIBRARIES = ("numpy", "scipy", "mujoco", "nest", "numba", "tensorflow", "torch", "jax")
_PREFIXES, _SUFFIXES = ("", "scipy_"), ("", "64_", "_64")


class _Leaf(ctypes.Structure):
    """``struct cpuid_feature`` of glibc: what the processor has, and what programs may use."""

    _fields_ = [("cpuid", ctypes.c_uint * 4), ("active", ctypes.c_uint * 4)]


def note_arithmetic(node_folder: Path) -> None:
    """Write :func:`arithmetic` into the folder of a node that has loaded its libraries."""
    with contextlib.suppress(OSError):  # a full disk is reported by what loses more by it
        (node_folder / ARITHMETIC).write_text(json.dumps(arithmetic(), indent=2), "utf-8")


def arithmetic() -> dict[str, str]:
    """Processor, its level for glibc, and the libraries that this process has loaded.

    ``GLIBC_TUNABLES`` and the like are taken into account.
    """
    found = {
        "processor": processor(),
        "level": level(active_features()),
        "glibc": (os.confstr("CS_GNU_LIBC_VERSION") or "").removeprefix("glibc "),
        "openblas": "; ".join(sorted(set(_openblas()))),
    }
    for name in _LIBRARIES:
        if (module := sys.modules.get(name)) is not None:
            found[name] = str(getattr(module, "__version__", ""))
    if numpy := sys.modules.get("numpy"):
        # The sets of instructions above its baseline that it uses.
        sets = numpy.show_config(mode="dicts").get("SIMD Extensions", {}).get("found", ())
        found["numpy"] += f" ({' '.join(sets) or 'baseline'})"
    return {name: value for name, value in found.items() if value}


def processor() -> str:
    """The model name of the processor."""
    return next(_cpuinfo("model name"), "") or platform.machine()


def level(features: frozenset[str]) -> str:
    """The level of the psABI of x86-64, and the features above it that change results."""
    reached = "x86-64"
    above = frozenset(_DECIDING)
    for name, added in _LEVELS.items():
        if not features.issuperset(added):
            break
        reached = name
        above -= added.keys()
    return ", ".join([reached, *(each for each in _DECIDING if each in above & features)])


def active_features() -> frozenset[str]:
    """The features that glibc uses; before glibc 2.33, those that the processor has."""
    places = {name: place for added in _LEVELS.values() for name, place in added.items()}
    try:
        table = ctypes.CDLL(None).__getattr__("__x86_get_cpuid_feature_leaf")
    except AttributeError:
        return frozenset(places) & frozenset(next(_cpuinfo("flags"), "").split())
    table.restype = ctypes.POINTER(_Leaf)
    return frozenset(
        name
        for name, (leaf, register, bit) in places.items()
        if table(leaf).contents.active[register] >> bit & 1
    )


def differences(a: Mapping[str, Any], b: Mapping[str, Any]) -> str:
    """How the arithmetic of two runs differs, by node, in words; empty if it does not.

    A library that a node has loaded in one of them only, as in process, is no difference.
    """
    nodes: dict[str, list[str]] = {}
    for node in [name for name in a if name in b]:
        parts = [
            f"{what} {a[node][what]} in A, {b[node][what]} in B"
            for what in a[node]
            if what in b[node] and a[node][what] != b[node][what]
        ]
        if parts:
            nodes.setdefault("; ".join(parts), []).append(node)
    return "; ".join(f"{', '.join(names)}: {how}" for how, names in nodes.items())


def _cpuinfo(key: str) -> Iterator[str]:
    with (
        contextlib.suppress(OSError),
        Path("/proc/cpuinfo").open(encoding="utf-8", errors="replace") as lines,
    ):
        for line in lines:
            name, _, value = line.partition(":")
            if name.strip() == key:
                yield value.strip()


def _openblas() -> Iterator[str]:
    """Version and core type of each OpenBLAS that is loaded."""
    with contextlib.suppress(OSError):
        mapped = {line.split()[-1] for line in Path("/proc/self/maps").read_text().splitlines()}
        for path in mapped:
            name = path.rpartition("/")[2]
            if "openblas" not in name or ".so" not in name:
                continue
            library = ctypes.CDLL(path)
            for prefix, suffix in itertools.product(_PREFIXES, _SUFFIXES):
                texts = []
                for what in ("config", "corename"):
                    describe = getattr(library, f"{prefix}openblas_get_{what}{suffix}", None)
                    if describe is not None:
                        describe.restype = ctypes.c_char_p
                        texts.append(describe().decode())
                if len(texts) == 2:
                    yield f"{texts[0].split()[1]} {texts[1]}"
