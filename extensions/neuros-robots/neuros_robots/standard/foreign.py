"""What a node exchanges with a simulator over ROS: requests, commands and sensor messages.

It has a ROS node of its own in a thread of its own, so that a hook can wait for an answer, and in
the simulator's domain, whichever that of the run is.
"""

from __future__ import annotations

import importlib
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

from neuros.errors import NodeError
from neuros.ports import Packet
from neuros.project.model import Node
from neuros_robots.standard.settings import Settings

PACKAGE = "simulation_interfaces"
_FIRST = "GetSimulatorFeatures"
_CALLED = (
    *("StepSimulation", "SetSimulationState", "ResetSimulation"),
    *("GetEntityState", "SetEntityState", _FIRST),
)
"""The services, in the order in which a simulator discovers the clients: the first call last."""
_LOOK_S = 0.1
_AGAIN_S = 2.0
_GONE_S = 2.0
_DEPTH = 1000


def interfaces() -> Any:
    """The message package of the standard, with ``msg`` and ``srv``.

    Raises:
        NodeError: if there is none.
    """
    try:
        for kind in ("msg", "srv", "action"):
            importlib.import_module(f"{PACKAGE}.{kind}")
    except ImportError as error:
        raise NodeError(
            f"there is no message package {PACKAGE} ({error}): source a ROS distribution that has"
            f" it (apt install ros-$ROS_DISTRO-{PACKAGE.replace('_', '-')}), or put the package"
            " into the folder 'workspace' beside the project file: docs/messages.md"
        ) from error
    return importlib.import_module(PACKAGE)


def name_of(code: int, *kinds: type) -> str:
    """The name of a result, as ``RESULT_INCORRECT_STATE``: a constant of one of these classes."""
    for kind in kinds:
        for name in dir(type(kind)):  # constants of ROS are properties of the metaclass
            if name.isupper() and getattr(kind, name) == code:
                return name
    return f"result {code}"


