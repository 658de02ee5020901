"""``--portable``: the same packets on a processor with AVX2, FMA or AVX-512, and on one without.

Variables stand for a processor without: libraries then choose what they choose there.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from launching import EXAMPLES, Finished, launch

import neuros
from neuros.arithmetic import active_features, level
from neuros.cli.main import main
from neuros.errors import UsageError

STRICT = EXAMPLES / "4_neurorobotics/whiskeye/strict.json"
V3 = "X86_V3 X86_V4 AVX512_ICL AVX512_SPR"
BEFORE_V3 = "AVX2 FMA3 AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL"
NATIVE: dict[str, str] = {}
WITHOUT_FMA = {
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA",
    "NPY_DISABLE_CPU_FEATURES": f"{V3} {BEFORE_V3}",
    "OPENBLAS_CORETYPE": "Sandybridge",
}
OTHER = {
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F:glibc.malloc.check=0",
    "NPY_ENABLE_CPU_FEATURES": "SSE SSE2 SSE3",
    "OPENBLAS_CORETYPE": "Haswell",
    "OMP_NUM_THREADS": "2",
    "OPENBLAS_NUM_THREADS": "2",
}
LEVELS = {"native": NATIVE, "without FMA": WITHOUT_FMA, "other": OTHER}
HAS_FMA = level(active_features()) >= "x86-64-v3"

COMPUTES = """
import math, os
import numpy as np
from neuros.hooks import neuros_function, neuros_initialise

def libm(x):
    for _ in range(300):  # chaotic: a last bit becomes another number
        x = [math.sin(3.0 * each) for each in x]
    return x

def numpy(x):
    return np.exp(x) + np.log(x + 4)

def blas(x):
    return np.linalg.svd(np.outer(x, x) @ np.outer(x, x[::-1]) + np.diag(x), compute_uv=False)

@neuros_initialise(outputs="numbers")
def compute(node):
    x = np.random.Generator(np.random.PCG64(7)).uniform(-3, 3, 100)
    return np.asarray(globals()[node.name](x), np.float64)
"""
READS = """
from neuros.hooks import neuros_function

@neuros_function(inputs=["libm", "numpy", "blas"])
def read(node, *numbers):
    node.shutdown("all have computed")
