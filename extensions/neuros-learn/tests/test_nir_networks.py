"""Networks in NIR: the spikes of their exporters, step by step, and files from strangers."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from neuros_learn.nir import network
from neuros_learn.nir.network import Network, discretisation_of, problems_of
from neuros_learn.nir.network_file import NetworkError, read_graph

from neuros.api.loading import load_with_messages
from neuros.backends.docker.back_end import check_modules
from neuros.errors import HookError, ProjectError
from neuros.project.model import Node, Port
from neuros.project.split import project_to_json
from neuros.testing import PluginHarness

h5py = pytest.importorskip("h5py", reason="there is none in the lock files for this Python")
nir = pytest.importorskip("nir")
TRACES = Path(__file__).parent / "nir_traces"
RESETS = {
    "leaky_subtract_now": {"reset_delay": False},
    "leaky_zero": {"reset": "v_reset"},
    "leaky_zero_now": {"reset": "v_reset", "reset_delay": False},
    "synaptic_zero": {"reset": "v_reset"},
    "rleaky_zero": {"reset": "v_reset"},
}
MULTI = "std_msgs/msg/Float32MultiArray"


def single(*values: float) -> Any:
    return np.array(values, np.float32)


def write(file: Path, nodes: Mapping[str, Any], *edges: tuple[str, str]) -> Path:
    """A file of these nodes."""
    nir.write(file, nir.NIRGraph(dict(nodes), list(edges), type_check=False), compression=None)
    return file


def chain(file: Path, shape: tuple[int, ...], **nodes: Any) -> Path:
    """A file with these nodes in a row, between an Input of a shape and an Output."""
    ends = {"input": nir.Input(np.array(shape)), "output": nir.Output(np.array(shape))}
    names = ["input", *nodes, "output"]
    return write(file, {**ends, **nodes}, *pairwise(names))


def network_of(file: Path, **parameters: Any) -> Network:
    return Network(read_graph(file), discretisation_of(parameters))


def answers(network: Network, *inputs: Any) -> list[Any]:
    """What the one output gives for each input."""
    (name, shape), (output,) = next(iter(network.inputs.items())), network.outputs
    arrays = (np.asarray(each, np.float32).reshape(shape) for each in inputs)
    return [network.step({name: each})[output] for each in arrays]


def lif(count: int, **values: Any) -> Any:
    given = {"tau": 1e-3, "r": 10.0, "v_leak": 0.0, "v_threshold": 1.0, **values}
    return nir.LIF(**{name: np.full(count, value, np.float32) for name, value in given.items()})


class TestExporters:
    """``nir_traces`` has what snnTorch and Norse gave for their own networks, before the export."""

    @pytest.mark.parametrize("name", sorted(each.stem for each in TRACES.glob("*.npz")))
    def test_each_spike_is_the_exporter_s(self, name: str) -> None:
        exporter = "norse" if name.startswith("norse") else "snntorch"
        with np.load(TRACES / f"{name}.npz") as trace:
            inputs, wanted = trace["inputs"], trace["outputs"]
        network = network_of(TRACES / f"{name}.nir", exporter=exporter, **RESETS.get(name, {}))
        found = np.stack(answers(network, *inputs)).reshape(wanted.shape)
        if wanted.dtype == bool:
            assert wanted.any()
            assert not wanted.all()
            assert np.array_equal(found, wanted)
        else:  # potentials, of which the last bit depends on the order of sums
            assert np.abs(wanted).max() > 0.1
            assert np.allclose(found, wanted, rtol=0, atol=1e-6)

    @pytest.mark.parametrize(
        ("name", "parameters"),
        [
            ("leaky_subtract", {"exporter": "nir"}),
            ("leaky_subtract", {"exporter": "snntorch", "reset_delay": False}),
            ("leaky_zero", {"exporter": "snntorch"}),
            ("rleaky_zero", {"exporter": "snntorch", "reset": "v_reset", "reset_delay": False}),
            ("norse_lif", {"exporter": "nir", "dt": 1e-6}),
            ("norse_iaf", {"exporter": "nir", "dt": 1e-6}),
        ],
    )
    def test_another_discretisation_gives_other_spikes(
        self, name: str, parameters: dict[str, Any]
    ) -> None:
        with np.load(TRACES / f"{name}.npz") as trace:
            inputs, wanted = trace["inputs"], trace["outputs"]
        found = np.stack(answers(network_of(TRACES / f"{name}.nir", **parameters), *inputs))
        assert not np.array_equal(found.reshape(wanted.shape), wanted)

    def test_two_networks_of_one_file_give_the_same_and_share_no_state(self) -> None:
        graph, how = read_graph(TRACES / "rleaky_subtract.nir"), discretisation_of({})
        inputs = np.random.default_rng(1).random((50, 4))
        first, second = Network(graph, how), Network(graph, how)
        once = np.stack([*answers(first, *inputs[:25]), *answers(first, *inputs[25:])])
        assert np.array_equal(once, np.stack(answers(second, *inputs)))
        first.reset()
        assert np.array_equal(once, np.stack(answers(first, *inputs)))


class TestNodes:
    """What one node gives, against its definition."""

    def test_scale_threshold_and_linear(self, tmp_path: Path) -> None:
        file = chain(
            tmp_path / "net.nir",
            (2,),
            scale=nir.Scale(single(2, 3)),
            linear=nir.Linear(single(1, 1, 1, -1).reshape(2, 2)),
            threshold=nir.Threshold(single(0, 0)),
        )
        assert answers(network_of(file), [1, 1])[0].tolist() == [1, 0]

    def test_a_delay_is_rounded_to_steps_and_has_its_own_length_for_each_value(
        self, tmp_path: Path
    ) -> None:
        file = chain(tmp_path / "net.nir", (3,), delay=nir.Delay(np.array([0, 0.0101, 0.03])))
        given = [[k, k, k] for k in (1, 2, 3, 4, 5)]
        found = [each.tolist() for each in answers(network_of(file, dt=0.01), *given)]
        assert found == [[1, 0, 0], [2, 1, 0], [3, 2, 0], [4, 3, 1], [5, 4, 2]]

    def test_leaky_and_perfect_integrators_follow_euler(self, tmp_path: Path) -> None:
        leaky = nir.LI(tau=single(0.1), r=single(2), v_leak=single(0.5))
        file = chain(tmp_path / "li.nir", (1,), cell=leaky)
        v, wanted = 0.5, []
        for x in (1.0, 0.0, -1.0):
            v += 0.01 / 0.1 * (0.5 - v + 2 * x)
            wanted.append(v)
        found = answers(network_of(file, dt=0.01), 1, 0, -1)
        assert np.allclose(np.concatenate(found), wanted)
        file = chain(tmp_path / "i.nir", (1,), cell=nir.I(r=single(2)))
        assert np.allclose(answers(network_of(file, dt=0.5), 1, 1, -3), [[1], [2], [-1]])

    def test_a_spike_needs_more_than_the_threshold_and_resets_to_v_reset(
        self, tmp_path: Path
    ) -> None:
        cell = nir.IF(r=single(1), v_threshold=single(2), v_reset=single(-1))
        network = network_of(chain(tmp_path / "net.nir", (1,), cell=cell), dt=1.0)
        given = [1, 1, 0.5, 3, 0.5]
        assert np.concatenate(answers(network, *given)).tolist() == [0, 0, 1, 0, 1]

    def test_a_current_decays_by_itself(self, tmp_path: Path) -> None:
        values = {"tau_mem": 0.1, "tau_syn": 0.05, "r": 1.0, "v_leak": 0.0}
        cell = nir.CubaLI(**{name: single(value) for name, value in values.items()}, w_in=2.0)
        i = v = 0.0
        wanted = []
        for x in (1.0, 0.0, 0.0):
            i += 0.01 / 0.05 * (-i + 2 * x)
            v += 0.01 / 0.1 * (-v + i)
            wanted.append(v)
        file = chain(tmp_path / "net.nir", (1,), cell=cell)
        assert np.allclose(np.concatenate(answers(network_of(file, dt=0.01), 1, 0, 0)), wanted)

    @pytest.mark.parametrize("padding", [1, "same", "valid"])
    @pytest.mark.parametrize(("groups", "dilation"), [(1, 1), (2, 2)])
    def test_a_convolution_is_the_sum_under_its_kernel(
        self, padding: int | str, groups: int, dilation: int, tmp_path: Path
    ) -> None:
        rng, stride = np.random.default_rng(1), 1 if padding == "same" else 2
        weight = rng.normal(size=(4, 4 // groups, 3)).astype(np.float32)
        bias, x = rng.normal(size=4).astype(np.float32), rng.normal(size=(4, 9))
        node = nir.Conv1d(9, weight, stride, padding, dilation, groups, bias)
        file = chain(tmp_path / "net.nir", (4, 9), conv=node)
        around = {"same": dilation, "valid": 0}.get(str(padding), padding)
        padded = np.pad(x, [(0, 0), (int(around), int(around))])
        places = (padded.shape[1] - 2 * dilation - 1) // stride + 1
        wanted = np.empty((4, places))
        for out in range(4):
            first = out // (4 // groups) * (4 // groups)
            for place in range(places):
                under = padded[first : first + 4 // groups, place * stride :][:, ::dilation][:, :3]
                wanted[out, place] = (under * weight[out]).sum() + bias[out]
        assert np.allclose(answers(network_of(file), x)[0], wanted, atol=1e-5)

    def test_pools_count_their_padding(self, tmp_path: Path) -> None:
        sizes = {"kernel_size": (2, 3), "stride": (2, 1), "padding": (1, 0)}
        given = {name: np.array(value) for name, value in sizes.items()}
        x = np.arange(12.0).reshape(1, 3, 4)
        padded = np.pad(x[0], [(1, 1), (0, 0)])
        sums = [[padded[a : a + 2, b : b + 3].sum() for b in (0, 1)] for a in (0, 2)]
        for node, divisor in ((nir.SumPool2d(**given), 1), (nir.AvgPool2d(**given), 6)):
            file = chain(tmp_path / f"{divisor}.nir", (1, 3, 4), pool=node)
            assert np.allclose(answers(network_of(file), x)[0], np.array([sums]) / divisor)

    def test_flatten_joins_the_dimensions_that_it_names(self, tmp_path: Path) -> None:
        node = nir.Flatten(input_type={"input": np.array([2, 3, 4])}, start_dim=1, end_dim=-1)
        file = chain(tmp_path / "net.nir", (2, 3, 4), flat=node)
        x = np.arange(24.0).reshape(2, 3, 4)
        assert np.array_equal(answers(network_of(file), x)[0], x.reshape(2, 12))


class TestLoops:
    """What goes back takes one step more; what comes in passes the whole network in one."""

    def test_a_chain_takes_no_step_whatever_its_nodes_are_called(self, tmp_path: Path) -> None:
        cells = {name: lif(1, r=20.0) for name in ("z", "a", "m")}
        file = chain(tmp_path / "net.nir", (1,), **cells)
        assert answers(network_of(file), 1)[0].tolist() == [1]

    def test_a_long_loop_is_delayed_where_it_goes_back(self, tmp_path: Path) -> None:
        one = single(1).reshape(1, 1)
        nodes = {
            **{name: nir.I(r=single(1)) for name in ("first", "second")},
            **{name: nir.Linear(one) for name in ("on", "back")},
            "input": nir.Input(np.array([1])),
            "output": nir.Output(np.array([1])),
        }
        edges = ["input first", "first on", "on second", "second back", "back first"]
        pairs = [(a, b) for a, b in (each.split() for each in (*edges, "second output"))]
        found = answers(network_of(write(tmp_path / "n.nir", nodes, *pairs), dt=1.0), 1, 0, 0)
        # first += x + second (of the step before); second += first
        assert np.concatenate(found).tolist() == [1, 3, 8]

    def test_nested_graphs_are_passed_through(self, tmp_path: Path) -> None:
        inner = nir.NIRGraph(
            {"input": nir.Input(np.array([1])), "output": nir.Output(np.array([1]))},
            [("input", "output")],
        )
        file = chain(tmp_path / "net.nir", (1,), a=inner, scale=nir.Scale(single(3)), b=inner)
        assert answers(network_of(file), 2)[0].tolist() == [6]

    def test_one_without_a_neuron_is_refused(self, tmp_path: Path) -> None:
        nodes = {
            "input": nir.Input(np.array([1])),
            "a": nir.Scale(single(1)),
            "b": nir.Scale(single(1)),
            "output": nir.Output(np.array([1])),
        }
        edges = [("input", "a"), ("a", "b"), ("b", "a"), ("b", "output")]
        with pytest.raises(NetworkError, match="a loop has no neuron that could delay it: 'a', "):
            read_graph(write(tmp_path / "net.nir", nodes, *edges))


class TestStrangers:
    """Files that are no networks, or too large, or not supported."""

    def test_all_that_is_not_supported_is_named_with_its_path(self, tmp_path: Path) -> None:
        file = chain(tmp_path / "net.nir", (1,), a=lif(1), b=lif(1))
        with h5py.File(file, "r+") as content:
            for name, kind in (("a", "Izhikevich"), ("b", "Alpha")):
                del content[f"node/nodes/{name}/type"]
                content[f"node/nodes/{name}/type"] = kind
            content.copy("node/nodes/a", content["node/nodes"].create_group("rnn/nodes"), "cell")
            content["node/nodes/rnn/type"] = "NIRGraph"
            content["node/nodes/rnn"].create_dataset("edges", (0, 2), "f4")
        with pytest.raises(NetworkError) as caught:
            read_graph(file)
        assert caught.value.problems == [
            "node 'a': NIR's Izhikevich is not supported",
            "node 'b': NIR's Alpha is not supported",
            "node 'rnn/cell': NIR's Izhikevich is not supported",
        ]

    @pytest.mark.parametrize("content", [b"", b"no network\n", b"\x89HDF\r\n\x1a\n" + b"\0" * 90])
    def test_a_file_that_is_no_nir_is_told_in_a_sentence(
        self, content: bytes, tmp_path: Path
    ) -> None:
        file = tmp_path / "net.nir"
        file.write_bytes(content)
        with pytest.raises(NetworkError, match=r"^net\.nir is no network in NIR: \S[^\n]*$"):
            read_graph(file)

    def test_whatever_part_of_a_file_is_damaged_nothing_else_is_raised(
        self, tmp_path: Path
    ) -> None:
        whole = (TRACES / "rleaky_subtract.nir").read_bytes()
        rng, file, refused = np.random.default_rng(1), tmp_path / "net.nir", 0
        for _ in range(60):
            content = bytearray(
                whole[: rng.integers(1, len(whole))] if rng.random() < 0.2 else whole
            )
            for place in rng.integers(0, len(content), 20):
                content[place] = rng.integers(0, 256)
            file.write_bytes(content)
            try:
                Network(read_graph(file), discretisation_of({}))
            except NetworkError:
                refused += 1
        assert refused > 10

    def test_a_size_is_refused_before_memory_is_taken(self, tmp_path: Path) -> None:
        file = chain(tmp_path / "net.nir", (1,), fc=nir.Linear(single(1).reshape(1, 1)))
        with h5py.File(file, "r+") as content:
            del content["node/nodes/fc/weight"]
            content["node/nodes/fc"].create_dataset(
                "weight", (1 << 20, 1 << 20), "f4", chunks=(1024, 1024)
            )
        assert file.stat().st_size < 1 << 20
        with pytest.raises(NetworkError, match="the parameters are larger than 1024 MiB"):
            read_graph(file)

    @pytest.mark.parametrize(
        ("shape", "node", "what"),
        [
            ((5000, 5000), lif(1), "takes more than 16777216 values"),
            ((1,), nir.Delay(single(1e6)), "would hold more than 16777216 values"),
            (
                (1, 4, 4),
                nir.SumPool2d(np.array([2, 2]), np.array([1, 1]), np.array([9000, 9000])),
                "would hold more than 16777216 values",
            ),
            ((3,), lif(4), r"has parameters of the shape \(4,\), but is given the shape \(3,\)"),
            ((3,), lif(3, tau=0.0), "'tau' must be above 0"),
            ((3,), nir.Linear(np.ones((2, 4))), r"takes 4 values, but is given the shape \(3,\)"),
            ((1,), lif(1, v_threshold=math.nan), "'v_threshold' holds a value that is no number"),
            ((1,), nir.Scale(np.array([1e300])), "'scale' holds a value that is no number"),
            ((1,), nir.Affine(np.ones((1, 1)), np.ones(2)), r"parameters of the shape \(2,\)"),
        ],
    )
    def test_what_does_not_fit_names_the_node(
        self, shape: tuple[int, ...], node: Any, what: str, tmp_path: Path
    ) -> None:
        with pytest.raises(NetworkError, match=f"^node '(cell|input)'.* ?{what}"):
            network_of(chain(tmp_path / "net.nir", shape, cell=node))

    def test_links_to_other_files_are_not_followed(self, tmp_path: Path) -> None:
        file = chain(tmp_path / "net.nir", (1,), cell=lif(1))
        with h5py.File(file, "r+") as content:
            del content["node/nodes/cell/r"]
            content["node/nodes/cell/r"] = h5py.ExternalLink("other.h5", "/r")
        with h5py.File(tmp_path / "other.h5", "w") as other:
            other["r"] = single(1)
        with pytest.raises(NetworkError, match="/node/nodes/cell/r is not what NIR defines there"):
            read_graph(file)

    def test_graphs_in_graphs_without_end_are_refused(self, tmp_path: Path) -> None:
        file = chain(tmp_path / "net.nir", (1,), cell=lif(1))
        with h5py.File(file, "r+") as content:
            content["node/nodes/again"] = content["node"]
        with pytest.raises(NetworkError, match="graphs lie more than 20 deep in each other"):
            read_graph(file)

    def test_without_h5py_the_command_that_brings_it_is_told(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setitem(sys.modules, "h5py", None)
        with pytest.raises(NetworkError, match=r"read with h5py, which is not installed: .*nir"):
            read_graph(TRACES / "leaky_zero.nir")


class TestNode:
    """A network as the plugin of a node."""

    def test_a_packet_is_a_step(self) -> None:
        from std_msgs.msg import Float32MultiArray

        with np.load(TRACES / "leaky_zero_now.npz") as trace:
            inputs, wanted = trace["inputs"][:40], trace["outputs"][:40]
        # Of which the parameters are those of NIR.
        harness = PluginHarness(
            "neuros.snn.nir.plugin",
            inputs={"input": MULTI},
            outputs={"output": MULTI},
            environment={"NETWORK": str(TRACES / "leaky_zero_now.nir")},
        )
        for each in inputs:
            harness.send("input", Float32MultiArray(data=[float(x) for x in each]))
            harness.run()
        found = [packet.data.tolist() for packet in harness.received("output")]
        assert found == wanted.astype(float).tolist()

    def test_packets_may_be_arrays(self) -> None:
        with np.load(TRACES / "leaky_zero_now.npz") as trace:
            inputs, wanted = trace["inputs"][:40], trace["outputs"][:40]
        kinds = [f"float32[{each.shape[1]}]" for each in (inputs, wanted)]
        harness = PluginHarness(
            "neuros.snn.nir.plugin",
            inputs={"input": kinds[0]},
            outputs={"output": kinds[1]},
            environment={"NETWORK": str(TRACES / "leaky_zero_now.nir")},
        )
        harness.send("input", *inputs.astype(np.float32))
        harness.run()
        assert np.array_equal(harness.received("output"), wanted)

    def test_an_array_of_another_size_is_told(self) -> None:
        harness = PluginHarness(
            "neuros.snn.nir.plugin",
            inputs={"input": MULTI},
            outputs={"output": "float32[99]"},
            environment={"NETWORK": str(TRACES / "leaky_zero_now.nir")},
        )
        with np.load(TRACES / "leaky_zero_now.npz") as trace:
            packet = harness.make_packet("input")
            packet.data = trace["inputs"][0].astype(np.float32)
        harness.send("input", packet)
        with pytest.raises(HookError, match="output 'output' carries 99 values, and the network"):
            harness.run()

    def test_ports_and_parameters_are_checked_with_the_network(self) -> None:
        node = Node(
            "brain",
            "neuros_nir",
            Path(),
            inputs=(Port("inputs", "std_msgs/msg/String"),),
            outputs=(Port("output", MULTI),),
            parameters={"exporter": "lava", "dt": -1.0, "rest": 1, "reset": "half"},
        )
        assert sorted(problems_of(node, TRACES / "leaky_zero.nir")) == [
            "a network has no parameter 'rest' (did you mean 'reset'?)",
            "the input 'inputs' must be of float32[...], float64[...],"
            " std_msgs/msg/Float32MultiArray, Float32, Float64MultiArray or Float64,"
            " but is std_msgs/msg/String",
            "the network has no Input 'inputs', as the input (it has 'input')",
            "the node declares no input 'input', but the network has an Input of that name",
            "the parameter 'dt' must be a number of seconds, above 0",
            "the parameter 'exporter' must be 'nir', 'norse' or 'snntorch'",
            "the parameter 'reset' must be 'subtract', 'v_reset' or 'none'",
        ]


class TestProject:
    """The key ``network`` of a node."""

    @pytest.fixture
    def project(self, tmp_path: Path) -> Path:
        (tmp_path / "net.nir").write_bytes((TRACES / "leaky_zero_now.nir").read_bytes())
        port = {"type": MULTI, "external_topic": "/topic"}
        node = {
            "name": "brain",
            "container": "neuros_nir",
            "network": "net.nir",
            "inputs": [{"name": "input", **port}],
            "outputs": [{"name": "output", **port}],
            "parameters": {"exporter": "snntorch"},
        }
        (tmp_path / "project.json").write_text(json.dumps({"nodes": [node]}))
        return tmp_path

    def problems(self, project: Path, *settings: str) -> list[str]:
        with pytest.raises(ProjectError) as caught:
            load_with_messages(project, settings)
        return [f"{each.pointer}: {each.text}" for each in caught.value.problems]

    def test_it_is_a_plugin_of_neuros_with_the_file_in_its_environment(self, project: Path) -> None:
        loaded, _ = load_with_messages(project)
        (node,) = loaded.project.nodes
        assert not loaded.warnings
        assert node.module == "neuros.snn.nir.plugin"
        assert node.environment == {"NETWORK": str(project / "net.nir")}
        assert node.environment_paths == ("NETWORK",)

    def test_what_is_written_for_a_run_is_a_project_of_the_same_nodes(self, project: Path) -> None:
        nodes = load_with_messages(project)[0].project.nodes
        (project / "expanded.json").write_text(
            json.dumps(project_to_json(load_with_messages(project)[0].project))
        )
        (again,) = load_with_messages(project / "expanded.json")[0].project.nodes
        assert replace(again, file=nodes[0].file) == nodes[0]

    def test_its_container_in_docker_has_what_it_needs(self, project: Path) -> None:
        check_modules(load_with_messages(project)[0].project.nodes, project)

    def test_a_missing_file_and_one_that_is_no_network_are_told(self, project: Path) -> None:
        (told,) = self.problems(project, "nodes.brain.network=nor.nir")
        assert told.startswith("/nodes/0/network: ")
        assert "nor.nir" in told
        (project / "net.nir").write_text("nothing")
        (told,) = self.problems(project)
        assert told.startswith("/nodes/0/network: net.nir is no network in NIR: ")

    def test_a_plugin_beside_it_is_one_too_many(self, project: Path) -> None:
        (told,) = self.problems(project, "nodes.brain.plugin=json.decoder")
        assert told == "/nodes/0: needs exactly one of 'plugin', 'network' or 'policy'"

    def test_one_that_names_no_exporter_is_warned_of(self, project: Path) -> None:
        (warning,) = load_with_messages(project, ["nodes.brain.parameters.exporter="])[0].warnings
        assert "is stepped by NIR's own equations" in warning.text

    def test_without_h5py_here_it_is_left_to_the_node(
        self, project: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(network, "find_spec", lambda name: None)
        (project / "net.nir").write_text("nothing")
        (warning,) = load_with_messages(project)[0].warnings
        assert warning.text == "the network cannot be checked before the run"
        assert "nir" in warning.hint
