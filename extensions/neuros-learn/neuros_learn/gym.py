"""Environments of Gymnasium whose world is a project: ``neuros.gym.make("project.json", ...)``.

An environment steps a :class:`~neuros.api.session.Session`: an action is a packet for inputs that
the session takes over, an observation consists of the newest packets of outputs, and an episode
begins with a reset. Source of the interface: M. Towers et al., "Gymnasium: a standard interface for
reinforcement learning environments", 2024.
"""

from __future__ import annotations

import contextlib
import inspect
import json
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, SupportsFloat

import numpy as np

from neuros.api.project import Project
from neuros.api.session import Session, check_length
from neuros.distribution import install_command
from neuros.errors import EnvironmentFault, UsageError
from neuros.project.model import SEEDS, Port
from neuros.project.model import Project as Described
from neuros.project.suggest import did_you_mean
from neuros.project.timing import seeds
from neuros.visualise import image_pixels
from neuros_learn.numbers import Numbers, numbers_of, shape_of
from neuros_learn.policies.export import export

try:
    import gymnasium
    from gymnasium import logger, spaces
    from gymnasium.envs.registration import EnvSpec
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    raise EnvironmentFault(
        f"neuros.gym needs Gymnasium, which is not installed here: {install_command('rl')}"
    ) from error

