"""A run for Foxglove: its WebSocket server, with what the app subscribes to and nothing else.

Packets keep their ROS serialisation and definition; the world is a scene and transforms, the
figures of the run are JSON. Times are those of the wall clock; simulated ones are in the stamps.
"""

from __future__ import annotations

import base64
import json
import re
import time
import zlib
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import foxglove
import numpy as np
from foxglove import channels, messages
from foxglove.websocket import Capability, ServerListener

from neuros.control import WORLD, GetStatus, Message, NodeStatus, Pause, PhaseChanged, Resume, Step
from neuros.errors import EnvironmentFault
from neuros_dashboard.live_metrics import LiveMetrics

WORLD_FRAME = "world"
_RUN_TOPIC, _SCENE_TOPIC, _LOG_TOPIC = "/neuros/run", "/neuros/world", "/neuros/log"
_MOST_STEPS = 1_000_000
_POSE = 7
_RECORD = re.compile(r"^\[([A-Z]+)\] (?:\[([\d.]+)\] )?\[([^\]]+)\]:? ?(.*)$", re.DOTALL)
_LEVELS = {
    "DEBUG": messages.LogLevel.Debug,
    "INFO": messages.LogLevel.Info,
    "WARN": messages.LogLevel.Warning,
    "ERROR": messages.LogLevel.Error,
    "FATAL": messages.LogLevel.Fatal,
}
_STEPS = {"count": {"type": "integer", "default": 1}}


