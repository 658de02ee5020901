"""Connects the ports of a node with the inputs and outputs of its policy.

The parameters ``observation`` and ``action`` name numbers of ports as :mod:`~neuros_learn.numbers`
has them; those of a list are joined. What else a policy takes is a state, which is an output of the
call before.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np

from neuros.errors import EnvironmentFault, NodeError, UsageError
from neuros.project.model import CLOCK_TYPE, Node, Port
from neuros.project.suggest import did_you_mean, listed
from neuros_learn.numbers import Numbers, numbers_of, shape_of
from neuros_learn.policies.model import Model, PolicyError, Tensor, zeros

PARAMETERS = ("observation", "action", "state", "newest", "task")
# ROS itself declares these parameters.
_OF_ROS = ("use_sim_time", "start_type_description_service")
_NAME = re.compile(r"(?P<port>\w+)(?P<field>(\.\w+)*)(\[(?P<shape>\d+(, *\d+)*)\])?")
_COLOURS_FIRST = (2, 0, 1)


@dataclass(frozen=True)
class Mistake:
    """A mistake in the file of a node; ``pointer`` leads from the node to its place."""

    pointer: str
    text: str
    hint: str = ""

    def __str__(self) -> str:
        return f"{self.pointer}: {self.text}" + (f" ({self.hint})" if self.hint else "")


@dataclass(frozen=True)
class _Part:
    """Numbers of a port; ``axes`` is their order in the policy, if that is another."""

    port: str
    numbers: Numbers
    axes: tuple[int, ...] = ()


def texts_of(value: Any) -> tuple[str, ...]:
    """The texts in the value of a parameter, which may be a single one."""
    values = value if isinstance(value, tuple) else (value,)
    return tuple(each for each in values if isinstance(each, str))


def newest_of(node: Node) -> tuple[str, ...]:
    """The inputs of which the policy uses the newest packet, without waiting for another one."""
    return texts_of(node.parameters.get("newest", ()))


def observed_ports(node: Node) -> list[Port]:
    """The inputs of the node but its clocks."""
    return [port for port in node.inputs if port.type != CLOCK_TYPE]


def mistakes_in_keys(node: Node) -> list[Mistake]:
    """The mistakes in ports and parameters that need no policy to be seen."""
    found = []
    for name in dict.fromkeys(each.partition(".")[0] for each in node.parameters):
        if name not in (*PARAMETERS, *_OF_ROS):
            hint = did_you_mean(name, PARAMETERS) or f"it has {listed(PARAMETERS)}"
            found.append(
                Mistake(f"/parameters/{name}", f"a policy has no parameter '{name}'", hint)
            )
    inputs = [port.name for port in observed_ports(node)]
    for name in newest_of(node):
        if name not in inputs:
            hint = did_you_mean(name, inputs) or f"it has {listed(inputs)}"
            found.append(Mistake("/parameters/newest", f"the node has no input '{name}'", hint))
    if inputs and {*inputs} <= {*newest_of(node)}:
        text, hint = "the policy would never wait for an observation", "leave one input out"
        found.append(Mistake("/parameters/newest", text, hint))
    for side, ports in (("inputs", inputs), ("outputs", node.outputs)):
        if not ports:
            found.append(Mistake("", f"a node with a policy needs {side}"))
    return found


class PortMapping:
    """The observations, actions and states of a policy in the ports of a node.

    Attributes:
        mistakes: all of them; with any, the mapping is of no use.
    """

    def __init__(self, node: Node, model: Model) -> None:
        self._node, self._model, self._copies = node, model, node.copies
        self.mistakes: list[Mistake] = mistakes_in_keys(node)
        self._open: set[str] = set()  # their numbers are not all known
        self._inputs = self._side("observation", observed_ports(node), model.inputs)
        self._outputs = self._side("action", node.outputs, model.outputs)
        self._states = self._pairs()
        if not self.mistakes:
            self._try()

    def reset(self) -> None:
        """Begin with states of zeros."""
        self._model.reset()
        size = self._copies or 1
        self._held = {name: zeros(self._model.inputs[name], size) for name in self._states}

    def act(self, packets: Mapping[str, Any], make_packet: Any) -> list[Any]:
        """The packets of all outputs for those of the inputs.

        Raises:
            PolicyError: a packet has another number of values, or an action is no finite number.
        """
        try:
            values = {name: self._joined(name, packets) for name in self._inputs}
            found = self._model.run({**values, **self._held})
            self._held = {name: found[source] for name, source in self._states.items()}
            made = {port.name: make_packet(port.name) for port in self._node.outputs}
            for name, parts in self._outputs.items():
                given, start = np.asarray(found[name]), 0
                if given.dtype.kind == "f" and not np.isfinite(given).all():
                    raise PolicyError(f"the policy gave {given.ravel().tolist()} as '{name}'")
                flat = given.reshape(self._copies or 1, -1)
                for part in parts:
                    end = start + prod(part.numbers.shape)
                    made[part.port] = part.numbers.put(flat[:, start:end], made[part.port])
                    start = end
        except (UsageError, ValueError) as error:
            raise PolicyError(str(error)) from None
        return [*made.values()]

    def _joined(self, name: str, packets: Mapping[str, Any]) -> Any:
        """The observations of one input of the policy, in its type and shape."""
        tensor, size, found = self._model.inputs[name], self._copies or 1, []
        for part in self._inputs[name]:
            values = part.numbers.read(packets[part.port]).reshape(size, *part.numbers.shape)
            if part.axes:
                values = values.transpose(0, *(axis + 1 for axis in part.axes))
            found.append(values.reshape(size, -1))
        flat = found[0] if len(found) == 1 else np.concatenate(found, axis=1)
        shape = [size if each is None else each for each in tensor.shape]
        return np.ascontiguousarray(flat.reshape(shape), tensor.dtype)

    # ------------------------------------------------------------------ what belongs where

    def _side(
        self, key: str, ports: Sequence[Port], tensors: Mapping[str, Tensor]
    ) -> dict[str, list[_Part]]:
        """The numbers of each input or output of the policy that ``key`` or a default names."""
        pointer, what = f"/parameters/{key}", "input" if key == "observation" else "output"
        by_name = {port.name: port for port in ports}
        first = next(iter(tensors), "")
        given = {
            name.removeprefix(key).removeprefix("."): (f"{pointer}/{name[len(key) + 1 :]}", value)
            for name, value in self._node.parameters.items()
            if name == key or name.startswith(f"{key}.")
        }
        if not given and by_name and by_name.keys() <= tensors.keys():
            given = {name: (f"/{what}s", name) for name in by_name}
        elif not given:
            given = {"": (f"/{what}s", tuple(by_name))}
        found: dict[str, list[_Part]] = {}
        for name, (place, value) in given.items():
            place = place.removesuffix("/")
            if (name or first) not in tensors:
                hint = did_you_mean(name, tensors) or f"it has {listed([*tensors])}"
                self._say(place, f"the policy has no {what} '{name}'", hint)
                continue
            tensor = tensors[name or first]
            parts = [self._part(place, text, by_name, what) for text in texts_of(value)]
            whole = found[tensor.name] = [part for part in parts if part is not None]
            if len(whole) < len(parts):
                self._open.add(tensor.name)
            elif what == "input":
                found[tensor.name] = self._fitting(place, tensor, whole)
            elif not tensor.is_numeric:
                self._say(place, f"the policy gives {tensor}, which holds no numbers")
        named = {name for _, v in given.values() for t in texts_of(v) if (name := t.split(".")[0])}
        named = {name.partition("[")[0] for name in named}
        for name in by_name.keys() - named:
            text = f"the policy does not use the {what} '{name}'"
            self._say(f"/{what}s", text, f"name it in '{key}', or remove it")
        return found

    def _part(self, place: str, written: str, ports: Mapping[str, Port], what: str) -> _Part | None:
        match = _NAME.fullmatch(written)
        if match is None:
            self._say(place, f"'{written}': say port, port.field or port.field[3]")
            return None
        name = match["port"]
        if name not in ports:
            hint = did_you_mean(name, ports) or f"it has {listed([*ports])}"
            self._say(place, f"'{written}': the node has no {what} '{name}'", hint)
            return None
        try:
            numbers = numbers_of(
                ports[name], name, match["field"], shape_of(match["shape"]), self._copies
            )
        except EnvironmentFault:  # a type that the project builds later: the node looks again
            return None
        except UsageError as error:
            self._say(place, str(error))
            return None
        return _Part(name, numbers)

    def _fitting(self, place: str, tensor: Tensor, parts: list[_Part]) -> list[_Part]:
        """Check that numbers fit an input of the policy; returns them in its order of axes."""
        if not tensor.is_numeric:
            self._say(place, f"the policy takes {tensor}, which holds no numbers")
            return parts
        size = self._copies or 1
        sizes = [size if n == 0 and each is None else each for n, each in enumerate(tensor.shape)]
        wanted = tuple(each for each in sizes if each is not None)
        if self._copies is not None and tensor.shape[:1] not in ((None,), (self._copies,)):
            text = f"the policy takes {tensor}, without an axis for {self._copies} copies"
            self._say(place, text, "export it with a first axis of any size")
            return parts
        if len(wanted) < len(sizes):
            text = f"the policy takes {tensor}: only its first axis, the batch, may have any size"
            self._say(place, text, "export it with fixed sizes")
            return parts
        for part in parts:
            kind = np.dtype("bool") if part.numbers.is_bool else part.numbers.dtype
            if not np.can_cast(kind, tensor.dtype, "same_kind"):
                text = f"'{part.numbers.name}' has {kind}, and the policy takes {tensor}"
                self._say(place, text)
        count = sum(prod(part.numbers.shape) for part in parts)
        if count * size != prod(wanted):
            names, takes = _names(parts), prod(wanted) // size
            text = f"{names}: {count} numbers, and the policy takes {takes} ({tensor})"
            self._say(place, text)
            return parts
        if len(parts) != 1 or len(parts[0].numbers.shape) < 2:
            return parts
        shape = parts[0].numbers.shape
        rest = wanted[1:] if len(wanted) > len(shape) else wanted
        if rest == shape:
            return parts
        axes = _COLOURS_FIRST if len(shape) == 3 else ()
        if not axes or rest != tuple(shape[axis] for axis in axes):
            text = f"'{parts[0].numbers.name}' has the shape {shape}, and the policy takes {tensor}"
            self._say(place, text)
        return [_Part(parts[0].port, parts[0].numbers, axes)]

    def _pairs(self) -> dict[str, str]:
        """By input of the policy that nothing feeds, the output that is its next value."""
        inputs, outputs = self._model.inputs, self._model.outputs
        given = {
            name.partition(".")[2]: texts_of(value)[0]
            for name, value in self._node.parameters.items()
            if name.startswith("state.") and texts_of(value)
        }
        left = [name for name in outputs if name not in self._outputs]
        found: dict[str, str] = {}
        for name, tensor in inputs.items():
            if name in self._inputs:
                continue
            same = [each for each in left if _may_follow(tensor, outputs[each])]
            source = given.pop(name, same[0] if same else "")
            if source in left:
                left.remove(source)
                found[name] = source
                if not _may_follow(tensor, outputs[source]):
                    text = f"the state {tensor} cannot be the output {outputs[source]}"
                    self._say("/parameters/state", text)
                if self._copies is not None:
                    self._say("/policy", f"it has a state, {tensor}, and its node has copies")
            elif source:
                text = f"the policy has no output '{source}' that is free for the state '{name}'"
                self._say("/parameters/state", text, f"free are {listed(left) or 'none'}")
            else:
                text = f"nothing feeds the input {tensor} of the policy"
                hint = "name what it observes in 'observation', or, of a state, the output in"
                self._say("/policy", text, f"{hint} 'state'")
        for name in given:
            text, known = f"the policy has no state '{name}'", [*inputs]
            self._say("/parameters/state", text, did_you_mean(name, known) or "")
        return found

    def _try(self) -> None:
        """Compute the policy once with zeros, and compare what it gives."""
        self.reset()
        tensors = self._model.inputs
        try:
            found = self._model.run(
                {name: zeros(tensors[name], self._copies or 1) for name in tensors}
            )
        except NodeError as error:
            self._say("/policy", str(error))
            return
        for name, parts in self._outputs.items():
            if name in self._open:
                continue
            count, size = sum(prod(p.numbers.shape) for p in parts), self._copies or 1
            given = np.asarray(found[name])
            if given.size != count * size or (size > 1 and given.shape[0] != size):
                gives = f"{given.size // size} as '{name}', {list(given.shape)}"
                text = f"{_names(parts)}: {count} numbers, and the policy gives {gives}"
                self._say("/parameters/action", text)
        self.reset()

    def _say(self, pointer: str, text: str, hint: str = "") -> None:
        self.mistakes.append(Mistake(pointer, text, hint))


def _names(parts: Sequence[_Part]) -> str:
    return ", ".join(f"'{part.numbers.name}'" for part in parts)


def _may_follow(state: Tensor, output: Tensor) -> bool:
    """Whether an output can be the next value of a state."""
    sizes = zip(state.shape, output.shape, strict=False)
    return (
        state.is_numeric
        and state.dtype == output.dtype
        and len(state.shape) == len(output.shape)
        and all(a == b or None in (a, b) for a, b in sizes)
    )
