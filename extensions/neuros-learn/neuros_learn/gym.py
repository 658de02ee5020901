"""Environments of Gymnasium whose world is a project: ``neuros.gym.make("project.json", ...)``.

An environment steps a :class:`~neuros.api.session.Session`: an action is a packet for inputs that
the session takes over, an observation consists of the newest packets of outputs, and an episode
begins with a reset. Source of the interface: M. Towers et al., "Gymnasium: a standard interface for
reinforcement learning environments", 2024.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from math import prod
from pathlib import Path
from typing import Any, SupportsFloat

import numpy as np

from neuros.api.project import Project
from neuros.api.session import check_length
from neuros.distribution import install_command
from neuros.errors import EnvironmentFault, UsageError
from neuros.project.model import Port
from neuros.project.model import Project as Described
from neuros.project.suggest import did_you_mean
from neuros.recording.provenance import seeds
from neuros.transport.messages import message_class
from neuros.transport.schema import NUMBERS, Leaf, Shape, Sort, getter, schema

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.wrappers import TimeLimit
except ModuleNotFoundError as error:
    raise EnvironmentFault(
        f"neuros.gym needs Gymnasium, which is not installed here: {install_command('rl')}"
    ) from error

_NAME = re.compile(r"(?P<port>\w+\.\w+)(?P<field>(\.\w+)*)(\[(?P<shape>\d+(, *\d+)*)\])?")
_STAMPS = ("Time", "Duration")
_MOST_ROUNDS = 100
"""Within this number of rounds after a reset each observed output must send."""
_SEEDS = 2**31
_NOTHING: Mapping[str, tuple[Any, Any]] = {}
_UNBOUNDED = (-np.inf, np.inf)


def make(
    project: str | os.PathLike[str] | Project,
    *,
    max_episode_steps: int | None = None,
    **arguments: Any,
) -> gymnasium.Env[Any, Any]:
    """An environment whose world is a project; the arguments are those of :class:`ProjectEnv`.

    ::

        env = neuros.gym.make(
            "project.json",
            action="policy.force",
            observation=["cart.joints.position[2]", "cart.joints.velocity[2]"],
            reward=lambda env: 1.0,
            done=lambda env: abs(env.observation["cart.joints.position"][1]) > 0.2,
            ranges={"policy.force": (-1.0, 1.0)},
            max_episode_steps=500,
        )

    Args:
        max_episode_steps: the number of steps after which an episode is ``truncated``.
    """
    env = ProjectEnv(project, **arguments)
    return env if max_episode_steps is None else TimeLimit(env, max_episode_steps)


class ProjectEnv(gymnasium.Env[Any, Any]):
    """An environment whose world is a project.

    A name is ``node.port``, for all numbers of its message (without texts and time stamps), or
    ``node.port.field``; a shape in brackets is needed where the message does not fix the length.
    One name makes a ``Box``, a list a ``Dict`` of boxes, by the names without brackets.

    Args:
        project: its file, its folder, or a :class:`~neuros.api.project.Project`.
        action: an output, whose packets the environment sends in its place, or an input.
        observation: outputs.
        reward: called after each step with the environment.
        done: likewise; returns whether the episode is over (``terminated``). The end of the
            project ends it, too.
        ranges: lowest and highest value by name: numbers, or arrays.
        model: MJCF file, relative to the project file, with the ranges of the actuators that an
            action drives; ``ranges`` come first.
        rounds, sim_s: length of a step, as for :meth:`Session.step`.
        initial_action: sent at each reset, for a project that waits for its first command.
        options: of :meth:`~neuros.api.project.Project.session`.

    Attributes:
        session: the run.
        action, observation: those of the last step.

    Raises:
        UsageError: a name is that of no port or field, the number of its values is not known, or
            the length of a step is negative.
        ProjectError, EnvironmentFault, RunError: as a session does.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012, as in the class above

    def __init__(
        self,
        project: str | os.PathLike[str] | Project,
        *,
        action: str | Sequence[str],
        observation: str | Sequence[str],
        reward: Callable[[ProjectEnv], SupportsFloat],
        done: Callable[[ProjectEnv], bool] = lambda _: False,
        ranges: Mapping[str, tuple[Any, Any]] | None = None,
        model: str | os.PathLike[str] | None = None,
        rounds: int = 1,
        sim_s: float | None = None,
        initial_action: Any = None,
        backend: str = "in-process",
        **options: Any,
    ) -> None:
        check_length(rounds, sim_s)
        loaded = project if isinstance(project, Project) else Project.from_file(project)
        described = loaded.check_with({}, is_held=True)
        self._reward, self._done = reward, done
        self._rounds, self._sim_s, self._initial_action = rounds, sim_s, initial_action
        self._has_seeds = bool(seeds(described.nodes))
        taken = [
            end for name in _listed(action) for end in _inputs_behind(described, _split(name)[0])
        ]
        # Reports mistakes before a session starts; types that the project builds exist only later.
        with contextlib.suppress(EnvironmentFault):
            self._resolve_names(loaded, described, action, observation, ranges or {}, model)
        self.session = loaded.session(backend=backend, take_over=taken, **options)
        try:
            self._resolve_names(loaded, described, action, observation, ranges or {}, model)
        except BaseException:
            self.session.close()
            raise
        self._outputs = {each.port: self.session[each.port] for each in self._observations}
        self._has_one_action = isinstance(action, str)
        self._has_one_observation = isinstance(observation, str)
        self.action_space = _space(self._actions, is_one=self._has_one_action)
        self.observation_space = _space(self._observations, is_one=self._has_one_observation)
        self.action: Any = None
        self.observation: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode: reset the session with the next seed, and run until all outputs sent.

        Raises:
            UsageError: an observed output does not send.
        """
        super().reset(seed=seed)
        episode = int(self.np_random.integers(_SEEDS)) if self._has_seeds else None
        self.session.reset(seed=episode)
        if self._initial_action is not None:
            self._send(self._initial_action)
        for _ in range(_MOST_ROUNDS):
            silent = [output for output in self._outputs.values() if not output.count]
            if not silent:
                self.action, self.observation = None, self._observe()
                return self.observation, self._info()
            self.session.step()
        raise UsageError(
            f"{silent[0].name} has sent nothing in {_MOST_ROUNDS} rounds after a reset: if the"
            " project waits for a first command, give initial_action"
        )

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Send the action, step the project, and observe. Raises ``RunError`` if it fails."""
        self._send(action)
        goes_on = self.session.step(self._rounds, sim_s=self._sim_s)
        self.action, self.observation = action, self._observe()
        is_over = not goes_on or bool(self._done(self))
        return self.observation, float(self._reward(self)), is_over, False, self._info()

    def close(self) -> None:
        """End the run, drained."""
        self.session.close()

    # ------------------------------------------------------------------ inside

    def _resolve_names(
        self,
        project: Project,
        described: Described,
        action: str | Sequence[str],
        observation: str | Sequence[str],
        ranges: Mapping[str, tuple[Any, Any]],
        model: str | os.PathLike[str] | None,
    ) -> None:
        """Find the numbers of all actions and observations. Raises as the class."""
        controls = {} if model is None else _controls(described, project.file.parent / model)
        self._actions = [_Numbers(described, name, ranges, controls) for name in _listed(action)]
        self._observations = [
            _Numbers(described, name, ranges, is_output=True) for name in _listed(observation)
        ]
        names = [each.name for each in (*self._actions, *self._observations)]
        if unknown := ranges.keys() - {*names}:
            raise UsageError(f"ranges: '{min(unknown)}' is none of {', '.join(names)}")

    def _send(self, action: Any) -> None:
        for each in self._actions:
            message = each.message(action if self._has_one_action else action[each.name])
            for end in each.inputs:
                self.session.send(end, message)

    def _observe(self) -> Any:
        packets = {name: output.packet for name, output in self._outputs.items()}
        found = {each.name: each.read(packets[each.port]) for each in self._observations}
        return next(iter(found.values())) if self._has_one_observation else found

    def _info(self) -> dict[str, Any]:
        sim_time = self.session.sim_time
        return {} if sim_time is None else {"sim_time": sim_time}