_NAME = re.compile(r"(?P<port>\w+\.\w+)(?P<field>(\.\w+)*)(\[(?P<shape>\d+(, *\d+)*)\])?")
_MOST_ROUNDS = 100
"""Within this number of rounds after a reset each observed output must send."""
_SEEDS = 2**31
_NOTHING: Mapping[str, tuple[Any, Any]] = {}
_UNBOUNDED = (-np.inf, np.inf)
_ENTRY_POINT = "neuros.gym:ProjectEnv"
_IMAGE = "sensor_msgs/msg/Image"
_RENDER_MODE = "rgb_array"
_FPS = 30
"""Frames per second where neither the step nor a sensor tells it, as of ``RecordVideo``."""
_SEEN = ("observation", "previous_observation", "action", "session", "env")
"""What the parameters of a function of the user can name."""


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
            reward=lambda: 1.0,
            done=lambda observation: abs(observation["cart.joints.position"][1]) > 0.2,
            ranges={"policy.force": (-1.0, 1.0)},
            max_episode_steps=500,
        )

    ``env.spec`` makes further ones; it can be pickled if the functions among the arguments can.

    Args:
        max_episode_steps: the number of steps after which an episode is ``truncated``.

    Raises:
        UsageError: that number is not a whole one from 1 on; or as the class.
    """
    _check_steps(max_episode_steps)
    _check_names(arguments)
    loaded = project if isinstance(project, Project) else Project.from_file(project)
    name = re.sub(r"[^\w.-]", "_", loaded.name)
    spec = EnvSpec(f"neuros/{name}-v0", _ENTRY_POINT, order_enforce=False, disable_env_checker=True)
    return gymnasium.make(spec, max_episode_steps, project=loaded, **arguments)


def make_vec(project: str | os.PathLike[str] | Project, **arguments: Any) -> ProjectVectorEnv:
    """A vector environment of the copies of a project's nodes: one hook steps all of them.

    ::

        envs = neuros.gym.make_vec(
            "project.json",
            num_envs=16,
            action="cheetahs.torques",
            observation="cheetahs.joints",
            reset="cheetahs.reset",
            reward=lambda previous_observation, observation: observation[:, 9],
            max_episode_steps=1000,
        )

    Args:
        project, arguments: as of :class:`ProjectVectorEnv`.

    Raises:
        UsageError: as the class.
    """
    return ProjectVectorEnv(project, **arguments)


def register(
    env_id: str,
    project: str | os.PathLike[str] | Project,
    *,
    max_episode_steps: int | None = None,
    **arguments: Any,
) -> None:
    """Let ``gymnasium.make(env_id)`` and ``gymnasium.make_vec(env_id)`` make such environments.

    The project is read when an environment is made. Arguments of ``gymnasium.make`` replace those
    given here.

    Args:
        env_id: name and version, ``neuros/Cartpole-v0``.
        project, max_episode_steps, arguments: as of :func:`make`.

    Raises:
        UsageError: there is no argument of a name, or the number of steps is none.
        gymnasium.error.Error: the name is not one of Gymnasium.
    """
    _check_steps(max_episode_steps)
    _check_names(arguments)
    # An environment may be made from another folder, or in another process.
    found = project if isinstance(project, Project) else os.path.abspath(project)
    gymnasium.register(
        env_id,
        _ENTRY_POINT,
        max_episode_steps=max_episode_steps,
        kwargs={"project": found, **arguments},
    )


def export_policy(model: Any, file: str | os.PathLike[str], env: Any = None) -> dict[str, Any]:
    """Write a policy that was trained in an environment of a project, in ONNX.

    The file holds all between packets and packets: the normalisation of observations by
    ``VecNormalize``, the network without noise, and the limits of the action space. Source of the
    format: https://onnx.ai.

    Args:
        model: an algorithm of Stable-Baselines3, or a ``torch.nn.Module`` that maps observations,
            float32 ``(batch, n)``, to actions ``(batch, m)``; those of several names are joined in
            the order of the observation space.
        file: ``"walk.onnx"``.
        env: the environment; ``None``: that of the algorithm.

    Returns:
        The node that runs the policy, ready for a project file: ports, and parameters that say
        which numbers are observed.

    Raises:
        UsageError: the environment is none of a project, or one of its wrappers changes
            observations.
        EnvironmentFault: PyTorch is not installed.
    """
    if env is None and hasattr(model, "get_env") and model.get_env() is not None:
        env = model.get_env().get_attr("unwrapped")[0]
    world = getattr(env, "unwrapped", None)
    if not isinstance(world, _World):
        raise UsageError(
            "export_policy: give the environment of neuros.gym.make that the policy was trained in"
        )
    return export(model, file, world)


class _World:
    """A project that an environment steps: its session, and its actions and observations by name.

    Attributes:
        session: the run.
        described: the project.
        action_signals, observation_signals: the numbers of each name.
        action, observation: those of the last step.
    """

    session: Session
    action_signals: list[_Signal]
    observation_signals: list[_Signal]

    def _open(
        self,
        project: Project,
        described: Described,
        *,
        action: str | Sequence[str],
        observation: str | Sequence[str],
        functions: Mapping[str, Callable[..., Any]],
        ranges: Mapping[str, tuple[Any, Any]] | None,
        length: tuple[int | None, float | None],
        initial_action: Any,
        options: Mapping[str, Any],
        model: str | os.PathLike[str] | None = None,
        copies: int | None = None,
        also_taken: Sequence[str] = (),
    ) -> None:
        """Find all names, and begin the session.

        Args:
            project, described: the project.
            functions: those of the user, by their role.
            length: of a step, in rounds or simulated seconds.
            copies: of arrays whose first axis is that of copies, their number.
            also_taken: further inputs to take over.
        """
        self._functions = {name: _by_names(name, each) for name, each in functions.items()}
        self.described = described
        self._rounds, self._sim_s = length
        self._initial_action = initial_action
        self._has_seeds = bool(seeds(described.nodes))
        taken = [
            end for name in _listed(action) for end in _inputs_behind(described, _split(name)[0])
        ]

        def resolve() -> None:
            """Find the numbers of all actions and observations."""
            controls = {} if model is None else _controls(described, project.file.parent / model)
            given = ranges or {}
            self.action_signals = [
                _signal(described, name, given, controls, copies=copies) for name in _listed(action)
            ]
            self.observation_signals = [
                _signal(described, name, given, is_output=True, copies=copies)
                for name in _listed(observation)
            ]
            names = [each.name for each in (*self.action_signals, *self.observation_signals)]
            if unknown := given.keys() - {*names}:
                raise UsageError(f"ranges: '{min(unknown)}' is none of {', '.join(names)}")

        # Reports mistakes before a session starts; types that the project builds exist only later.
        with contextlib.suppress(EnvironmentFault):
            resolve()
        self.session = project.session(take_over=[*taken, *also_taken], **options)
        try:
            resolve()
        except BaseException:
            self.session.close()
            raise
        self._outputs = {each.port: self.session[each.port] for each in self.observation_signals}
        self._has_one_action = isinstance(action, str)
        self._has_one_observation = isinstance(observation, str)
        self.action: Any = None
        self.observation: Any = None

    def _begin(self, seed: int | None, changes: Mapping[str, Any]) -> None:
        """Reset the session with a seed and settings, and run until all outputs have sent."""
        self.session.reset(seed=seed, **changes)
        if self._initial_action is not None:
            self._send(self._initial_action)
        for _ in range(_MOST_ROUNDS):
            silent = [output for output in self._outputs.values() if not output.count]
            if not silent:
                self.action, self.observation = None, self._observe()
                return
            self.session.step()
        raise UsageError(
            f"{silent[0].name} has sent nothing in {_MOST_ROUNDS} rounds after a reset: if the"
            " project waits for a first command, give initial_action"
        )

    def _advance(self, action: Any) -> tuple[bool, dict[str, Any]]:
        """Send the action, step the project, and observe.

        Returns:
            Whether the project goes on, and what the user's functions are given.
        """
        self._send(action)
        goes_on = self.session.step(self._rounds, sim_s=self._sim_s)
        before, self.action, self.observation = self.observation, action, self._observe()
        return goes_on, self._seen(before)

    def _send(self, action: Any) -> None:
        for each in self.action_signals:
            message = each.message(action if self._has_one_action else action[each.name])
            for end in each.inputs:
                self.session.send(end, message)

    def _observe(self) -> Any:
        outputs = self._outputs
        if self._has_one_observation:
            each = self.observation_signals[0]
            return each.read(outputs[each.port].shared_packet)
        packets = {name: output.shared_packet for name, output in outputs.items()}
        return {each.name: each.read(packets[each.port]) for each in self.observation_signals}

    def _seen(self, before: Any) -> dict[str, Any]:
        """What the user's functions are given, by :data:`_SEEN`."""
        return {
            "observation": self.observation,
            "previous_observation": before,
            "action": self.action,
            "session": self.session,
            "env": self,
        }

    def _information(self, seen: Mapping[str, Any]) -> dict[str, Any]:
        sim_time, own = self.session.sim_time, self._functions["info"](seen)
        if own is not _NOTHING and not isinstance(own, Mapping):
            raise UsageError(f"info returned {own!r}, which is no mapping")
        return {**({} if sim_time is None else {"sim_time": sim_time}), **own}


