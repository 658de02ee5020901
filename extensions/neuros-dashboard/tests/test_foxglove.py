"""Foxglove on real runs, through its own protocol: what an app gets, and what it may do."""

from __future__ import annotations

import base64
import contextlib
import json
import re
import socket
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from deadlines import wait_until
from foxglove_app import DEADLINE_S, App, app
from launching import Running, start
from neuros_dashboard import web
from neuros_dashboard.web import FOXGLOVE, HOST
from sensor_msgs.msg import Image, Imu
from std_msgs.msg import Float64
from visitor import IMU, WATCHED, Visitor, address
from websockets.exceptions import ConnectionClosedOK

from neuros.control import GetStatus, NodeStatus, Pause, Step
from neuros.errors import EnvironmentFault
from neuros.node.sampling import MOST_VALUES, Sampler
from neuros.registry import BACK_ENDS
from neuros.simulators.mujoco.scene import WorldView
from neuros.transport.codecs import message_codec

foxglove_feed = pytest.importorskip("neuros_dashboard.foxglove_feed")
TURNING = Path(__file__).with_name("turning")
USUAL_PORT = 8765
FLOAT = "std_msgs/msg/Float64"


def url_of(running: Running) -> str:
    running.wait_for("foxglove: ws://")
    (found,) = re.findall(r"foxglove: (ws://\S+),", running.output)
    return str(found)


def sent(connected: App) -> int:
    figures = json.loads(connected.next("/neuros/run"))["connections"].get(IMU, {})
    return int(figures.get("sent", 0))


def test_an_app_sees_a_run_and_pauses_and_steps_it_beside_a_dashboard(tmp_path: Path) -> None:
    with contextlib.ExitStack() as stack:
        taken = stack.enter_context(socket.socket())
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        with contextlib.suppress(OSError):  # somebody else has it: all the same
            taken.bind((HOST, USUAL_PORT))
            taken.listen()
        options = ("--viewer", "foxglove", "--dashboard")
        running = stack.enter_context(start(WATCHED, *options, cwd=tmp_path))
        url = url_of(running)
        port = int(url.rpartition(":")[2])
        assert port != USUAL_PORT, "it is taken, so any free one is good"
        connected = stack.enter_context(app(url))
        assert Visitor(address(running)).get("/") == 200

        # ROS messages are what they are, with their definitions.
        imu = connected.channels["/world/imu"]
        assert (imu["encoding"], imu["schemaEncoding"]) == ("cdr", "ros2msg")
        assert imu["schemaName"] == "sensor_msgs/msg/Imu"
        assert "MSG: geometry_msgs/Quaternion" in imu["schema"]
        for topic in ("/world/imu", "/world/image", "/neuros/run", "/neuros/log"):
            connected.subscribe(topic)
        assert message_codec(Imu).decode(connected.next("/world/imu")).header.frame_id == "head"
        image = message_codec(Image).decode(connected.next("/world/image"))
        assert (image.width, image.height) == (640, 480)
        wait_until(lambda: b"run folder" in connected.next("/neuros/log"), DEADLINE_S)

        # A paused run makes steps: each sends a packet.
        assert connected.call("/neuros/pause", {}) == {}
        wait_until(lambda: json.loads(connected.next("/neuros/run"))["is_paused"], DEADLINE_S)
        before = sent(connected)
        assert connected.call("/neuros/step", {"count": 3}) == {}
        wait_until(lambda: sent(connected) >= before + 3, DEADLINE_S)
        for wrong in ({"count": 0}, {"count": "three"}, ["count"]):
            assert 'give {"count": N} with N from 1 to 1000000' in connected.call(
                "/neuros/step", wrong
            )
        assert connected.call("/neuros/resume", {}) == {}
        wait_until(lambda: sent(connected) > before + 10, DEADLINE_S)

        # Other machines have no way in; the end of the run ends the connection.
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.2", port), timeout=DEADLINE_S)
        assert Visitor(address(running)).post("/do/stop") == 204
        with pytest.raises(ConnectionClosedOK):
            connected.next("nothing more")
        finished = running.finish()
    assert finished.exit_code == 0
    assert finished.run_folder is not None
    assert (finished.run_folder / "foxglove.log").read_text() == ""


def test_a_robot_in_mujoco_is_a_scene_whose_frames_move(tmp_path: Path) -> None:
    options = ("--viewer", "foxglove", "--backend", "in-process")
    with start(TURNING, *options, cwd=tmp_path) as running, app(url_of(running)) as connected:
        connected.subscribe("/neuros/world")
        connected.subscribe("/tf")
        assert b"robot/arm" in connected.next("/neuros/world")
        still = connected.next("/tf")
        assert b"robot/arm" in still
        wait_until(lambda: connected.next("/tf")[-40:] != still[-40:], DEADLINE_S)
        # Who comes later gets the scene, too.
        with app(url_of(running)) as second:
            second.subscribe("/neuros/world")
            assert b"robot/arm" in second.next("/neuros/world")


