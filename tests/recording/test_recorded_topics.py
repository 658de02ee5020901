"""Names and quality of service of recorded topics are those that the ROS graph has."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from recordings import NUMBER, number, plan, record, spool
from rosbags.rosbag2 import Reader

import neuros.bag
from neuros.project.model import Connection, Node, Port, Project
from neuros.project.names import Names
from neuros.project.qos import PRESETS, Qos
from neuros.recording.recording_plan import RecordingPlan, RecordingRequest, Topic, plan_recording

INT = "std_msgs/msg/Int32"
LATCHED = Qos("reliable", "transient_local", 1)


def planned(names: Names) -> RecordingPlan:
    a = Node(
        "a",
        "neuros_python",
        Path("a.py"),
        inputs=(
            Port("plain", INT, "plain"),
            Port("sure", INT, "/sure", qos=PRESETS["default"]),
            Port("fast", INT, "~/fast", qos=PRESETS["sensor_data"]),
        ),
        outputs=(Port("n", INT), Port("map", INT, "map", qos=LATCHED), Port("said", INT, "/said")),
    )
    b = Node("b", "neuros_python", Path("b.py"), inputs=(Port("n", INT),))
    wire = Connection("a", "n", "b", "n", 0, namespace=names.namespace)
    project = Project("p", (a, b), (wire,), Path("project.json"), names=names)
    return plan_recording(project, ("a", "b"), RecordingRequest(True), is_alone=False, custom={})


def test_topics_are_recorded_with_the_quality_of_service_that_the_project_says() -> None:
    found = {topic.name: topic for topic in planned(Names()).topics}
    assert found == {
        "/neuros/a/n/b/n/data": Topic("/neuros/a/n/b/n/data", INT, True, 1, "a.n -> b.n"),
        "/plain": Topic("/plain", INT, is_reliable=False),
        "/sure": Topic("/sure", INT),
        "/a/fast": Topic("/a/fast", INT, is_reliable=False, depth=5),
        "/map": Topic("/map", INT, depth=1, is_latched=True),
        "/said": Topic("/said", INT),
    }


def test_topics_are_recorded_by_the_names_that_namespace_and_rules_give_them() -> None:
    found = planned(Names("/left", (("/said", "said"), ("/clock", "clock"), ("plain", "/all"))))
    assert [topic.name for topic in found.topics] == [
        "/left/neuros/a/n/b/n/data",
        "/left/map",
        "/left/said",
        "/all",
        "/sure",
        "/left/a/fast",
    ]
    assert found.listen == ("/left/clock",)


def test_a_bag_tells_what_was_latched(tmp_path: Path) -> None:
    spool(tmp_path, "a", [(10, None, number(-3))])
    latched = replace(NUMBER, is_latched=True)
    others = plan().topics[1:]
    record(tmp_path, replace(plan(), topics=(latched, *others)))
    with Reader(tmp_path / "bag") as reader:
        offered = {c.topic: c.ext.offered_qos_profiles[0] for c in reader.connections}
    assert offered[latched.name].durability.name == "TRANSIENT_LOCAL"
    assert {offered[other.name].durability.name for other in others} == {"VOLATILE"}
    with neuros.bag.open(tmp_path) as bag:
        assert bag[latched.name].is_latched
        assert not bag[others[0].name].is_latched