class ProjectEnv(_World, gymnasium.Env[Any, Any]):
    """An environment whose world is a project.

    A name is ``node.port``, for its array, or all numbers of its message (without texts and time
    stamps); or ``node.port.field``. A shape in brackets is needed where the message does not fix
    the length.
    One name makes a ``Box``, a list a ``Dict`` of boxes, by the names without brackets.

    Args:
        project: its file, its folder, or a :class:`~neuros.api.project.Project`.
        action: an output, whose packets the environment sends in its place, or an input.
        observation: outputs.
        reward: a function, called after each step. It is given those of these values that its
            parameters name: ``observation``, ``previous_observation`` (before the step),
            ``action``, ``session``, and ``env``, this environment.
        done: likewise; returns whether the episode is over (``terminated``). The end of the
            project ends it, too.
        truncated: likewise; returns whether the episode is cut short.
        info: likewise; returns a mapping, which is added to the information of each step. It is
            called after a reset, too; there is neither an action nor an observation before, then.
        ranges: lowest and highest value by name: numbers, or arrays.
        model: MJCF file, relative to the project file, with the ranges of the actuators that an
            action drives; ``ranges`` come first.
        rounds, sim_s: length of a step, as for :meth:`Session.step`: one of them, or neither.
        initial_action: sent at each reset, for a project that waits for its first command.
        render_mode: ``"rgb_array"``, or ``None``: pictures are not asked for.
        render: the output that sends the pictures; it may be left out if only one sends images.
        options: of :meth:`~neuros.api.project.Project.session`.

    Attributes:
        session: the run.
        action, observation: those of the last step.

    Raises:
        UsageError: a name is that of no argument, port or field, the number of its values is not
            known, the length of a step is negative, a function takes what there is not, or it is
            not known which output sends the pictures.
        ProjectError, EnvironmentFault, RunError: as a session does.
    """

    # Of an environment without a camera, those of the instance are empty.
    metadata: dict[str, Any] = {"render_modes": [_RENDER_MODE]}  # noqa: RUF012, as in the class above

    def __init__(
        self,
        project: str | os.PathLike[str] | Project,
        *,
        action: str | Sequence[str],
        observation: str | Sequence[str],
        reward: Callable[..., SupportsFloat],
        done: Callable[..., bool] = lambda: False,
        truncated: Callable[..., bool] = lambda: False,
        info: Callable[..., Mapping[str, Any]] = lambda: _NOTHING,
        ranges: Mapping[str, tuple[Any, Any]] | None = None,
        model: str | os.PathLike[str] | None = None,
        rounds: int | None = None,
        sim_s: float | None = None,
        initial_action: Any = None,
        render_mode: str | None = None,
        render: str | None = None,
        backend: str = "local",
        **options: Any,
    ) -> None:
        _check_names(options)
        count = check_length(rounds, sim_s)
        loaded = project if isinstance(project, Project) else Project.from_file(project)
        described = loaded.described(is_held=True)
        self._camera = _camera(described, render_mode, render)
        self.render_mode = render_mode
        self.metadata = {"render_modes": []}
        if self._camera is not None:
            fps = _steps_per_s(described, count, sim_s)
            self.metadata = {"render_modes": [_RENDER_MODE], "render_fps": fps}
        self._open(
            loaded,
            described,
            action=action,
            observation=observation,
            functions={"reward": reward, "done": done, "truncated": truncated, "info": info},
            ranges=ranges,
            length=(rounds, sim_s),
            initial_action=initial_action,
            options={"backend": backend, **options},
            model=model,
        )
        self.action_space = _space(self.action_signals, is_one=self._has_one_action)
        self.observation_space = _space(self.observation_signals, is_one=self._has_one_observation)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode: reset the session with the next seed, and run until all outputs sent.

        Args:
            options: ``{"set": {...}}``: settings, as for :meth:`Session.reset`.

        Raises:
            UsageError: an observed output does not send, or there is another option.
        """
        changes = _changes(options)
        super().reset(seed=seed)
        episode = int(self.np_random.integers(_SEEDS)) if self._has_seeds else None
        self._begin(episode, changes)
        return self.observation, self._information(self._seen(None))

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Send the action, step the project, and observe. Raises ``RunError`` if it fails."""
        goes_on, seen = self._advance(action)
        is_over = not goes_on or bool(self._functions["done"](seen))
        reward = self._functions["reward"](seen)
        try:
            gained = float(reward)
        except (TypeError, ValueError):
            raise UsageError(f"reward returned {reward!r}, which is no number") from None
        is_cut = bool(self._functions["truncated"](seen))
        return self.observation, gained, is_over, is_cut, self._information(seen)

    def render(self) -> Any:
        """The newest picture of the camera, ``(height, width, 3)``, uint8, red first.

        A camera of MuJoCo that has sent nothing yet in the episode shows black.

        Raises:
            UsageError: another camera has sent nothing yet, or the encoding of the picture is not
                rgb8, bgr8 or mono8.
        """
        if self.render_mode is None or self._camera is None:
            logger.warn(f"render: make the environment with render_mode='{_RENDER_MODE}'")
            return None
        name, port = self._camera
        image = self.session[name].packet
        if image is None:
            return _black(name, port)
        try:
            pixels = image_pixels(image)
        except ValueError as error:
            raise UsageError(f"render: {name}: {error}") from error
        return np.array(pixels) if pixels.ndim == 3 else np.stack([pixels] * 3, axis=-1)

    def close(self) -> None:
        """End the run, drained."""
        self.session.close()