@pytest.fixture
def feed() -> Any:
    sources = [
        {"node": "a", "port": "x", "name": "a.x", "topic": "/a/x", "ros_type": FLOAT},
        {"node": "a", "port": "y", "name": "a.y", "topic": "/a/y", "ros_type": "no_msgs/msg/No"},
    ]
    with socket.socket() as free:
        free.bind((HOST, 0))
        port = free.getsockname()[1]
    served = foxglove_feed.FoxgloveFeed("p", HOST, port, ["a"], sources)
    served.url = f"ws://{HOST}:{port}"
    yield served
    served.close()


def test_nothing_is_asked_of_nodes_while_nobody_looks(feed: Any) -> None:
    assert [*feed.ask()] == []
    with app(feed.url) as connected:
        assert [*feed.ask()] == []
        assert not feed.wants_log
        connected.subscribe("/a/x")
        asked: list[Any] = []
        wait_until(lambda: asked.extend(feed.ask()) or asked, DEADLINE_S)
        assert asked[0] == GetStatus({"a": {"x": {"packets": True}}})
        connected.unsubscribe()
        wait_until(lambda: [*feed.ask()] == [], DEADLINE_S)
        connected.subscribe("/tf")
        asked.clear()
        wait_until(lambda: asked.extend(feed.ask()) or asked, DEADLINE_S)
        assert asked[0] == GetStatus({"a": {"#world": {"frames": True, "geometry": True}}})
    wait_until(lambda: [*feed.ask()] == [], DEADLINE_S)


def test_a_message_type_that_is_not_installed_is_said_and_left_out(feed: Any) -> None:
    with app(feed.url) as connected:
        assert "/a/y" not in connected.channels
        connected.subscribe("/a/x")
        wait_until(lambda: feed._newcomers, DEADLINE_S)
        assert [*feed.ask()]
        connected.receive()
        assert (
            "a.y is not shown: the definition of message type no_msgs/msg/No"
            in (connected.statuses[0])
        )


def test_packets_are_as_far_apart_as_they_were(feed: Any) -> None:
    with app(feed.url) as connected:
        connected.subscribe("/a/x")
        wait_until(lambda: [*feed.ask()], DEADLINE_S)
        rows = [(7.0, b"first"), (7.5, b"second")]
        feed.handle(NodeStatus("a", 1, samples={"x": {"packets": rows}}))
        assert [connected.next("/a/x"), connected.next("/a/x")] == [b"first", b"second"]
        first_ns, second_ns = connected.times_ns[-2:]
        assert second_ns - first_ns == pytest.approx(500_000_000, abs=1000)


def test_requests_of_apps_go_to_the_supervisor(feed: Any) -> None:
    with app(feed.url) as connected:
        connected.call("/neuros/pause", {})
        connected.call("/neuros/step", {})
        assert [*feed.ask()] == [Pause(), Step(1)]


def test_every_shape_is_drawn_where_mujoco_has_it() -> None:
    model = mujoco.MjModel.from_xml_string("""
        <mujoco>
          <asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>
          <worldbody>
            <geom type="plane" size="0 0 1"/>
            <geom type="box" size="1 2 3"/> <geom type="sphere" size="1"/>
            <geom type="ellipsoid" size="1 2 3"/> <geom type="cylinder" size="1 2"/>
            <geom type="mesh" mesh="m"/>
            <geom type="capsule" size=".1 2" pos="1 2 3" euler="20 50 70"/>
          </worldbody>
        </mujoco>""")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    view = WorldView(lambda: (model, data, 0.0))
    geometry = json.loads(view.observe({"geometry": True}, 1)["geometry"])
    world = foxglove_feed._World("robot", geometry)
    kinds = [[kind for kind, _ in world._shapes(geom)] for geom in geometry["geoms"]]
    assert kinds == [
        *(["cubes"], ["cubes"], ["spheres"], ["spheres"], ["cylinders"], ["triangles"]),
        ["cylinders", "spheres", "spheres"],
    ]
    assert len(world.scene(0).encode()) > 500
    capsule = model.ngeom - 1
    end = data.geom_xpos[capsule] + 2 * data.geom_xmat[capsule].reshape(3, 3)[:, 2]
    assert np.allclose(foxglove_feed._along(geometry["geoms"][-1], 2), end)
    frame = view.observe({"frames": True}, 1)["frames"][0]
    assert base64.b64decode(frame[2]) == b""  # nothing moves here
    assert world.transforms(frame[2], 0).encode() == b""


def test_without_the_sdk_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web, "find_spec", lambda _: None)
    with pytest.raises(EnvironmentFault, match=r"its SDK is not installed: .*foxglove"):
        FOXGLOVE.prepare(BACK_ENDS.load("process"), None, None)


def test_an_observed_packet_is_read_as_ros_serialises_it() -> None:
    codec = message_codec(Float64)
    sampler = Sampler(codec.encode)
    sampler.ask({"x": {"packets": True}})
    for number in range(MOST_VALUES + 5):
        packet = Float64(data=float(number))
        sampler.sample("x", packet, partial(codec.encode, packet))
    rows = sampler.ask({})["x"]["packets"]
    assert [codec.decode(data).data for _, data in rows] == [*map(float, range(MOST_VALUES))]
