"""Quality of service of external topics, and ROS parameters, as files have them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from rclpy.qos import QoSPresetProfiles

from neuros.project.load import LoadedProject, load_project
from neuros.project.model import parameters_of
from neuros.project.qos import ASKED, OFFERED, PRESETS, Qos, qos_of, qos_to_json
from neuros.transport.ros_graph import qos_profile

POLICIES = ("reliability", "durability", "depth", "history", "liveliness", "deadline")


def test_the_presets_are_those_of_rclpy() -> None:
    assert set(PRESETS) == set(QoSPresetProfiles.short_keys()) - {"unknown"} | {
        "services_default",
        "parameter_events",
    }
    for name, qos in PRESETS.items():
        ours, of_ros = qos_profile(qos), QoSPresetProfiles.get_from_short_key(name)
        for policy in POLICIES:
            assert getattr(ours, policy) == getattr(of_ros, policy), (name, policy)


@pytest.mark.parametrize(
    ("written", "of_input", "of_output"),
    [
        ({}, ASKED, OFFERED),
        ({"depth": 3}, Qos("best_effort", depth=3), Qos("reliable", depth=3)),
        ({"reliability": "best_effort"}, Qos("best_effort"), Qos("best_effort")),
        # Only a reliable reader gets what was sent before it came.
        *[({"durability": "transient_local"}, Qos("reliable", "transient_local"), None)],
    ],
)
def test_what_is_left_out_is_as_without_it(
    written: dict[str, Any], of_input: Qos, of_output: Qos | None
) -> None:
    assert qos_of(written, is_input=True) == of_input
    assert qos_of(written, is_input=False) == (of_output or of_input)


@pytest.mark.parametrize(
    "qos", [*PRESETS.values(), Qos("best_effort", "transient_local", 7)], ids=repr
)
def test_what_is_written_back_means_the_same(qos: Qos) -> None:
    for is_input in (True, False):
        assert qos_of(qos_to_json(qos), is_input=is_input) == qos


def load(folder: Path, **keys: Any) -> LoadedProject:
    (folder / "a.py").touch()
    port = {"name": "x", "type": "std_msgs/msg/String", "external_topic": "x", **keys}
    node = {"name": "a", "container": "neuros_python", "plugin": "a.py", "inputs": [port]}
    (folder / "project.json").write_text(json.dumps({"nodes": [node]}))
    return load_project(folder, workspace=folder)


def test_latched_and_best_effort_at_once_is_a_warning(tmp_path: Path) -> None:
    qos = {"durability": "transient_local", "reliability": "best_effort"}
    (warning,) = load(tmp_path, qos=qos).warnings
    assert "transient_local has no effect with best_effort" in str(warning)
    assert load(tmp_path, qos={"durability": "transient_local"}).warnings == ()


def test_parameters_have_the_names_that_ros_gives_them() -> None:
    written = {"use_sim_time": True, "gain": {"p": 1.5, "deep": {"er": "x"}}, "list": [1, 2.5]}
    assert parameters_of(written) == {
        "use_sim_time": True,
        "gain.p": 1.5,
        "gain.deep.er": "x",
        "list": (1.0, 2.5),
    }