class ProjectVectorEnv(_World, gymnasium.vector.VectorEnv[Any, Any, Any]):
    """The copies of the nodes of a project, as environments that are stepped at once.

    The arguments are those of :class:`ProjectEnv`, without ``model`` and pictures. Values have a
    leading axis of ``num_envs``: actions, observations, and those that the functions are given and
    return. As in Gymnasium's own vectors, an environment whose episode is over begins the next one
    in the step after that: its action is ignored, and its reward is 0.

    Args:
        project: its file, its folder, or a :class:`~neuros.api.project.Project`.
        num_envs: the ``"copies"`` of all nodes that have this key; ``None``: those of the project.
        reset: an input ``bool[1]`` of a node with copies; each step sends to it which copies begin
            anew in the place of their step.
        action, observation: ports of nodes with copies.
        reward, done, truncated, info: functions; each returns an array with a value for each copy,
            or one for all, ``info`` a mapping of such.
        max_episode_steps: the number of steps after which an episode is ``truncated``.
        ranges, rounds, sim_s, initial_action, backend, options: as of :class:`ProjectEnv`.

    Attributes:
        session: the run.
        action, observation: those of the last step.

    Raises:
        UsageError: as :class:`ProjectEnv`; no node of the project has copies, or they differ.
        ProjectError, EnvironmentFault, RunError: as a session does.
    """

    _over: Any
    """Whose episode has ended with the last step."""
    _steps: Any
    """Steps of each episode."""

    def __init__(
        self,
        project: str | os.PathLike[str] | Project,
        *,
        num_envs: int | None = None,
        reset: str,
        action: str | Sequence[str],
        observation: str | Sequence[str],
        reward: Callable[..., Any],
        done: Callable[..., Any] = lambda: False,
        truncated: Callable[..., Any] = lambda: False,
        info: Callable[..., Mapping[str, Any]] = lambda: _NOTHING,
        max_episode_steps: int | None = None,
        ranges: Mapping[str, tuple[Any, Any]] | None = None,
        rounds: int | None = None,
        sim_s: float | None = None,
        initial_action: Any = None,
        backend: str = "local",
        **options: Any,
    ) -> None:
        _check_names(options, ProjectVectorEnv)
        _check_steps(max_episode_steps)
        check_length(rounds, sim_s)
        loaded, self._copied = _with_copies(project, num_envs)
        described = loaded.described(is_held=True)
        self.num_envs = described.node(self._copied[0]).copies or 1
        self._masked = _inputs_behind(described, reset)
        for type_ in {_port(described, name).type for name in self._masked}:
            if type_ != f"bool[{self.num_envs},1]":
                raise UsageError(
                    f"reset='{reset}': give an input with the type bool[1], of a node with copies,"
                    f" not {type_}"
                )
        self._open(
            loaded,
            described,
            action=action,
            observation=observation,
            functions={"reward": reward, "done": done, "truncated": truncated, "info": info},
            ranges=ranges,
            length=(rounds, sim_s),
            initial_action=initial_action,
            options={"backend": backend, **options},
            copies=self.num_envs,
            also_taken=self._masked,
        )
        self.metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}
        self.single_action_space = _space(self.action_signals, is_one=self._has_one_action)
        self.single_observation_space = _space(
            self.observation_signals, is_one=self._has_one_observation
        )
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._most_steps = max_episode_steps
        self._has_ended = False
        self._begin_all()

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in each environment.

        Args:
            seed: ``1``: environment i has the seed 1 + i, as in Gymnasium's own vectors; or one for
                each; ``None``: the next ones. A node has them as ``node.seeds``.
            options: ``{"set": {...}}``: settings, as for :meth:`Session.reset`.

        Raises:
            UsageError: an observed output does not send, there is another option, or another number
                of seeds.
        """
        changes = _changes(options)
        count = self.num_envs
        wanted: Sequence[int | None]
        if seed is None or isinstance(seed, int | np.integer):
            super().reset(seed=None if seed is None else int(seed))
            wanted = [None if seed is None else int(seed) + index for index in range(count)]
        else:
            wanted = list(seed)
            if len(wanted) != count:
                raise UsageError(f"reset: give {count} seeds, one for each copy, not {len(wanted)}")
            first = next((each for each in wanted if each is not None), None)
            super().reset(seed=first)
        drawn = self.np_random.integers(_SEEDS, size=count + 1).tolist()
        own = [new if each is None else int(each) for each, new in zip(wanted, drawn, strict=False)]
        variables = {f"nodes.{name}.environment.{SEEDS}": json.dumps(own) for name in self._copied}
        settings = {**variables, **changes.get("set", {})}
        self._begin(drawn[-1] if self._has_seeds else None, {"set": settings})
        self._begin_all()
        return self.observation, self._information(self._seen(None))

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all environments; those whose episode was over begin the next one.

        Raises ``RunError`` if the project fails.
        """
        if self._has_ended:
            observation, information = self.reset()
            zeros = np.zeros(self.num_envs)
            return observation, zeros, zeros > 0, zeros > 0, information
        anew = self._over
        for name in self._masked:
            self.session.send(name, anew[:, None])
        goes_on, seen = self._advance(actions)
        rewards = self._values("reward", seen, float)
        terminations = self._values("done", seen, bool)
        truncations = self._values("truncated", seen, bool)
        self._steps += 1
        if self._most_steps is not None:
            truncations |= self._steps >= self._most_steps
        if anew.any():
            self._steps[anew] = 0
            rewards[anew], terminations[anew], truncations[anew] = 0.0, False, False
        if not goes_on:
            self._has_ended = True
            terminations[:] = True
        self._over = terminations | truncations
        return self.observation, rewards, terminations, truncations, self._information(seen)

    def close_extras(self, **_: Any) -> None:
        """End the run, drained."""
        self.session.close()

    def _begin_all(self) -> None:
        self._has_ended = False
        self._over = np.zeros(self.num_envs, bool)
        self._steps = np.zeros(self.num_envs, np.int64)

    def _values(self, role: str, seen: Mapping[str, Any], kind: type) -> Any:
        """What a function of the user returns, as an array with a value for each copy."""
        return self._of_all(role, self._functions[role](seen), kind)

    def _of_all(self, role: str, given: Any, kind: type | None = None) -> Any:
        """A value for each copy, of one for all or an array with one for each."""
        try:
            found = np.array(given, kind)
        except (TypeError, ValueError):
            raise UsageError(f"{role} returned {given!r}, which are no numbers") from None
        if found.ndim == 0:
            return np.full(self.num_envs, found)
        if len(found) != self.num_envs or (kind is not None and found.ndim > 1):
            raise UsageError(
                f"{role} returned an array of the shape {found.shape}: give a value for each of the"
                f" {self.num_envs} copies"
            )
        return found

    def _information(self, seen: Mapping[str, Any]) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name, value in super()._information(seen).items():
            found[name] = self._of_all(f"info: '{name}'", value)
            found[f"_{name}"] = np.ones(self.num_envs, bool)
        return found


