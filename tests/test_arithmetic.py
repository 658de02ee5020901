"""What the last bits of a run depend on, as ``run.json`` has it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from neuros.arithmetic import (
    ARITHMETIC,
    active_features,
    arithmetic,
    differences,
    level,
    note_arithmetic,
)
from neuros.project.model import Node
from neuros.recording.provenance import provenance

V2 = frozenset({"cx16", "popcnt", "sse4_1", "sse4_2", "ssse3"})
V3 = V2 | {"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "movbe"}
V4 = V3 | {"avx512f", "avx512dq", "avx512cd", "avx512bw", "avx512vl"}


@pytest.mark.parametrize(
    ("features", "expected"),
    [
        (frozenset(), "x86-64"),
        (V2 - {"popcnt"}, "x86-64"),
        (V2, "x86-64-v2"),
        (V2 | {"avx"}, "x86-64-v2, avx"),
        (V3 - {"fma"}, "x86-64-v2, avx, avx2"),
        (V3, "x86-64-v3"),
        (V4 - {"avx512vl"}, "x86-64-v3, avx512f"),
        (V4, "x86-64-v4"),
    ],
)
def test_a_level_names_the_features_above_it_that_change_results(
    features: frozenset[str], expected: str
) -> None:
    assert level(features) == expected


def test_the_features_are_among_those_of_the_processor() -> None:
    flags = next(
        line.split(":")[1].split()
        for line in Path("/proc/cpuinfo").read_text().splitlines()
        if line.startswith("flags")
    )
    assert active_features() <= {*flags}
    assert "sse4_2" in active_features()


def test_processor_glibc_and_loaded_libraries_are_named() -> None:
    found = arithmetic()
    assert found["level"] == level(active_features())
    assert os.confstr("CS_GNU_LIBC_VERSION") == f"glibc {found['glibc']}"
    assert found["numpy"].startswith(f"{np.__version__} (")
    assert found["processor"]
    assert "torch" not in found


PRINTS = """
import numpy
from neuros.arithmetic import arithmetic
print(arithmetic())
"""


def test_what_the_environment_switches_off_counts() -> None:
    without = {
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-AVX2",
        "OPENBLAS_CORETYPE": "Nehalem",
        "NPY_DISABLE_CPU_FEATURES": "X86_V3,X86_V4,AVX512_ICL,AVX512_SPR,"
        "AVX,F16C,FMA3,AVX2,AVX512F,AVX512CD,AVX512_SKX,AVX512_CLX,AVX512_CNL",
    }
    command = [sys.executable, "-c", PRINTS]
    printed = subprocess.run(
        command, env={**os.environ, **without}, capture_output=True, text=True, check=True
    )
    assert "'level': 'x86-64-v2" in printed.stdout
    assert "Nehalem" in printed.stdout
    assert f"'numpy': '{np.__version__} (" in printed.stdout
    assert "V3" not in printed.stdout.split("numpy")[1]


def test_a_run_has_what_its_nodes_have_noted(tmp_path: Path) -> None:
    nodes = [Node(name, "neuros_python", Path("p.py")) for name in ("a", "torn", "never")]
    for each in nodes:
        (tmp_path / each.name).mkdir()
    note_arithmetic(tmp_path / "a")
    (tmp_path / "torn" / ARITHMETIC).write_text('{"level":')
    found = provenance([], nodes, tmp_path)["arithmetic"]
    assert found == {"a": arithmetic()}
    json.dumps(found)


def test_a_full_disk_costs_the_note_only(tmp_path: Path) -> None:
    note_arithmetic(tmp_path / "missing")


OLD = {"level": "x86-64-v2", "glibc": "2.36", "numpy": "2.4.6 (baseline)"}
NEW = {"level": "x86-64-v4", "glibc": "2.36", "numpy": "2.4.6 (X86_V3)"}


def test_runs_differ_node_by_node_in_what_both_have() -> None:
    assert differences({"a": OLD}, {"a": OLD}) == ""
    assert differences({"a": OLD}, {"b": NEW}) == ""
    assert differences({}, {"a": NEW}) == ""
    assert differences({"a": OLD}, {"a": {**OLD, "mujoco": "4.0.0"}}) == ""
    words = "level x86-64-v2 in A, x86-64-v4 in B"
    assert differences({"a": OLD}, {"a": {**OLD, "level": "x86-64-v4"}}) == f"a: {words}"
    both = f"{words}; numpy 2.4.6 (baseline) in A, 2.4.6 (X86_V3) in B"
    a = {"a": OLD, "b": OLD, "c": OLD}
    b = {"a": NEW, "b": NEW, "c": {**OLD, "glibc": "2.41"}}
    assert differences(a, b) == f"a, b: {both}; c: glibc 2.36 in A, 2.41 in B"
