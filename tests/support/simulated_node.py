"""A node for the simulator's tests: real messages, and a submit that the test holds in its hand."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from neuros.errors import ModelError
from neuros.ports import Advance, WorldLook
from neuros.project.model import Node, Port
from neuros.transport.messages import make_packet

DEADLINE_S = 10.0

WORLD = """
<mujoco model="test">
  <option timestep="0.001"/>
  <worldbody>
    <light pos="0 0 4"/>
    <geom name="floor" type="plane" size="5 5 .1" rgba="0.8 0.2 0.2 1"/>
    <camera name="eye" pos="0 -3 1" xyaxes="1 0 0 0 0 1"/>
    <body name="box" pos="2 0 0.1">
      <freejoint name="box_free"/>
      <geom name="box_geom" type="box" size=".1 .1 .1" mass="2"/>
      <site name="box_imu" pos="0 0 0.05"/>
    </body>
    <body name="falling" pos="-2 0 100">
      <freejoint/>
      <geom size=".1" mass="1"/>
      <site name="fall_imu" euler="20 30 40"/>
    </body>
    <body name="turntable" pos="0 2 1">
      <joint name="turn" axis="0 0 1"/>
      <geom name="turntable_geom" type="cylinder" size=".2 .05" mass="1"/>
      <site name="turn_imu" pos="0.5 0 0" euler="90 0 0"/>
      <site name="axis_imu"/>
      <body name="arm" pos="0.3 0 0.2">
        <joint name="lift" axis="0 1 0" damping="1" armature="0.01"/>
        <geom type="capsule" size=".02" fromto="0 0 0 .3 0 0" mass="0.2"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <velocity name="turn_speed" joint="turn" kv="100"/>
    <position name="lift_angle" joint="lift" kp="20"/>
    <motor name="lift_torque" joint="lift"/>
  </actuator>
</mujoco>
"""


class Log:
    """Keeps what is logged."""

    def __init__(self) -> None:
        self.warnings: list[str] = []

    def debug(self, message: str) -> None: ...
    def info(self, message: str) -> None: ...
    def error(self, message: str) -> None: ...
    def warning(self, message: str) -> None:
        self.warnings.append(message)


class SimulatedNode:
    """What a simulator sees of its node. ``blocked`` holds submissions back.

    Attributes:
        is_active: whether every node is ready; before that, time 0 of the run is still to come.
    """

    def __init__(
        self,
        outputs: Mapping[str, tuple[str, dict[str, Any]]] | None = None,
        inputs: Mapping[str, tuple[str, dict[str, Any]]] | None = None,
        folder: Path = Path("/nowhere"),
        environment: Mapping[str, str] | None = None,
        copies: int | None = None,
    ) -> None:
        self.description = Node(
            name="robot",
            container="neuros_mujoco",
            plugin=folder / "robot.py",
            inputs=_ports(inputs or {}),
            outputs=_ports(outputs or {}),
            environment=dict(environment or {}),
            file=folder / "robot.json",
            copies=copies,
        )
        self.copies = copies or 1
        self.seeds = [*range(self.copies)]
        self.name = "robot"
        self.run_dir = folder
        self.log = Log()
        self.sent: list[dict[str, Any]] = []
        self.changed = threading.Condition()
        self.is_active = True
        self.is_blocked = False
        self.is_waiting = False
        self.closers: list[Callable[[], None]] = []
        self.changes: list[Any] = []
        self.failures: list[BaseException] = []
        self.read_time_s: Callable[[], float] = lambda: -1.0
        self.ends_at_s = float("inf")
        self.look_at_world: WorldLook | None = None
        self.is_driving = self.is_ending = False
        self.advance: Advance | None = None

    def make_packet(self, output: str) -> Any:
        return make_packet(self.description.output(output).type)

    def get_logger(self) -> Log:
        return self.log

    def resolve_path(self, path: str) -> Path:
        found = self.description.file.parent / path
        if not found.exists():
            raise ModelError(f"'{path}' does not exist: looked for {found}")
        return found

    def own_simulated_time(self, read_s: Callable[[], float]) -> None:
        self.read_time_s = read_s

    def note_simulated_time(self) -> bool:
        return self.read_time_s() < self.ends_at_s

    def reading(self, value: int) -> int:
        return value

    def drive(self, advance: Advance) -> bool:
        if self.is_driving:
            self.advance = advance
        return self.is_driving

    def show_world(self, look: WorldLook) -> None:
        self.look_at_world = look

    def on_close(self, callback: Callable[[], None]) -> None:
        self.closers.append(callback)

    def on_change(
        self,
        callback: Callable[[], object],
        check: Callable[[Mapping[str, str]], object] = lambda _: None,
    ) -> None:
        self.changes.append((callback, check))

    def fail(self, error: BaseException) -> None:
        with self.changed:
            self.failures.append(error)
            self.changed.notify_all()

    virtual_time = None

    def wait_until_active(self, cancelled: Callable[[], bool]) -> bool:
        with self.changed:
            self.is_waiting = not self.is_active
            self.changed.notify_all()
            while not self.is_active and not cancelled():
                self.changed.wait(0.01)
            self.is_waiting = False
            return self.is_active

    def submit(self, packets: Mapping[str, Any], cancelled: Callable[[], bool]) -> bool:
        with self.changed:
            self.is_waiting = self.is_blocked
            self.changed.notify_all()
            while self.is_blocked and not cancelled():
                self.changed.wait(0.01)
            self.is_waiting = False
            if cancelled():
                return False
            self.sent.append(dict(packets))
            self.changed.notify_all()
            return True

    def block(self, is_blocked: bool) -> None:
        with self.changed:
            self.is_blocked = is_blocked
            self.changed.notify_all()

    def wait_until(self, condition: Callable[[], bool]) -> None:
        """Wait for something that submissions or failures bring about."""
        with self.changed:
            assert self.changed.wait_for(condition, DEADLINE_S), "deadline passed"

    def close(self) -> None:
        for callback in self.closers:
            callback()


def stamp_ns(packet: Any) -> int:
    """The stamp of a message with a header, or of a clock."""
    stamp = packet.header.stamp if hasattr(packet, "header") else packet.clock
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def imu(element: str, rate: float = 50) -> tuple[str, dict[str, Any]]:
    return "sensor_msgs/msg/Imu", {"sensor": "imu", "element": element, "rate": rate}


def _ports(ports: Mapping[str, tuple[str, dict[str, Any]]]) -> tuple[Port, ...]:
    return tuple(Port(name, type_, mujoco=keys) for name, (type_, keys) in ports.items())