def _with_copies(
    project: str | os.PathLike[str] | Project, count: int | None
) -> tuple[Project, list[str]]:
    """The project with so many copies, and the names of its nodes with copies."""
    if count is not None and (isinstance(count, bool) or not isinstance(count, int) or count < 1):
        raise UsageError(f"num_envs={count!r}: give a whole number from 1 on")
    loaded = project if isinstance(project, Project) else Project.from_file(project)
    found = {
        node.name: node.copies
        for node in loaded.described(is_held=True).nodes
        if node.copies is not None
    }
    if not found:
        raise UsageError(
            f'{loaded.name}: make_vec needs a node with "copies", whose hooks serve all at once;'
            " gymnasium.vector.SyncVectorEnv puts environments of neuros.gym.make side by side"
        )
    if count is None and len({*found.values()}) > 1:
        shown = ", ".join(f"{name} {copies}" for name, copies in found.items())
        raise UsageError(f"{loaded.name}: its nodes have different copies ({shown}): give num_envs")
    if count is not None:
        loaded = loaded.with_settings({f"nodes.{name}.copies": count for name in found})
    return loaded, [*found]


def _signal(
    project: Described,
    written: str,
    ranges: Mapping[str, tuple[Any, Any]],
    controls: Mapping[str, tuple[Any, Any]] = _NOTHING,
    *,
    is_output: bool = False,
    copies: int | None = None,
) -> _Signal:
    """The numbers of a name; ``ranges`` are by name, ``controls`` by input."""
    name, field, shape = _split(written)
    port = _port(project, name, is_output=is_output)
    if copies is not None and (port.array is None or port.array.shape[0] != copies):
        raise UsageError(
            f"'{written}': a port of {copies} copies has arrays of all, with a leading axis,"
            f' not {port.type}: give its node the key "copies"'
        )
    numbers = numbers_of(port, name, field, shape, copies)
    inputs = [] if is_output else _inputs_behind(project, name)
    driven = controls.get(inputs[0]) if inputs and copies is None else None
    return _Signal(
        written, numbers, inputs, ranges.get(numbers.name, (0, 1) if numbers.is_bool else driven)
    )