class Foreign:
    """The services and topics of a simulator.

    Args:
        node: the node, as a hook has it.

    Raises:
        NodeError: if there is no message package of the standard.
    """

    def __init__(self, node: Any, settings: Settings) -> None:
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node as RosNode

        self.types = interfaces()
        self._node: Node = node.description
        self._settings = settings
        self._log = node.get_logger()
        self._changed = threading.Condition()
        self._arrived: dict[str, deque[Packet]] = {}
        self._found: set[str] = set()
        self._publishers: dict[str, Any] = {}
        self._context = Context()
        self._context.init(domain_id=settings.domain)
        self._ros = RosNode(
            f"{node.name}_simulator",
            context=self._context,
            use_global_arguments=False,
            start_parameter_services=False,
        )
        self._clients = {
            kind: self._ros.create_client(
                getattr(self.types.srv, kind), settings.service(snake(kind))
            )
            for kind in _CALLED
        }
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._ros)
        self._thread = threading.Thread(
            target=self._executor.spin, name=f"{node.name}: ROS of the simulator", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """End the thread, and leave ROS."""
        self._executor.shutdown(0)
        self._thread.join(_GONE_S)
        self._ros.destroy_node()
        self._context.try_shutdown()

    # ---- services ---------------------------------------------------------------------------

    def call(self, kind: str, accepts: Iterable[str] = (), **fields: Any) -> Any:
        """Call a service, and wait for its answer.

        Args:
            kind: of ``simulation_interfaces/srv``, as ``StepSimulation``.
            accepts: names of results that are right, beside ``RESULT_OK``.
            fields: of the request.

        Raises:
            NodeError: if the service is not there, does not answer in time, goes away, is of
                another version, or answers with an error.
        """
        service_type = getattr(self.types.srv, kind)
        name, client = self._settings.service(snake(kind)), self._clients[kind]
        if kind not in self._found:
            self._find(client, name)
            self._found.add(kind)
        request = service_type.Request()
        for field, value in fields.items():
            setattr(request, field, value)
        answer = self._answer(client, name, request, repeats=kind == _FIRST)
        if answer is not None and hasattr(answer, "result"):
            result = answer.result
            code = name_of(result.result, type(result), service_type.Response)
            if code != "RESULT_OK" and code not in accepts:
                text = result.error_message or "it does not say why"
                raise NodeError(f"{name}: the simulator answers {code}: {text}")
        return answer

    def _answer(self, client: Any, name: str, request: Any, *, repeats: bool) -> Any:
        """Send a request, and wait for the answer.

        A client may find a service that has not found the client yet: then the answer is lost.
        ``repeats``: the request, which changes nothing, is sent again.
        """
        answers: list[Any] = []
        answered = threading.Event()

        def keep(future: Any) -> None:
            if not future.cancelled():
                answers.append(future.result())
            answered.set()

        futures = []
        now_s = time.monotonic()
        deadline_s, again_s, seen_s = now_s + self._settings.timeout_s, now_s, now_s
        while not answered.is_set():
            now_s = time.monotonic()
            if now_s >= again_s:
                futures.append(client.call_async(request))
                futures[-1].add_done_callback(keep)
                again_s = now_s + _AGAIN_S if repeats else math.inf
            if client.service_is_ready():
                seen_s = now_s
            if now_s > deadline_s:
                fault = (
                    f"has not answered within {self._settings.timeout_s:g} s ('timeout_s' in the"
                    " parameters)"
                )
            elif now_s > seen_s + _GONE_S:
                fault = "has gone away before it answered"
            else:
                answered.wait(_LOOK_S)
                continue
            raise NodeError(f"{name}: the simulator {fault}")
        for future in futures[:-1]:
            client.remove_pending_request(future)
        return answers[0]

    def _find(self, client: Any, name: str) -> None:
        """Wait for a service, and compare its version."""
        if not client.wait_for_service(self._settings.timeout_s):
            offered = [each for each, _ in self._ros.get_service_names_and_types()]
            last = name.rpartition("/")[2]
            others = [n for n in offered if n.rpartition("/")[2] == last and n != name]
            hint = (
                f"; there is {', '.join(others)}: 'simulator' in the parameters" if others else ""
            )
            raise NodeError(
                f"{name}: no simulator serves this in ROS domain {self._settings.domain} after"
                f" {self._settings.timeout_s:g} s: start it, or give 'domain' and 'simulator' in"
                f" the parameters{hint}"
            )
        # A request of another version would be decoded as something else, without an error.
        hashes = {
            str(info.topic_type_hash)
            for look in (
                self._ros.get_publishers_info_by_topic,
                self._ros.get_subscriptions_info_by_topic,
            )
            for info in look(f"rq{name}Request", no_mangle=True)
        }
        known = {each for each in hashes if not each.startswith("INVALID")}
        if len(known) > 1:
            raise NodeError(
                f"{name}: the simulator has another version of {PACKAGE} than this node: give both"
                f" the same ({', '.join(sorted(known))})"
            )

    # ---- topics -----------------------------------------------------------------------------

    def join_topics(self) -> None:
        """Subscribe to the topics of outputs, and offer those of inputs.

        Raises:
            NodeError: with all topics that the simulator does not have, or has with other types.
        """
        if self._arrived or self._publishers:  # the simulator is reset, and its topics stay
            return
        from rclpy.qos import QoSProfile, ReliabilityPolicy

        topics = self._settings.topics
        ports = [port for port in self._node.inputs if port.name in topics]
        for port in ports:
            publisher = self._ros.create_publisher(self._class(port.type), topics[port.name], 10)
            self._publishers[port.name] = publisher
        problems = [
            *self._wait_for(ports, self._ros.get_subscriptions_info_by_topic, "listens on"),
        ]
        sensors = [port for port in self._node.outputs if port.name in topics]
        problems += self._wait_for(sensors, self._ros.get_publishers_info_by_topic, "publishes on")
        if problems:
            raise NodeError("\n".join(problems))
        for port in sensors:
            topic = topics[port.name]
            offers = self._ros.get_publishers_info_by_topic(topic)
            policy = ReliabilityPolicy.RELIABLE
            if any(each.qos_profile.reliability != policy for each in offers):
                policy = ReliabilityPolicy.BEST_EFFORT
                self._log.warning(
                    f"output '{port.name}': the simulator offers best effort on {topic}: where a"
                    " message is lost, the run ends with an error"
                )
            queue = self._arrived[port.name] = deque()
            self._ros.create_subscription(
                self._class(port.type),
                topic,
                self._keeper(queue),
                QoSProfile(depth=_DEPTH, reliability=policy),
            )

    def forget(self) -> None:
        """Drop the sensor messages that have arrived."""
        with self._changed:
            for queue in self._arrived.values():
                queue.clear()

    def publish(self, name: str, packet: Packet) -> None:
        """Publish the packet of an input, and wait until the simulator has it.

        Raises:
            NodeError: if it has not, in time.
        """
        from rclpy.duration import Duration

        publisher = self._publishers[name]
        publisher.publish(packet)
        if not publisher.wait_for_all_acked(Duration(seconds=self._settings.timeout_s)):
            raise NodeError(
                f"input '{name}': the simulator has not received it on"
                f" {self._settings.topics[name]} within {self._settings.timeout_s:g} s"
            )

    def take(self, name: str, is_wanted: Callable[[Packet], bool], what: str) -> Packet:
        """The first message of an output's topic that is wanted; those before it are dropped.

        Raises:
            NodeError: if none comes in time.
        """
        queue, last = self._arrived[name], None
        deadline_s = time.monotonic() + self._settings.timeout_s
        with self._changed:
            while True:
                while queue:
                    last = queue.popleft()
                    if is_wanted(last):
                        return last
                left_s = deadline_s - time.monotonic()
                if left_s <= 0:
                    break
                self._changed.wait(left_s)
        before = "none at all" if last is None else "older ones only"
        raise NodeError(
            f"output '{name}': the simulator has not published {what} on"
            f" {self._settings.topics[name]} within {self._settings.timeout_s:g} s ({before}):"
            f" 'steps', 'step_s' and 'every' in the parameters say when one is due"
        )

    def _wait_for(self, ports: Iterable[Any], look: Callable[[str], Any], does: str) -> list[str]:
        """Wait until there is somebody on the topic of each port; returns the problems."""
        problems = []
        deadline_s = time.monotonic() + self._settings.timeout_s
        for port in ports:
            topic = self._settings.topics[port.name]
            while not (found := [i for i in look(topic) if i.node_name != self._ros.get_name()]):
                if time.monotonic() > deadline_s:
                    break
                time.sleep(_LOOK_S)
            types = {info.topic_type for info in found} - {port.type}
            if not found:
                problems.append(f"'{port.name}': no simulator {does} {topic}")
            elif types:
                problems.append(f"'{port.name}': {topic} is of {', '.join(types)}, not {port.type}")
        return problems

    def _keeper(self, queue: deque[Packet]) -> Callable[[Packet], None]:
        def keep(message: Packet) -> None:
            with self._changed:
                queue.append(message)
                self._changed.notify_all()

        return keep

    @staticmethod
    def _class(name: str) -> Any:
        package, kind, message = name.split("/")
        return getattr(importlib.import_module(f"{package}.{kind}"), message)


def snake(kind: str) -> str:
    """``step_simulation`` for ``StepSimulation``."""
    return "".join(f"_{c.lower()}" if c.isupper() else c for c in kind).lstrip("_")
