"""A simulator in lockstep: commands in, some steps, and what it senses out, in each start."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from neuros.errors import NodeError
from neuros.ports import Packet
from neuros.project.model import CLOCK_TYPE, Port
from neuros.time import set_stamp, to_nanoseconds
from neuros_robots.standard.settings import STATE_PARTS, Settings

_NEEDED = "the simulator does not support what the node needs (GetSimulatorFeatures): "


class Simulator(Protocol):
    """The services and topics of a simulator: :class:`~neuros_robots.standard.foreign.Foreign`."""

    types: Any

    def call(self, kind: str, accepts: tuple[str, ...] = (), **fields: Any) -> Any: ...
    def join_topics(self) -> None: ...
    def forget(self) -> None: ...
    def publish(self, name: str, packet: Packet) -> None: ...
    def take(self, name: str, is_wanted: Any, what: str) -> Packet: ...


class Lockstep:
    """Steps a simulator for a node.

    Args:
        node: the node, as a hook has it.
        foreign: its services and topics.

    Attributes:
        time_s: simulated seconds since the reset of the simulator.
    """

    def __init__(self, node: Any, settings: Settings, foreign: Simulator) -> None:
        self._node, self._settings, self._foreign = node, settings, foreign
        self._description = node.description
        self._starts = 0
        self._origin_ns = 0
        self._step_ns = settings.step_s * 1e9
        self._is_multiple = True

    @property
    def time_s(self) -> float:
        return self._time_ns / 1e9

    @property
    def _time_ns(self) -> int:
        return self._origin_ns + round(self._starts * self._settings.steps * self._step_ns)

    def begin(self) -> None:
        """Pause the simulator, and reset it unless the node does not want that.

        Raises:
            NodeError: if it is not there, or does not support what the node needs.
        """
        call, kinds = self._foreign.call, self._foreign.types
        features = set(call("GetSimulatorFeatures").features.features)
        self._check_features(features, kinds.msg.SimulatorFeatures)
        self._foreign.join_topics()  # its discovery goes on during the calls that follow
        state = kinds.msg.SimulationState
        # A simulator that cannot be paused is expected to be paused from its start.
        if kinds.msg.SimulatorFeatures.SIMULATION_STATE_PAUSE in features:
            paused = state(state=state.STATE_PAUSED)
            call("SetSimulationState", ("ALREADY_IN_TARGET_STATE",), state=paused)
        if self._settings.reset:
            call("ResetSimulation")
        self._foreign.forget()
        self._starts = self._origin_ns = 0
        if not self._settings.reset:
            entity = next(iter(self._settings.entities.values()), None)
            if entity is None:
                raise NodeError(
                    "without a reset, the simulator's time is that of an entity's state: name one"
                    " in 'entities', or leave out 'reset'"
                )
            self._origin_ns = to_nanoseconds(call("GetEntityState", entity=entity).state)

    def step(self, packets: Mapping[str, Packet]) -> list[Packet]:
        """Pass on the packets of inputs, step, and return a packet, or ``None``, of each output.

        Raises:
            NodeError: if the simulator does not do its part.
        """
        settings, call = self._settings, self._foreign.call
        if virtual := self._node.virtual_time:
            virtual.will_step_to(self.time_s + settings.steps * settings.step_s)
        for name, packet in packets.items():
            if packet is None:
                continue
            if name in settings.topics:
                self._foreign.publish(name, packet)
            else:
                self._set_state(name, packet)
        if self._is_multiple:
            call("StepSimulation", steps=settings.steps)
        else:
            for _ in range(settings.steps):
                call("StepSimulation", steps=1)
        self._starts += 1
        states = {}
        for entity in dict.fromkeys(
            settings.entities[port.name]
            for port in self._description.outputs
            if port.name in settings.entities
        ):
            states[entity] = self._state_of(entity)
        return [self._output(port, states) for port in self._description.outputs]

    def _check_features(self, features: set[int], kind: Any) -> None:
        settings = self._settings
        inputs = [port.name for port in self._description.inputs]
        self._is_multiple = kind.STEP_SIMULATION_MULTIPLE in features and settings.steps > 1
        wanted = {
            "STEP_SIMULATION_SINGLE": not self._is_multiple,
            "SIMULATION_RESET": settings.reset,
            "ENTITY_STATE_GETTING": any(name not in inputs for name in settings.entities),
            "ENTITY_STATE_SETTING": any(name in inputs for name in settings.entities),
        }
        missing = [n for n, needed in wanted.items() if needed and getattr(kind, n) not in features]
        if missing:
            hint = ' ("reset": false does without)' if "SIMULATION_RESET" in missing else ""
            raise NodeError(f"{_NEEDED}{', '.join(missing)}{hint}")

    def _set_state(self, name: str, packet: Packet) -> None:
        kinds = self._foreign.types
        parts = STATE_PARTS[self._description.input(name).type]
        entity, state = self._settings.entities[name], kinds.msg.EntityState()
        state.header.frame_id = packet.header.frame_id
        fields: dict[str, Any] = {"entity": entity, "state": state}
        if hasattr(kinds.srv.SetEntityState.Request(), "set_pose"):  # since 2.1
            fields |= {f"set_{part}": True for part in parts}
        elif parts != STATE_PARTS["simulation_interfaces/msg/EntityState"]:
            # Before 2.1 a request sets everything: what the packet lacks stays as it is.
            state = fields["state"] = self._state_of(entity)
        for part in parts:
            setattr(state, part, getattr(packet, part))
        self._foreign.call("SetEntityState", **fields)

    def _state_of(self, entity: str) -> Any:
        state = self._foreign.call("GetEntityState", entity=entity).state
        found_ns = to_nanoseconds(state)
        if found_ns == 0:  # the simulator does not say
            set_stamp(state.header.stamp, self._time_ns)
        elif abs(found_ns - self._time_ns) > self._step_ns / 2:
            raise NodeError(
                f"entity '{entity}': the simulator's time is {found_ns / 1e9:g} s, and"
                f" {self.time_s:g} s is expected: 'step_s' in the parameters is its time step, and"
                " nobody else may step it"
            )
        return state

    def _output(self, port: Port, states: Mapping[str, Any]) -> Packet | None:
        settings, name = self._settings, port.name
        if name in settings.topics:
            if self._starts % settings.every.get(name, 1):
                return None
            return self._foreign.take(
                name,
                lambda message: self._is_of_now(name, message),
                f"a message of {self.time_s:g} s",
            )
        packet = self._node.make_packet(name)
        if port.type == CLOCK_TYPE:
            set_stamp(packet.clock, self._time_ns)
        else:
            state = states[settings.entities[name]]
            packet.header = state.header
            for part in STATE_PARTS[port.type]:
                setattr(packet, part, getattr(state, part))
        return packet

    def _is_of_now(self, name: str, message: Packet) -> bool:
        """Whether a message has the present time; one without a stamp always has."""
        if not (hasattr(message, "header") or hasattr(message, "clock")):
            return True
        ahead_ns = to_nanoseconds(message) - self._time_ns
        # Before the first step there may be messages on the way from before the reset.
        if ahead_ns > self._step_ns / 2 and self._starts > 1:
            raise NodeError(
                f"output '{name}': {self._settings.topics[name]} brings a message of"
                f" {to_nanoseconds(message) / 1e9:g} s, and it is {self.time_s:g} s: 'step_s' in"
                " the parameters is the simulator's time step, and nobody else may step it"
            )
        return abs(ahead_ns) <= self._step_ns / 2