class _Signal:
    """Numbers of a port, as an action or an observation.

    Attributes:
        written: the name as the user gave it.
        numbers: their place in packets; name, port: as there.
        inputs: of an action: the input, or those that the output feeds.
        space: of one copy.
    """

    def __init__(
        self,
        written: str,
        numbers: Numbers,
        inputs: Sequence[str],
        bounds: tuple[Any, Any] | None,
    ) -> None:
        self.written, self.numbers, self.inputs = written, numbers, inputs
        self.name, self.port = numbers.name, numbers.port
        self.read, self.message = numbers.read, numbers.message
        dtype = numbers.dtype
        if bounds is None:
            info = None if dtype.kind == "f" else np.iinfo(dtype)
            bounds = _UNBOUNDED if info is None else (info.min, info.max)
        try:
            low, high = (
                np.broadcast_to(np.asarray(bound, dtype), numbers.shape) for bound in bounds
            )
        except (ValueError, TypeError, OverflowError) as error:
            raise UsageError(f"range of {self.name}: {error}") from error
        if not np.all(low <= high):  # false for NaN, too
            raise UsageError(f"range of {self.name}: the lowest value must be at most the highest")
        self.space = spaces.Box(low, high, dtype=dtype.type)


def _check_steps(number: Any) -> None:
    """Gymnasium would complain when the session has started. Raises ``UsageError``."""
    if number is not None and (not isinstance(number, int) or number < 1):
        raise UsageError(f"max_episode_steps={number!r}: give a whole number from 1 on")