class FoxgloveFeed(ServerListener):
    """Serves one run to any number of Foxglove apps.

    Args:
        nodes: of the run.
        sources: of the run, as :func:`neuros_dashboard.web.project_view` has them.

    Raises:
        RuntimeError: if the port is taken.
    """

    def __init__(
        self, project: str, host: str, port: int, nodes: Sequence[str], sources: Iterable[Any]
    ) -> None:
        self._nodes = nodes
        self._metrics = LiveMetrics()
        self._phase: dict[str, Any] = {"phase": "running", "is_paused": False}
        self._requests: deque[Message] = deque()  # of the threads of the server
        self._context = context = foxglove.Context()
        self._packets: dict[tuple[str, str], foxglove.Channel] = {}
        self._faults: list[str] = []
        for each in sources:
            try:
                schema = _ros_schema(each["ros_type"])
            except EnvironmentFault as fault:
                self._faults.append(f"{each['name']} is not shown: {fault}")
                continue
            self._packets[each["node"], each["port"]] = foxglove.Channel(
                each["topic"], schema=schema, message_encoding="cdr", context=context
            )
        self._run = foxglove.Channel(
            _RUN_TOPIC, schema=_json_schema("neuros.Run"), message_encoding="json", context=context
        )
        self._scene = channels.SceneUpdateChannel(_SCENE_TOPIC, context=context)
        self._transforms = channels.FrameTransformsChannel("/tf", context=context)
        self._log = channels.LogChannel(_LOG_TOPIC, context=context)
        self._worlds: dict[str, _World] = {}
        self._newcomers = self._told = 0  # subscriptions so far, and those that know the faults
        self._shown: dict[str, tuple[str, int]] = {}  # by node, version and newcomers
        self._server = foxglove.start_server(
            name=f"NeuROS: {project}",
            host=host,
            port=port,
            context=context,
            server_listener=self,
            capabilities=[Capability.Services],
            supported_encodings=["json"],
            services=[
                _service("/neuros/pause", {}, self._pause),
                _service("/neuros/resume", {}, self._resume),
                _service("/neuros/step", _STEPS, self._step),
            ],
        )

    @property
    def wants_log(self) -> bool:
        """Whether somebody looks at the log."""
        return self._log.has_sinks()

    def ask(self) -> Iterator[Message]:
        """What to send to the supervisor now: nothing while nobody looks."""
        if self._told != self._newcomers:
            self._told = self._newcomers
            for fault in self._faults:
                self._server.publish_status(fault, foxglove.StatusLevel.Warning, id=fault)
        while self._requests:
            yield self._requests.popleft()
        wanted: dict[str, dict[str, Any]] = {}
        for (node, port), channel in self._packets.items():
            if channel.has_sinks():
                wanted.setdefault(node, {})[port] = {"packets": True}
        has_scene = self._scene.has_sinks()
        if has_scene or self._transforms.has_sinks():
            for node in self._nodes:
                known = self._worlds.get(node)
                is_new = known is None or known.version != known.newest
                wanted.setdefault(node, {})[WORLD] = {"frames": True, "geometry": is_new}
        if wanted or self._run.has_sinks():
            yield GetStatus(wanted)

    def handle(self, message: Message) -> None:
        """Show what the supervisor sends."""
        match message:
            case PhaseChanged(phase, is_paused):
                self._phase = {"phase": phase, "is_paused": is_paused}
                self._show_run()
            case NodeStatus(node):
                self._metrics.update(message)
                for port, sample in message.samples.items():
                    if port == WORLD:
                        self._show_world(node, sample)
                    elif rows := sample.get("packets"):
                        now_ns, (last_s, _) = time.time_ns(), rows[-1]
                        for row_s, data in rows:
                            at_ns = now_ns - round(1e9 * (last_s - row_s))
                            self._packets[node, port].log(data, log_time=at_ns)
                if node == self._nodes[-1]:
                    self._show_run()

    def show_log(self, lines: Iterable[str]) -> None:
        """Show records of the logs, as the console has them."""
        for line in lines:
            record = _RECORD.match(line)
            severity, stamp_s, name, text = record.groups() if record else ("INFO", None, "", line)
            at_ns = time.time_ns() if stamp_s is None else round(1e9 * float(stamp_s))
            self._log.log(
                messages.Log(
                    timestamp=_timestamp(at_ns),
                    level=_LEVELS.get(severity, messages.LogLevel.Unknown),
                    name=name,
                    message=text,
                ),
                log_time=at_ns,
            )

    def close(self) -> None:
        """End the server, and the connections of all apps."""
        self._server.stop()

    # ------------------------------------------------------------------ threads of the server

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Somebody new looks, who needs what comes once only."""
        self._newcomers += 1

    def _pause(self, _request: Any) -> bytes:
        self._requests.append(Pause())
        return b"{}"

    def _resume(self, _request: Any) -> bytes:
        self._requests.append(Resume())
        return b"{}"

    def _step(self, request: Any) -> bytes:
        asked = json.loads(request.payload or b"{}")
        count = asked.get("count", 1) if isinstance(asked, dict) else None
        if type(count) is not int or not 1 <= count <= _MOST_STEPS:
            raise ValueError(f'give {{"count": N}} with N from 1 to {_MOST_STEPS}')
        self._requests.append(Step(count))
        return b"{}"

    # ------------------------------------------------------------------ what is shown

    def _show_run(self) -> None:
        if self._run.has_sinks():
            metrics = self._metrics
            self._run.log(
                {
                    **self._phase,
                    "sim_time_s": metrics.sim_time,
                    "real_time_factor": metrics.real_time_factor,
                    "nodes": metrics.nodes,
                    "connections": metrics.connections,
                }
            )

    def _show_world(self, node: str, sample: Mapping[str, Any]) -> None:
        if "geometry" in sample:
            self._worlds[node] = _World(node, json.loads(sample["geometry"]))
        world = self._worlds.get(node)
        if world is None:
            return
        world.newest = sample.get("version", world.newest)
        now_ns, state = time.time_ns(), (world.version, self._newcomers)
        if self._scene.has_sinks() and self._shown.get(node) != state:
            self._shown[node] = state
            self._scene.log(world.scene(now_ns), log_time=now_ns)
            self._transforms.log(world.rest(now_ns), log_time=now_ns)
        frames = sample.get("frames", ())
        for frame in frames:
            at_ns = now_ns - round(1e9 * (frames[-1][0] - frame[0]))
            self._transforms.log(world.transforms(frame[2], at_ns), log_time=at_ns)


class _World:
    """The simulated world of a node, as Foxglove draws it: an entity and a frame per body.

    Attributes:
        version: of the geometry.
        newest: the version that the node has now.
    """

    def __init__(self, node: str, geometry: Mapping[str, Any]) -> None:
        self._node, self._geometry = node, geometry
        self.version = self.newest = str(geometry["version"])
        self._frames = [
            f"{node}/{body['name'] or number}" for number, body in enumerate(geometry["bodies"])
        ]

    def scene(self, at_ns: int) -> messages.SceneUpdate:
        """All bodies, in place of those before."""
        entities = []
        for body, frame in enumerate(self._frames):
            shapes: Any = {}  # by list of an entity
            for geom in self._geometry["geoms"]:
                if geom["body"] == body:
                    for kind, shape in self._shapes(geom):
                        shapes.setdefault(kind, []).append(shape)
            if shapes:
                entities.append(
                    messages.SceneEntity(
                        timestamp=_timestamp(at_ns),
                        frame_id=frame,
                        id=frame,
                        frame_locked=True,
                        **shapes,
                    )
                )
        return messages.SceneUpdate(entities=entities)

    def rest(self, at_ns: int) -> messages.FrameTransforms:
        """The frames of all bodies at the start; those that do not move stay there."""
        rows = [[*body["pos"], *body["quat"]] for body in self._geometry["bodies"]]
        return self._transforms(range(len(rows)), rows, at_ns)

    def transforms(self, poses: str, at_ns: int) -> messages.FrameTransforms:
        rows = np.frombuffer(base64.b64decode(poses), "<f4").reshape(-1, _POSE)
        return self._transforms(self._geometry["moving"], rows.tolist(), at_ns)

    def _transforms(
        self, bodies: Sequence[int], rows: Sequence[Sequence[float]], at_ns: int
    ) -> messages.FrameTransforms:
        # Behind the bodies, rows of cameras follow.
        return messages.FrameTransforms(
            transforms=[
                messages.FrameTransform(
                    timestamp=_timestamp(at_ns),
                    parent_frame_id=WORLD_FRAME,
                    child_frame_id=self._frames[body],
                    translation=messages.Vector3(x=x, y=y, z=z),
                    rotation=messages.Quaternion(w=qw, x=qx, y=qy, z=qz),
                )
                for body, (x, y, z, qw, qx, qy, qz) in zip(bodies, rows, strict=False)
            ]
        )

    def _shapes(self, geom: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
        """Primitives of a geom, by the list of an entity that they belong to."""
        a, b, c = geom["size"]
        paint: dict[str, Any] = {
            "pose": _pose(geom["pos"], geom["quat"]),
            "color": self._colour(geom),
        }
        match geom["shape"]:
            case "box":
                yield "cubes", messages.CubePrimitive(**paint, size=_vector(2 * a, 2 * b, 2 * c))
            case "plane":
                far = 10 * self._geometry["view"]["extent"]
                size = _vector(2 * (a or far), 2 * (b or far), 1e-4 * far)
                yield "cubes", messages.CubePrimitive(**paint, size=size)
            case "sphere":
                yield "spheres", messages.SpherePrimitive(**paint, size=_vector(*[2 * a] * 3))
            case "ellipsoid":
                yield (
                    "spheres",
                    messages.SpherePrimitive(**paint, size=_vector(2 * a, 2 * b, 2 * c)),
                )
            case "cylinder" | "capsule" as shape:
                yield (
                    "cylinders",
                    messages.CylinderPrimitive(
                        **paint, size=_vector(2 * a, 2 * a, 2 * b), bottom_scale=1.0, top_scale=1.0
                    ),
                )
                for way in (b, -b) if shape == "capsule" else ():
                    end = _pose(_along(geom, way), geom["quat"])
                    yield (
                        "spheres",
                        messages.SpherePrimitive(
                            pose=end, color=paint["color"], size=_vector(*[2 * a] * 3)
                        ),
                    )
            case "mesh":
                mesh = self._geometry["meshes"][geom["mesh"]]
                points = _unpacked(mesh["position"], "<f4").reshape(-1, 3).tolist()
                yield (
                    "triangles",
                    messages.TriangleListPrimitive(
                        **paint,
                        points=[messages.Point3(x=x, y=y, z=z) for x, y, z in points],
                        indices=_unpacked(mesh["index"], "<u4").tolist(),
                    ),
                )

    def _colour(self, geom: Mapping[str, Any]) -> messages.Color:
        red, green, blue, alpha = geom["rgba"]
        if "texture" in geom:
            mean = self._geometry["textures"][geom["texture"]]["mean"]
            red, green, blue = (
                each * share for each, share in zip(geom["rgba"], mean, strict=False)
            )
        return messages.Color(r=red, g=green, b=blue, a=alpha)


def _along(geom: Mapping[str, Any], way: float) -> list[float]:
    """The point so far along the z axis of a geom."""
    w, x, y, z = geom["quat"]
    axis = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
    return [at + way * part for at, part in zip(geom["pos"], axis, strict=True)]


def _pose(pos: Sequence[float], quat: Sequence[float]) -> messages.Pose:
    w, x, y, z = quat
    return messages.Pose(
        position=_vector(*pos), orientation=messages.Quaternion(w=w, x=x, y=y, z=z)
    )


def _vector(x: float, y: float, z: float) -> messages.Vector3:
    return messages.Vector3(x=x, y=y, z=z)


def _unpacked(text: str, kind: str) -> Any:
    return np.frombuffer(zlib.decompress(base64.b64decode(text)), kind)


def _timestamp(at_ns: int) -> messages.Timestamp:
    return messages.Timestamp(sec=at_ns // 10**9, nsec=at_ns % 10**9)


def _service(name: str, request: Mapping[str, Any], handler: Any) -> foxglove.Service:
    def schema(kind: str, properties: Mapping[str, Any]) -> foxglove.MessageSchema:
        return foxglove.MessageSchema(
            encoding="json", schema=_json_schema(f"{name}/{kind}", properties)
        )

    return foxglove.Service(
        name,
        schema=foxglove.ServiceSchema(
            name=name.lstrip("/"),
            request=schema("request", request),
            response=schema("response", {}),
        ),
        handler=handler,
    )


def _json_schema(name: str, properties: Mapping[str, Any] | None = None) -> foxglove.Schema:
    content = {"type": "object", "properties": properties or {}}
    return foxglove.Schema(name=name, encoding="jsonschema", data=json.dumps(content).encode())


def _ros_schema(type_name: str) -> foxglove.Schema:
    """The definition of a message type, as in bags. Raises ``EnvironmentFault``."""
    from rosbags.typesys import Stores, get_typestore

    from neuros.recording.bag_writer import define

    store = get_typestore(Stores.EMPTY)
    define(type_name, store)
    text, _ = store.generate_msgdef(type_name, ros_version=2)
    return foxglove.Schema(name=type_name, encoding="ros2msg", data=text.encode())
