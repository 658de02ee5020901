"""An observer asks, and shows what it gets, until the run is over."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path

from neuros_dashboard.visual_types import Mark, Numbers, VisualTypes, observe

from neuros.backends.control_sockets import UnixListener, connect
from neuros.control import TO_OBSERVERS, GetStatus, NodeStatus, PhaseChanged, Watch
from neuros.control.link import ControlLink
from neuros.launcher.channels import Channels


def test_what_nodes_sample_is_shown_under_its_name(tmp_path: Path) -> None:
    listener = UnixListener(tmp_path)
    channels = Channels(listener)
    link = ControlLink(connect(listener.address), TO_OBSERVERS, "the supervisor")
    shown: list[tuple[str, Sequence[Mark]]] = []
    sources = {"robot.imu": ("robot", "imu", VisualTypes("sensor_msgs/msg/Imu"))}
    observer = threading.Thread(
        target=observe, args=(link, sources, lambda name, _, marks: shown.append((name, marks)))
    )
    observer.start()
    asked = []
    while not shown:
        channels.wait(5.0)
        for lines, message in channels.receive():
            asked.append(type(message))
            if isinstance(message, GetStatus):
                fields = message.wanted["robot"]["imu"]["fields"]
                sample = {"fields": fields, "values": [[1e9, *([0.5] * len(fields))]]}
                channels.send_to(lines, PhaseChanged("running", False))
                channels.send_to(lines, NodeStatus("robot", 1, samples={"imu": sample}))
    channels.close()
    observer.join(5.0)
    assert not observer.is_alive()
    assert asked[:2] == [Watch, GetStatus]
    name, (_, numbers) = shown[0]
    assert name == "robot.imu"
    assert isinstance(numbers, Numbers)
    assert numbers.values["linear_acceleration.x"] == 0.5