def _check_names(arguments: Iterable[str], of: type = ProjectEnv) -> None:
    """Refuse arguments that an environment does not have. Raises ``UsageError``."""
    own = {*inspect.signature(of).parameters} - {"project", "options"}
    # An environment takes the inputs of its actions over.
    known = own | {*inspect.signature(Project.session).parameters} - {"self", "take_over"}
    for name in arguments:
        if name not in known:
            hint = did_you_mean(name, known) or f"it has {', '.join(sorted(own))}"
            make = "make" if of is ProjectEnv else "make_vec"
            raise UsageError(f"neuros.gym.{make} has no argument '{name}' ({hint})")


def _by_names(role: str, function: Callable[..., Any]) -> Callable[[Mapping[str, Any]], Any]:
    """A function that is given those of the values of :data:`_SEEN` that its parameters name.

    Raises:
        UsageError: if a parameter names another, or the parameters are not known.
    """
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError) as error:
        raise UsageError(
            f"{role}: {function!r} is no function with known parameters; give a function of"
            f" {', '.join(_SEEN[:-1])}, or of some of them"
        ) from error
    names = []
    for each in parameters:
        if each.name in _SEEN and each.kind is not each.POSITIONAL_ONLY:
            names.append(each.name)
        elif each.default is each.empty and each.kind not in (
            each.VAR_POSITIONAL,
            each.VAR_KEYWORD,
        ):
            hint = did_you_mean(each.name, _SEEN) or f"there are {', '.join(_SEEN)}"
            raise UsageError(f"{role}: there is nothing for its parameter '{each.name}' ({hint})")
    if not names:
        return lambda seen: function()
    return lambda seen: function(**{name: seen[name] for name in names})


