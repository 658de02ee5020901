"""Recorded spikes: a run's bag, opened by Neo and as a file of Neurodata Without Borders."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from needs import COMPILER, require
from neuros_analysis.spikes import trains_of

import neuros
import neuros.bag
from neuros.errors import EnvironmentFault, UsageError
from neuros.project.dashboard import SPIKES
from neuros.snn import Spikes

PLUGIN = """
import numpy as np
from neuros.hooks import neuros_function
from neuros.snn import Spikes

SPIKES = {0: [], 1: [(2, 0.15), (0, 0.11)], 2: [(2, 0.25)], 3: []}

@neuros_function(outputs="spikes")
def fire(node):
    step = node.get_user_data() or 0
    node.set_user_data(step + 1)
    if step == len(SPIKES) - 1:
        node.shutdown("all have fired")
    packet = node.make_packet("spikes")
    packet.header.stamp.nanosec = (step + 1) * 100_000_000
    found = np.array(SPIKES[step]).reshape(-1, 2)
    return Spikes(found[:, 0].astype(int), found[:, 1]).into(packet, 4)
"""
LISTENER = """
from neuros.hooks import neuros_function
from neuros.snn import Spikes

@neuros_function(inputs="spikes")
def hear(node, spikes):
    heard = Spikes.of(spikes)
    node.get_logger().info(f"{heard.neuron.tolist()} {heard.time_s.tolist()}")
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> neuros.Run:
    require(*COMPILER)
    folder = tmp_path_factory.mktemp("spikes")
    ports = [{"name": "spikes", "type": SPIKES}]
    nodes: list[dict[str, Any]] = [{"name": "population", "outputs": ports}]
    nodes += [{"name": "listener", "inputs": ports}]
    for node, text in zip(nodes, (PLUGIN, LISTENER), strict=True):
        node |= {"plugin": f"{node['name']}.py", "container": "neuros_python"}
        (folder / node["plugin"]).write_text(text)
    ends = ("population", "spikes", "listener", "spikes")
    keys = ("source_node", "source_output", "destination_node", "destination_input")
    connection = {**dict(zip(keys, ends, strict=True)), "discard_limit": 0}
    (folder / "project.json").write_text(json.dumps({"nodes": nodes, "connections": [connection]}))
    project = neuros.Project.from_file(folder)
    return project.run(backend="in-process", record=True, output=folder / "run").check()


@pytest.fixture
def topic(run: neuros.Run) -> Iterator[Any]:
    with neuros.bag.open(run.folder) as bag:
        yield bag["population.spikes"]


def test_a_node_reads_what_another_has_sent_by_time(run: neuros.Run) -> None:
    log = (run.folder / "listener/node.log").read_text()
    assert "[0, 2] [0.11, 0.15]" in log


def test_neo_has_a_train_for_each_neuron_over_the_whole_recording(topic: Any) -> None:
    segment = topic.neo()
    trains = segment.spiketrains
    assert [train.rescale("ms").magnitude.tolist() for train in trains] == [
        [pytest.approx(110.0)],
        [],
        [pytest.approx(150.0), pytest.approx(250.0)],
        [],
    ]
    assert {(float(train.t_start), float(train.t_stop)) for train in trains} == {(0.0, 0.4)}
    assert [train.annotations["neuron"] for train in trains] == [0, 1, 2, 3]
    assert segment.annotations["connection"] == "population.spikes -> listener.spikes"


@pytest.mark.skipif(sys.version_info >= (3, 14), reason="there is no PyNWB for this Python")
def test_a_file_of_nwb_has_a_unit_for_each_neuron(topic: Any, tmp_path: Path) -> None:
    pynwb = pytest.importorskip("pynwb")
    topic.nwb(tmp_path / "spikes.nwb")
    with pynwb.NWBHDF5IO(str(tmp_path / "spikes.nwb"), "r") as reader:
        content = reader.read()
        units = content.units.to_dataframe()
        assert units["spike_times"].map(list).tolist() == [[0.11], [], [0.15, 0.25], []]
        assert units["obs_intervals"].map(np.ravel).map(list).tolist() == 4 * [[0.0, 0.4]]
        assert content.identifier == topic._bag.custom["run_id"]
    assert pynwb.validate(path=str(tmp_path / "spikes.nwb")) in ([], ([], 0))


def recorded(
    size: list[int], senders: list[list[int]], times: list[list[float]], kind: str = SPIKES
) -> Any:
    def column(rows: list[list[Any]]) -> Any:
        made = np.empty(len(rows), object)
        made[:] = [np.array(row) for row in rows]
        return made

    columns = {
        "size": np.array(size, np.uint32),
        "senders": column(senders),
        "times": column(times),
        "header.stamp.sec": np.zeros(len(size), np.int32),
        "header.stamp.nanosec": np.zeros(len(size), np.uint32),
    }
    return SimpleNamespace(name="/s", type=kind, connection=None, columns=lambda: columns)


@pytest.mark.parametrize(
    ("topic", "said"),
    [
        (recorded([], [], []), "/s has no packet"),
        (recorded([2, 3], [[], []], [[], []]), "has 2 neurons, then 3"),
        (recorded([2], [[0, 1]], [[0.1]]), "2 senders, but 1 times"),
        (recorded([2], [[2]], [[0.1]]), "a spike of neuron 2 among 2"),
        (recorded([2], [[0]], [[0.1]], "std_msgs/msg/String"), f"spike trains need {SPIKES}"),
    ],
)
def test_what_is_no_population_is_refused_by_name(topic: Any, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        trains_of(topic)


def test_a_spike_of_no_neuron_is_not_sent() -> None:
    packet = SimpleNamespace()
    with pytest.raises(ValueError, match="a spike of neuron 4 in a population of 4"):
        Spikes(np.array([4]), np.array([0.1])).into(packet, 4)


def test_a_missing_library_is_named_with_its_installation(
    topic: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "neo", None)
    with pytest.raises(EnvironmentFault, match=r"neo is not installed .*: pip install neo"):
        topic.neo()
