"""A plugin that was written for NEST 2 is told what things are called today, by its error."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from neuros.errors import HookError, PluginError
from neuros.node.plugin import FUNCTIONS, MODELS, PARAMETERS, load_plugin, nest2_hint
from neuros.project.model import Node
from neuros.snn import reset_kernel
from neuros.testing import PluginHarness

HOOK = """
import nest

from neuros.hooks import neuros_initialise


@neuros_initialise()
def begin(node):
    nodes = nest.Create("iaf_psc_alpha", 2)
    recorder = nest.Create("spike_recorder")
    {statement}
"""


@pytest.fixture(autouse=True)
def nest():
    return reset_kernel(1)


def error_of(statement: str, folder: Path) -> str:
    """What the error of a hook with that statement says, in one line."""
    plugin = folder / "brain.py"
    plugin.write_text(HOOK.format(statement=statement), "utf-8")
    with PluginHarness(plugin) as harness, pytest.raises(HookError) as caught:
        harness.run()
    return str(caught.value)


class TestTable:
    """Every name of today exists in the NEST that is installed, and no name of NEST 2 does."""

    def test_models(self, nest) -> None:
        known = {*nest.node_models, *nest.synapse_models}
        assert set(MODELS.values()) <= known
        assert not set(MODELS) & known

    def test_functions(self, nest) -> None:
        assert all(callable(getattr(nest, name)) for name in FUNCTIONS.values())
        assert not [name for name in FUNCTIONS if hasattr(nest, name)]

    def test_parameters(self, nest) -> None:
        nodes = nest.Create("iaf_psc_alpha", 2)
        rule = {"rule": "fixed_indegree", "indegree": 1}
        rule |= {"allow_autapses": True, "allow_multapses": True}
        nest.Connect(nodes, nodes, rule, {"synapse_model": "static_synapse"})
        recorder = nest.Create("spike_recorder")
        for backend in ("ascii", "screen", "memory"):
            recorder.set(record_to=backend)
        known = {"synapse_model", "allow_autapses", "allow_multapses", "record_to"}
        known |= {*nest.GetDefaults("spike_generator"), *nest.GetKernelStatus()}
        assert set(PARAMETERS.values()) <= known


@pytest.mark.parametrize(
    ("statement", "hint"),
    [
        (
            'nest.Create("spike_detector")',
            "spike_detector is of NEST 2: NEST 3 calls it spike_recorder",
        ),
        ('nest.Create("iaf_neuron", 10)', "iaf_neuron is of NEST 2: NEST 3 calls it iaf_psc_alpha"),
        (
            'nest.GetDefaults("iaf_neuron")',
            "iaf_neuron is of NEST 2: NEST 3 calls it iaf_psc_alpha",
        ),
        (
            'nest.Connect(nodes, nodes, "all_to_all", "stdp_nn_pre-centered_synapse")',
            "stdp_nn_pre-centered_synapse is of NEST 2: NEST 3 calls it"
            " stdp_nn_pre_centered_synapse",
        ),
        (
            'nest.Connect(nodes, nodes, "all_to_all", {"model": "static_synapse"})',
            "model is of NEST 2: NEST 3 calls it synapse_model",
        ),
        (
            'nest.Connect(nodes, nodes, model="static_synapse")',
            "model is of NEST 2: NEST 3 calls it synapse_model",
        ),
        ("nest.ResetNetwork()", "ResetNetwork is of NEST 2: NEST 3 calls it ResetKernel"),
        ("from nest import PrintNetwork", "PrintNetwork is of NEST 2: NEST 3 calls it PrintNodes"),
        (
            "nest.BeginSubnet()",
            "BeginSubnet is of NEST 2: NEST 3 has no subnets: what `Create` returns",
        ),
        ('nest.sli_run("ResetKernel")', "sli_run is of NEST 2: NEST 3 has no SLI"),
        (
            "import nest.topology as topology",
            "topology is of NEST 2: NEST 3 has it in `nest`",
        ),
        (
            "nest.SetKernelStatus({'grng_seed': 12})",
            "grng_seed is of NEST 2: NEST 3 calls it rng_seed",
        ),
        ("nest.GetKernelStatus('time')", "time is of NEST 2: NEST 3 calls it biological_time"),
        (
            'recorder.set({"to_file": True, "withtime": True})',
            "to_file is of NEST 2: NEST 3 calls it record_to; "
            "withtime is of NEST 2: NEST 3 always records it: leave it out",
        ),
    ],
)
def test_the_error_says_what_a_name_of_nest_2_is_today(
    statement: str, hint: str, tmp_path: Path
) -> None:
    message = error_of(statement, tmp_path)
    assert f"({hint}" in message
    assert str(tmp_path / "brain.py") in message


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("function", ["GetStatus(list(nodes))", "SetStatus([1, 2], {'V_m': 1.0})"])
def test_a_list_where_nest_3_takes_nodes_is_said(function: str, tmp_path: Path) -> None:
    assert "NEST 3 takes what `Create` returned" in error_of(f"nest.{function}", tmp_path)


def test_a_plugin_that_cannot_be_imported_is_told_the_same(tmp_path: Path) -> None:
    (tmp_path / "brain.py").write_text("import nest\nnest.CreateLayer({})\n", "utf-8")
    with (
        pytest.raises(PluginError, match=r"\(CreateLayer is of NEST 2: NEST 3 calls it Create\)"),
        PluginHarness(tmp_path / "brain.py") as harness,
    ):
        harness.run()


@pytest.mark.parametrize(
    "error",
    [
        AttributeError("'Robot' object has no attribute 'time'"),
        KeyError("model"),
        ValueError("the spike_detector is broken"),
        AttributeError("'list' object has no attribute 'get'", name="get"),
    ],
)
def test_other_errors_get_no_hint(error: Exception) -> None:
    assert not nest2_hint(error, str(error))


def test_another_mistake_with_nest_gets_no_hint(tmp_path: Path) -> None:
    assert "NEST 2" not in error_of('nest.Create("spike_recordr")', tmp_path)
    assert "NEST 2" not in error_of("nodes.set(V_q=1.0)", tmp_path)


def test_after_a_plugin_that_imports_nest_libraries_share_no_symbols(tmp_path: Path) -> None:
    """Else of two messages with one name, in two packages, the second is taken for the first."""
    plugin = tmp_path / "plugin.py"
    plugin.write_text(
        "import nest\nfrom neuros.hooks import neuros_initialise\n"
        "@neuros_initialise()\ndef begin(node): ...\n"
    )
    before = sys.getdlopenflags()
    load_plugin(Node("node", "neuros_nest", plugin))
    assert sys.getdlopenflags() == before