class _Numbers:
    """Numbers of the messages of a port, as one array.

    Attributes:
        name: the user's name without brackets.
        port: ``node.port``.
        inputs: of an action: the input, or those that the output feeds.
    """

    def __init__(
        self,
        project: Described,
        written: str,
        ranges: Mapping[str, tuple[Any, Any]],
        controls: Mapping[str, tuple[Any, Any]] = _NOTHING,
        *,
        is_output: bool = False,
    ) -> None:
        self.port, field, shape = _split(written)
        self.name = self.port + field
        port = _port(project, self.port, is_output=is_output)
        self.inputs = [] if is_output else _inputs_behind(project, self.port)
        self._kind = message_class(port.type)
        leaves = _numbers_of(self._kind, field)
        if not leaves:
            known = ", ".join(f"{self.port}.{_path(leaf)}" for leaf in _numbers_of(self._kind, ""))
            raise UsageError(f"'{written}': there are no numbers of that name; there are {known}")
        # The size of a sequence without a bound is None.
        sizes = [1 if leaf.field.shape is Shape.SINGLE else leaf.field.size for leaf in leaves]
        free = [_path(leaf) for leaf, size in zip(leaves, sizes, strict=True) if size is None]
        if len(free) > 1 or (free and shape is None):
            raise UsageError(
                f"'{written}': the length of {self.port}.{free[0]} is not known: name that alone,"
                f" with its shape: '{self.port}.{free[0]}[3]'"
            )
        fixed = sum(size or 0 for size in sizes)
        count = fixed if shape is None else prod(shape)
        self._sizes = [count - fixed if size is None else size for size in sizes]
        if sum(self._sizes) != count or min(self._sizes) < 0:
            raise UsageError(f"'{written}': its messages have {fixed} numbers, not {count}")
        self._leaves, self._shape = leaves, (count,) if shape is None else shape
        self._get = getter([leaf.path for leaf in leaves])
        self._is_flat = all(leaf.field.shape is Shape.SINGLE for leaf in leaves)
        is_bool = all(leaf.field.type.sort is Sort.BOOL for leaf in leaves)
        self._dtype = np.dtype(np.uint8) if is_bool else np.result_type(*map(_dtype, leaves))
        driven = controls.get(self.inputs[0]) if self.inputs else None
        self.space = self._space(ranges.get(self.name, (0, 1) if is_bool else driven))

    def _space(self, bounds: tuple[Any, Any] | None) -> spaces.Box:
        if bounds is None:
            is_float = self._dtype.kind == "f"
            info = None if is_float else np.iinfo(self._dtype)
            bounds = _UNBOUNDED if info is None else (info.min, info.max)
        try:
            low, high = (
                np.broadcast_to(np.asarray(bound, self._dtype), self._shape) for bound in bounds
            )
        except (ValueError, TypeError, OverflowError) as error:
            raise UsageError(f"range of {self.name}: {error}") from error
        if not np.all(low <= high):  # false for NaN, too
            raise UsageError(f"range of {self.name}: the lowest value must be at most the highest")
        return spaces.Box(low, high, dtype=self._dtype.type)

    def read(self, message: Any) -> Any:
        """The numbers of a message; raises ``UsageError`` if their number is another one."""
        values = self._get(message)
        if self._is_flat:
            return np.array(values, self._dtype).reshape(self._shape)
        parts = [np.array(value, self._dtype).reshape(-1) for value in values]
        for leaf, part, size in zip(self._leaves, parts, self._sizes, strict=True):
            if part.size != size:
                raise UsageError(
                    f"{self.port}.{_path(leaf)} holds {part.size} numbers, not {size}: say so in"
                    " brackets"
                )
        return (parts[0] if len(parts) == 1 else np.concatenate(parts)).reshape(self._shape)

    def message(self, values: Any) -> Any:
        """A message with these numbers."""
        flat, message, start = np.asarray(values).reshape(-1), self._kind(), 0
        if flat.size != sum(self._sizes):
            raise UsageError(f"{self.name} takes {sum(self._sizes)} numbers, not {flat.size}")
        for leaf, size in zip(self._leaves, self._sizes, strict=True):
            numbers = _CONVERT[leaf.field.type.sort](flat[start : start + size])
            owner = reduce(getattr, leaf.path[:-1], message)
            is_one = leaf.field.shape is Shape.SINGLE
            setattr(owner, leaf.path[-1][1:], numbers[0] if is_one else numbers)
            start += size
        return message