"""


def computers(folder: Path, **keys: Any) -> Path:
    """A project whose nodes compute with the C library, with NumPy and with its OpenBLAS."""
    (folder / "computes.py").write_text(COMPUTES)
    (folder / "reads.py").write_text(READS)
    names, kind = ("libm", "numpy", "blas"), "float64[100]"
    nodes = [
        {"name": name, "container": "neuros_python", "plugin": "computes.py",
         "outputs": [{"name": "numbers", "type": kind}]}
        for name in names
    ]  # fmt: skip
    inputs = [{"name": name, "type": kind} for name in names]
    reader = {"name": "reader", "container": "neuros_python", "plugin": "reads.py"}
    connections = [
        {"source_node": name, "source_output": "numbers", "destination_node": "reader",
         "destination_input": name, "discard_limit": 0}
        for name in names
    ]  # fmt: skip
    content = {"nodes": [*nodes, {**reader, "inputs": inputs}], "connections": connections, **keys}
    (folder / "project.json").write_text(json.dumps(content))
    return folder


def digests(run: Finished) -> dict[str, str]:
    assert run.exit_code == 0, run.output
    return {each["connection"]: each["digests"]["sent"] for each in run.record["connections"]}


def runs(
    project: Path, folder: Path, *options: str, backend: str = "in-process"
) -> dict[str, Finished]:
    """A run on each of the processors."""
    found = {}
    for name, environment in LEVELS.items():
        (folder / name).mkdir(parents=True)
        found[name] = launch(
            *(project, "--backend", backend, "--digests", *options),
            cwd=folder / name,
            NEUROS_GUI="0",
            **environment,
        )
    return found


@pytest.mark.parametrize("backend", ["process", "in-process"])
def test_a_portable_run_computes_the_same_on_each_processor(backend: str, tmp_path: Path) -> None:
    found = runs(computers(tmp_path), tmp_path / "runs", "--portable", backend=backend)
    first, *others = map(digests, found.values())
    assert others == [first, first]
    assert all(run.record["is_portable"] for run in found.values())
    levels = {node["level"] for run in found.values() for node in run.record["arithmetic"].values()}
    assert len(levels) == 1
    assert levels.pop().startswith("x86-64-v2")


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Finished]:
    """Runs that are not portable."""
    if not HAS_FMA:
        pytest.skip("this processor has no FMA: there is no difference to see")
    folder = tmp_path_factory.mktemp("plain")
    return runs(computers(folder), folder / "runs")


def test_without_it_each_library_computes_something_else(plain: dict[str, Finished]) -> None:
    native, without, other = map(digests, plain.values())
    for name in native:
        assert len({native[name], without[name], other[name]}) > 1, name
    assert not plain["native"].record["is_portable"]
    assert plain["native"].record["arithmetic"]["libm"]["level"] == level(active_features())


def test_whiskeye_has_one_digest(tmp_path: Path) -> None:
    """A robot in MuJoCo, and a network in NEST."""
    for needed in ("mujoco", "nest", "matplotlib"):
        pytest.importorskip(needed)
    found = runs(STRICT, tmp_path / "portable", "--portable", "--duration", "1sim")
    first, *others = map(digests, found.values())
    assert others == [first, first]
    libraries = found["native"].record["arithmetic"]["snn"]
    assert {"processor", "glibc", "openblas", "numpy", "mujoco", "nest"} < libraries.keys()
    if HAS_FMA:
        plain = runs(STRICT, tmp_path / "plain", "--duration", "1sim")
        assert digests(plain["native"]) != digests(plain["without FMA"])


def test_verify_names_the_processor_as_the_likely_cause(
    plain: dict[str, Finished], capsys: pytest.CaptureFixture[str]
) -> None:
    folders = [str(plain[name].run_folder) for name in ("native", "without FMA")]
    assert main(["verify", *folders]) == 1
    cause, verdict = capsys.readouterr().out.splitlines()[-2:]
    assert re.fullmatch(
        r"likely cause: libm, numpy, blas, reader: level x86-64-v\d in A, x86-64-v2.* in B;"
        r" openblas .* Sandybridge in B; numpy .* in B \(run both with --portable\)",
        cause,
    )
    assert verdict.startswith("different: ")
    assert main(["verify", *folders, "--format", "json"]) == 1
    assert f"likely cause: {json.loads(capsys.readouterr().out)['likely_cause']}" == cause


def test_a_project_can_ask_for_it(tmp_path: Path) -> None:
    project = computers(tmp_path, portable=True)
    for options, is_portable in (((), True), (("--no-portable",), False)):
        (tmp_path / str(is_portable)).mkdir()
        arguments = (project, "--backend", "in-process", *options)
        run = launch(*arguments, cwd=tmp_path / str(is_portable))
        assert run.exit_code == 0, run.output
        assert run.record["is_portable"] is is_portable
        assert run.record["expanded_project"].get("portable", False) is is_portable
        has = "OPENBLAS_CORETYPE" in run.record["expanded_project"]["nodes"][0]["environment"]
        assert has is is_portable


def test_a_wrong_value_in_the_project_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    project = computers(tmp_path, portable="yes")
    assert main(["validate", str(project)]) == 3
    assert "/portable: must be true or false, but is a text" in capsys.readouterr().err


def test_the_runs_of_a_sweep_are_portable(tmp_path: Path) -> None:
    project = computers(tmp_path)
    output = tmp_path / "sweep"
    neuros.sweep(project, repeat=2, backend="in-process", portable=True, output=output)
    records = [json.loads(file.read_text()) for file in output.glob("*/run.json")]
    assert [record["is_portable"] for record in records] == [True, True]
    assert records[0]["arithmetic"] == records[1]["arithmetic"]


PROGRAM = """
import sys, neuros
with neuros.Project.from_file(sys.argv[1]).session(portable=True, output=sys.argv[2]) as session:
    session.step()
"""


def test_a_session_in_a_program_that_was_started_otherwise_says_how_to_start_it(
    tmp_path: Path,
) -> None:
    project = neuros.Project.from_file(computers(tmp_path))
    with pytest.raises(UsageError) as refused:
        project.session(backend="local", portable=True)
    assert 'session(backend="in-process")' in str(refused.value)
    (line,) = re.findall(r"^  env (.*) python PROGRAM$", str(refused.value), re.MULTILINE)
    settings = dict(each.split("=", 1) for each in shlex.split(line))
    own = {key: value for key, value in os.environ.items() if key != "NEUROS_BACKEND"}
    command = [sys.executable, "-W", "ignore", "-c", PROGRAM, str(tmp_path), str(tmp_path / "out")]
    done = subprocess.run(command, env={**own, **settings}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    record = json.loads((tmp_path / "out/run.json").read_text())
    assert record["is_portable"]
    assert record["arithmetic"]["blas"]["level"].startswith("x86-64-v2")
    assert "Nehalem" in record["arithmetic"]["blas"]["openblas"]


def test_a_session_in_a_process_of_its_own_is_portable_as_it_is(tmp_path: Path) -> None:
    project = neuros.Project.from_file(computers(tmp_path))
    with project.session(backend="in-process", portable=True, output=tmp_path / "out") as session:
        session.step()
        run = session.close()
    assert run.record["is_portable"]
    assert run.record["arithmetic"]["libm"]["level"].startswith("x86-64-v2")