def _changes(options: Mapping[str, Any] | None) -> dict[str, Any]:
    """The arguments of :meth:`Session.reset` in the options of a reset; raises ``UsageError``."""
    for name in options or ():
        if name != "set":
            raise UsageError(
                f"reset: there is no option '{name}'; settings are"
                ' options={"set": {"nodes.NAME.environment.VARIABLE": value}}'
            )
    settings = (options or {}).get("set")
    if not isinstance(settings, Mapping | None):
        raise UsageError(f"reset: options: 'set' is a mapping of settings, not {settings!r}")
    return {} if settings is None else {"set": settings}


def _camera(
    project: Described, render_mode: str | None, render: str | None
) -> tuple[str, Port] | None:
    """The output that sends the pictures, and its name; ``None`` if none is needed, nor clear.

    Raises:
        UsageError: if it cannot be had.
    """
    if render_mode not in (None, _RENDER_MODE):
        raise UsageError(f"render_mode={render_mode!r}: there is '{_RENDER_MODE}', or None")
    if render is not None:
        port = _port(project, render, is_output=True)
        if port.type != _IMAGE:
            raise UsageError(f"render='{render}': the output sends {port.type}, not {_IMAGE}")
        return render, port
    cameras = [
        (f"{node.name}.{port.name}", port)
        for node in project.nodes
        for port in node.outputs
        if port.type == _IMAGE
    ]
    if len(cameras) == 1:
        return cameras[0]
    if render_mode is None:
        return None
    names = [name for name, _ in cameras]
    if not names:
        raise UsageError(f"render_mode='{render_mode}': no output of {project.name} sends {_IMAGE}")
    raise UsageError(
        f"render_mode='{render_mode}': {project.name} has the cameras {', '.join(names)}: choose"
        f" one, for example with render='{names[0]}'"
    )


def _steps_per_s(project: Described, rounds: int, sim_s: float | None) -> float:
    """Steps per simulated second: a frame of a video is a step. Sensors of MuJoCo pace rounds."""
    rates = [p.mujoco["rate"] for node in project.nodes for p in node.outputs if "rate" in p.mujoco]
    if sim_s:
        return 1 / sim_s
    return max(rates) / max(rounds, 1) if rates else _FPS


def _black(name: str, port: Port) -> Any:
    """The picture of a camera that has sent none: another size later would spoil a video."""
    if not port.mujoco:
        raise UsageError(
            f"render: {name} has sent no picture yet in this episode: let the hook that begins an"
            " episode send one"
        )
    from neuros.simulators.mujoco.sensor_base import PICTURE

    size = (port.mujoco.get(key, PICTURE[key].default) for key in ("height", "width"))
    return np.zeros((*size, 3), np.uint8)


def _listed(names: str | Sequence[str]) -> Sequence[str]:
    listed = [names] if isinstance(names, str) else names
    if not isinstance(listed, Sequence) or not all(isinstance(each, str) for each in listed):
        raise UsageError(f"action and observation are names, or lists of names, not {names!r}")
    return listed


def _space(signals: Sequence[_Signal], *, is_one: bool) -> spaces.Space[Any]:
    return signals[0].space if is_one else spaces.Dict({each.name: each.space for each in signals})


def _split(written: str) -> tuple[str, str, tuple[int, ...] | None]:
    """Port, field with its leading dot, and shape of ``node.port.field[2, 3]``."""
    match = _NAME.fullmatch(written)
    if match is None:
        raise UsageError(f"'{written}': say node.port, node.port.field or node.port.field[3]")
    return match["port"], match["field"], shape_of(match["shape"])


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
            if wanted == "all" or all(name in names for name in wanted):
                chosen = slice(None) if wanted == "all" else [names.index(each) for each in wanted]
                low, high = limits[chosen].T
                found[f"{node.name}.{port.name}"] = low, high
    return found