_CONVERT: Mapping[Sort, Callable[[Any], list[Any]]] = {
    Sort.BOOL: lambda numbers: numbers.astype(bool).tolist(),
    Sort.INTEGER: lambda numbers: [round(number) for number in numbers.tolist()],
    Sort.FLOAT: lambda numbers: numbers.astype(float).tolist(),
}
"""Converters from an array of numbers to values of a field."""


def _listed(names: str | Sequence[str]) -> Sequence[str]:
    listed = [names] if isinstance(names, str) else names
    if not isinstance(listed, Sequence) or not all(isinstance(each, str) for each in listed):
        raise UsageError(f"action and observation are names, or lists of names, not {names!r}")
    return listed


def _space(numbers: Sequence[_Numbers], *, is_one: bool) -> spaces.Space[Any]:
    return numbers[0].space if is_one else spaces.Dict({each.name: each.space for each in numbers})


def _split(written: str) -> tuple[str, str, tuple[int, ...] | None]:
    """Port, field with its leading dot, and shape of ``node.port.field[2, 3]``."""
    match = _NAME.fullmatch(written)
    if match is None:
        raise UsageError(f"'{written}': say node.port, node.port.field or node.port.field[3]")
    shape = tuple(map(int, match["shape"].split(","))) if match["shape"] else None
    return match["port"], match["field"], shape


def _port(project: Described, name: str, *, is_output: bool = False) -> Port:
    """The output, or unless ``is_output`` also input, of a name; raises ``UsageError``."""
    ports = {
        f"{node.name}.{port.name}": port
        for node in project.nodes
        for port in (*(() if is_output else node.inputs), *node.outputs)
    }
    if name not in ports:
        hint = did_you_mean(name, ports) or f"it has {', '.join(ports)}"
        side = "output" if is_output else "output or input"
        raise UsageError(f"'{name}': {project.name} has no such {side} ({hint})")
    return ports[name]


def _inputs_behind(project: Described, name: str) -> list[str]:
    """The input of a name, or the inputs of an output's connections; raises ``UsageError``."""
    _port(project, name)
    ends = [
        f"{c.destination_node}.{c.destination_input}"
        for c in project.connections
        if f"{c.source_node}.{c.source_output}" == name
    ]
    is_input = any(name == f"{n.name}.{port.name}" for n in project.nodes for port in n.inputs)
    if not ends and not is_input:
        raise UsageError(f"action '{name}': the output is connected to no input")
    return ends or [name]


def _controls(project: Described, model: Path) -> dict[str, tuple[Any, Any]]:
    """The lowest and highest controls of each input that drives actuators of a model."""
    import mujoco

    try:
        known = mujoco.MjModel.from_xml_path(str(model))
    except ValueError as error:
        raise UsageError(f"model {model}: {error}") from error
    names = [known.actuator(index).name for index in range(known.nu)]
    limits = np.where(known.actuator_ctrllimited[:, None], known.actuator_ctrlrange, _UNBOUNDED)
    found: dict[str, tuple[Any, Any]] = {}
    for node in project.nodes:
        for port in node.inputs:
            wanted = port.mujoco.get("actuators", [port.mujoco.get("actuator")])
            if all(name in names for name in wanted):
                low, high = limits[[names.index(name) for name in wanted]].T
                found[f"{node.name}.{port.name}"] = low, high
    return found


def _numbers_of(kind: type, field: str) -> list[Leaf]:
    """The numeric fields; those of time stamps only if they are named."""
    known, path = schema(kind), tuple(f"_{part}" for part in field.split(".")[1:])
    return [
        leaf
        for leaf in known.leaves
        if leaf.path[: len(path)] == path
        and leaf.field.type.sort in (*NUMBERS, Sort.BOOL)
        and (path or known.kinds[leaf.owner].__name__ not in _STAMPS)
    ]


def _path(leaf: Leaf) -> str:
    return ".".join(slot[1:] for slot in leaf.path)


def _dtype(leaf: Leaf) -> np.dtype[Any]:
    return np.dtype(leaf.field.type.code)
