"""Compiled model, from MJCF, URDF or SDF, its state, and the sensors and commands bound to it."""

from __future__ import annotations

import contextlib
import copy
import json
import os
import re
from collections.abc import Callable, Iterable, Mapping, MutableSet, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from neuros.errors import DescriptionError, ModelError, UsageError
from neuros.ports import NodeContext, Packet
from neuros.project import suggest
from neuros.project.model import MODEL_FIELDS, Node
from neuros.registry import MODELS
from neuros.simulators.mujoco.cameras import Cameras, import_opengl
from neuros.simulators.mujoco.commands import Command, add_drives, bind_commands, read_commands
from neuros.simulators.mujoco.lookup import Problems, did_you_mean, has_any, names_of
from neuros.simulators.mujoco.sensor_base import Noise, Sensor
from neuros.simulators.mujoco.sensors import SENSORS, bind_sensors, read_sensors
from neuros.simulators.mujoco.timing import FiringSchedule, Timebase

_PROLOGUE = re.compile(r"<!--.*?-->|<\?.*?\?>|<!DOCTYPE[^>]*>", re.DOTALL)
_NUMBERS = (int, float, np.ndarray)  # types of fields of a model
_WARNINGS = mujoco.mjtWarning
_FATAL = (_WARNINGS.mjWARN_BADQPOS, _WARNINGS.mjWARN_BADQVEL, _WARNINGS.mjWARN_BADQACC)


@dataclass(frozen=True)
class _Bound:
    """The declarations, bound to one model.

    ``is_complete`` is false while a declaration waits for an entity that may be spawned.
    """

    sensors: Mapping[str, Sensor]
    commands: Mapping[str, Command]
    is_complete: bool


class Declared:
    """A compiled model with the sensors and commands that a node file declares.

    Raises ``ModelError`` with every problem of the declarations and the model at once.
    """

    def __init__(
        self,
        description: Node,
        load: Callable[[], tuple[Any, str]],
        problems: Problems,
        *,
        fine: bool,
    ) -> None:
        self._sensors = read_sensors(description, problems)
        self._commands = read_commands(description, problems)
        try:
            self._spec, self.where = load()
            if cameras := [each for each in self._sensors if SENSORS[each.kind].is_rendered]:
                # The off-screen buffer must be large enough for every camera.
                buffer = self._spec.visual.global_
                buffer.offwidth = max(buffer.offwidth, *(camera.width for camera in cameras))
                buffer.offheight = max(buffer.offheight, *(camera.height for camera in cameras))
                if not fine:
                    self._spec.visual.quality.offsamples = 0
            add_drives(self._spec, _joints_of(self._spec), self._commands, problems)
            self.model = compiled(self._spec.compile, self.where)
        except ModelError as error:
            problems.add_text(str(error))
            problems.raise_any()
        self.cameras = Cameras(self.model, fine=fine)
        self._noises = {each.output: Noise(each) for each in self._sensors}
        self.time = Timebase(self.model.opt.timestep)
        periods = {}
        for sensor in self._sensors:
            try:
                periods[sensor.output] = self.time.period_steps(sensor.rate_hz)
            except ValueError as error:
                problems.add(f"{sensor.pointer}/rate", str(error))
        self.schedule = FiringSchedule(periods)
        self.bound = self._bind(self.model, problems)
        problems.raise_any()

    def _bind(self, model: Any, problems: Problems, *, may_wait: bool = True) -> _Bound:
        bodies = names_of(model, "body")

        def may_be_spawned(element: str) -> bool:
            parts = element.split("/")
            entities = ("/".join(parts[:count]) for count in range(1, len(parts)))
            return any(entity and not _is_taken(entity, bodies) for entity in entities)

        def can_be_bound(elements: Iterable[str]) -> bool:
            return not may_wait or all(
                has_any(model, name) or not may_be_spawned(name) for name in elements
            )

        sensors = [sensor for sensor in self._sensors if can_be_bound(sensor.elements)]
        commands = [command for command in self._commands if can_be_bound(command.actuators)]
        is_complete = len(sensors) == len(self._sensors) and len(commands) == len(self._commands)
        return _Bound(
            bind_sensors(model, sensors, self.cameras, self._noises, problems),
            bind_commands(model, commands, problems),
            is_complete,
        )


class World(Declared):
    """Physics in whole steps; the caller decides when to step.

    A sensor is read at the state of its firing time, after ``mj_forward`` unless it measures the
    state alone, so that the reading and its stamp belong together (right after ``mj_step`` MuJoCo's
    readings are one step old). The physics is bit for bit that of ``mj_step`` without sensors.

    A declaration that names an element ``name/...`` waits until :meth:`spawn` adds that element;
    :meth:`require_bound` ends the waiting.

    Attributes:
        steps: timesteps since the start, or since the last reset.
        time_s: the same in simulated seconds.
    """

    def __init__(self, node: NodeContext, model: Any, *, fine: bool) -> None:
        self._node = node
        problems = Problems(node.description.file)
        super().__init__(node.description, lambda: load_spec(node, model), problems, fine=fine)
        self.data = mujoco.MjData(self.model)
        self._warnings = self.data.warning.number
        self._no_warnings = bytes(self._warnings.nbytes)
        if any(SENSORS[sensor.kind].is_rendered for sensor in self._sensors):
            import_opengl()  # raises now, not at the first image
        self._seen_warnings: set[int] = set()
        self._fields = ModelFields(self.where)
        self.reset()

    def require_bound(self) -> None:
        """Raise ``ModelError`` if a declaration names an element that has never been spawned."""
        if not self.bound.is_complete:
            problems = Problems(
                self._node.description.file,
                "; an entity that has it must be spawned before the first step",
            )
            self._bind(self.model, problems, may_wait=False)
            problems.raise_any()

    def step(self, count: int) -> None:
        """Advance the physics; raises ``ModelError`` if it has become unstable."""
        mujoco.mj_step(self.model, self.data, nstep=count)
        self.steps += count
        self.time_s = self.time.seconds(self.steps)
        if self._warnings.tobytes() != self._no_warnings:  # any() takes ten times as long
            self._report_warnings(count)

    def sense(self, outputs: Sequence[str]) -> dict[str, Packet]:
        """The packets of these sensors for the present state."""
        sensors = self.bound.sensors
        for output in outputs:
            if sensors[output].needs_forward:
                forward(self.model, self.data)
                break
        time_ns, make_packet = self.time.nanoseconds(self.steps), self._node.make_packet
        packets = {}
        for output in outputs:
            sensor, packet = sensors[output], make_packet(output)
            packets[output] = packet
            if sensor.is_array:
                sensor.fill_array(packet, self.data)
            else:
                sensor.fill(packet, self.data, time_ns)
        return packets

    def reset(self) -> None:
        """Back to time zero and the model's initial state; spawned entities stay.

        Noise begins anew, by the seed of now.
        """
        self._fields.apply(self.model)
        mujoco.mj_resetData(self.model, self.data)
        forward(self.model, self.data)
        self.steps, self.time_s = 0, 0.0
        for noise in self._noises.values():
            if noise.is_on:
                noise.begin(self._node.seeds[0])

    def check_fields(self, variables: Mapping[str, str]) -> None:
        """Check the fields of the model that a fork will change. Raises ``ModelError``."""
        self._fields.check(self.model, variables)

    def change_fields(self) -> None:
        """Change fields of the model as the environment has them now; the state stays."""
        if self._fields.apply(self.model):
            forward(self.model, self.data)

    def spawn(self, path: str, position: Sequence[float], name: str) -> None:
        """Attach the model of a file to the world; everything else keeps its state."""
        if len(position) != 3:
            raise ModelError(f"entity '{name}': a position is x, y, z in metres, not {position!r}")
        if not name or _is_taken(name, names_of(self.model, "body")):
            raise ModelError(f"an entity needs a name of its own: '{name}' is taken")
        child, where = load_spec(self._node, path)
        # First on a copy: a spec cannot go back once something that does not fit is attached.
        trial, problems = self._spec.copy(), Problems(self._node.description.file)
        self._attach(trial, child.copy(), position, name, problems)
        self._bind(compiled(trial.compile, where), problems)
        problems.raise_any()
        self._attach(self._spec, child, position, name, problems)
        # The new elements come last in the world.
        self._recompile(range(self.model.nbody), range(self.model.neq))

    def remove(self, name: str, *, may_unbind: bool) -> None:
        """Remove a spawned entity; everything else keeps its state.

        With ``may_unbind`` sensors and actuators that are declared for the entity wait for another
        one of that name; without it they are an error.
        """
        trial = self._spec.copy()
        frame = trial.frame(_frame_of(name))
        if frame is None:
            known = [each.name[:-1] for each in trial.frames if each.name.endswith("/")]
            raise ModelError(f"there is no spawned entity '{name}'{did_you_mean(name, known)}")
        # The numbers of the constraints that stay are read from their names after the deletion.
        for number, each in enumerate(trial.equalities):
            each.name = f"#{number}"
        trial.delete(frame)
        problems = Problems(self._node.description.file)
        model = compiled(trial.compile, self.where)
        bound = self._bind(model, problems)
        problems.raise_any()
        if not (bound.is_complete or may_unbind):
            raise ModelError(
                f"entity '{name}' has sensors or actuators of {self._node.description.file}:"
                " stop() the simulation before it is removed"
            )
        bodies = _bodies_without(self._spec, name)
        self._spec.delete(self._spec.frame(_frame_of(name)))
        self._recompile(bodies, [int(model.equality(i).name[1:]) for i in range(model.neq)])

    def _recompile(self, bodies: Sequence[int], equalities: Sequence[int]) -> None:
        """Compile the changed spec; bodies and constraints that stay keep their state.

        ``recompile`` keeps positions, velocities, activations, controls and time, and the order of
        elements. This method copies the other fields, of the rows ``bodies`` and ``equalities``.
        """
        old, before = self.model, self.data
        self.model, self.data = self._spec.recompile(old, before)
        self._fields = ModelFields(self.where)
        self._warnings = self.data.warning.number
        self.cameras.use(self.model)
        self.bound = self._bind(self.model, Problems(self._node.description.file))
        mujoco.mj_forward(self.model, self.data)
        dofs = np.flatnonzero(np.isin(old.dof_bodyid, bodies))
        mocaps = old.body_mocapid[bodies]
        for rows, fields in (
            (dofs, ("qacc_warmstart", "qfrc_applied")),
            (bodies, ("xfrc_applied",)),
            (mocaps[mocaps >= 0], ("mocap_pos", "mocap_quat")),
            (equalities, ("eq_active",)),
        ):
            for field in fields:
                getattr(self.data, field)[: len(rows)] = getattr(before, field)[list(rows)]

    def _attach(
        self, spec: Any, child: Any, position: Sequence[float], name: str, problems: Problems
    ) -> None:
        """Attach an entity as ``name/...``, and add the actuators declared for its joints."""
        before = _joints_of(spec)
        frame = spec.worldbody.add_frame(
            name=_frame_of(name), pos=[float(value) for value in position]
        )
        spec.attach(child, prefix=f"{name}/", frame=frame)
        add_drives(spec, _joints_of(spec) - before, self._commands, problems)

    def _report_warnings(self, count: int) -> None:
        """Log new warnings of MuJoCo; raise ``ModelError`` where the state has diverged."""
        since = self.time.seconds(self.steps - count)
        when = f"between {since:g} s and {self.time_s:g} s of simulated time"
        report_warnings(self._node, self.data, self.where, when, self._seen_warnings)


def forward(model: Any, data: Any) -> None:
    """Compute from the present state what sensors measure, without a change of the next step.

    ``mj_forward`` restarts the solver, which would change that.
    """
    solution = data.qacc_warmstart.copy()
    mujoco.mj_forward(model, data)
    data.qacc_warmstart[:] = solution


def report_warnings(
    node: NodeContext, data: Any, where: str, when: str, seen: MutableSet[int]
) -> None:
    """Log the warnings of MuJoCo that are not among those seen.

    Raises:
        ModelError: if the state has diverged.
    """
    for warning, number in enumerate(data.warning.number.tolist()):
        if not number:
            continue
        text = mujoco.mju_warningText(warning, int(data.warning[warning].lastinfo))
        if warning in [fatal.value for fatal in _FATAL]:
            raise ModelError(
                f"{where}: unstable {when}: {text} A smaller timestep, softer contacts or gains"
                " may help."
            )
        if warning not in seen:
            seen.add(warning)
            node.get_logger().warning(f"{where}: MuJoCo: {text}")


class ModelFields:
    """Fields of the model that a reset has changed, until the next one.

    They come by the environment of the node. A model that is compiled anew, since entities come or
    go, has its own values again.
    """

    def __init__(self, where: str) -> None:
        self._where = where
        self._before: dict[str, Any] = {}

    def check(self, model: Any, variables: Mapping[str, str]) -> None:
        """Check that the fields in an environment can be changed. Raises ``ModelError``."""
        if MODEL_FIELDS in variables:
            ModelFields(self._where).apply(copy.copy(model), variables[MODEL_FIELDS])

    def apply(self, model: Any, text: str | None = None) -> bool:
        """Give the fields of before their values back, then change those of now.

        Args:
            text: those of now, as JSON; ``None``: as the environment has them.

        Returns:
            Whether something may have changed.

        Raises:
            ModelError: if the model has no such field, or it has another shape.
        """
        fields = json.loads((os.environ.get(MODEL_FIELDS) if text is None else text) or "{}")
        if not (fields or self._before):
            return False
        for name, value in self._before.items():
            self._set(model, name, value)
        self._before = {name: self._set(model, name, value) for name, value in fields.items()}
        # What MuJoCo has derived from them; it computes that in the data that it is given.
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return True

    def _set(self, model: Any, name: str, value: Any) -> Any:
        """Change a field; returns its value of before."""
        *owners, last = name.split(".")
        owner = model
        for each in owners:
            owner = getattr(owner, each, None)
        before = getattr(owner, last, None)
        if not isinstance(before, _NUMBERS):
            known = [n for n in dir(owner) if isinstance(getattr(owner, n, None), _NUMBERS)]
            hint = suggest.did_you_mean(last, known) or "see the fields of mujoco.MjModel"
            raise ModelError(
                f"{self._where}: the model has no field '{name}' with numbers ({hint})"
            )
        if name == "opt.timestep":
            raise ModelError(
                f"{self._where}: 'opt.timestep' cannot be changed here, since sensors have periods"
                " of whole timesteps: change it in the model"
            )
        try:
            array = np.asarray(value, np.float64)
        except (TypeError, ValueError):
            raise ModelError(f"{self._where}: {name}={value!r}: give numbers") from None
        old = np.array(before)
        if array.shape not in ((), old.shape):
            raise ModelError(
                f"{self._where}: '{name}' has the shape {old.shape}, not {array.shape}: give all"
                " its values, or a number for all of them"
            )
        if old.dtype.kind != "f" and (array % 1).any():
            raise ModelError(f"{self._where}: {name}={value!r}: give whole numbers")
        try:
            if isinstance(before, np.ndarray):
                before[...] = array
            else:
                setattr(owner, last, type(before)(array))
        except (AttributeError, ValueError):
            raise ModelError(f"{self._where}: '{name}' cannot be changed") from None
        return old


def _frame_of(entity: str) -> str:
    """The name of the frame that holds a spawned entity."""
    return f"{entity}/"


def _bodies_without(spec: Any, entity: str) -> list[int]:
    """The ids of all bodies that stay when an entity is removed.

    A spec numbers its bodies anew at a deletion, so the bodies of a copy are named by their number.
    """
    marked = spec.copy()
    for number, body in enumerate(marked.bodies):
        if number:  # the world keeps its name
            body.name = f"#{number}"
    marked.delete(marked.frame(_frame_of(entity)))
    return [0, *(int(body.name[1:]) for body in marked.bodies[1:])]


def _is_taken(entity: str, bodies: Iterable[str]) -> bool:
    return any(body.startswith(f"{entity}/") for body in bodies)


def load_spec(node: NodeContext, model: Any) -> tuple[Any, str]:
    """A new ``MjSpec``, and its name in messages.

    ``model`` is the path of an MJCF, URDF or SDF file, also in a folder of Gazebo's variables,
    MJCF as text, or an ``MjSpec``, which is copied. Parts of a URDF or SDF file without a
    counterpart in MuJoCo are logged as a warning.
    """
    description = node.description
    if isinstance(model, mujoco.MjSpec):
        return model.copy(), f"MjSpec '{model.modelname}'"
    if isinstance(model, str) and model.lstrip().startswith("<"):
        return _from_text(description, model)
    if isinstance(model, str | Path):
        try:
            path = node.resolve_path(str(model))
        except ModelError:
            suffix, found = Path(model).suffix.lower()[1:], None
            if suffix in MODELS:
                environ = {**os.environ, **description.environment}
                found = MODELS.load(suffix).find(str(model), description.plugin.parent, environ)
            if found is None:
                raise
            path = found
        return _from_file(description, path, node.get_logger().warning), str(path)
    raise ModelError(
        f"a model is the path of a file, MJCF as text, or a mujoco.MjSpec, "
        f"not a {type(model).__name__}"
    )


def problems_of(description: Node, model: Path | str) -> list[tuple[str, str]]:
    """The problems of a model (a file, or MJCF as text) and of a node's declarations for it.

    Each has its pointer into the node file, empty for a problem of the model, and a text.
    """

    def load() -> tuple[Any, str]:
        if isinstance(model, str):
            return _from_text(description, model)
        return _from_file(description, model, lambda _: None), str(model)

    problems = Problems(description.file)
    with contextlib.suppress(ModelError):
        Declared(description, load, problems, fine=False)
    return problems.found


def _from_text(description: Node, model: str) -> tuple[Any, str]:
    where = f"XML text in {description.plugin}"
    if _is_urdf(model):
        raise ModelError(f"{where}: this is URDF; write it to a file that ends in .urdf")
    return compiled(lambda: mujoco.MjSpec.from_string(model), where), where


def _is_urdf(xml: str | Path) -> bool:
    """Whether XML is URDF, which MuJoCo reads with defaults of its own in the place of URDF's."""
    try:
        text = xml if isinstance(xml, str) else xml.read_text("utf-8", "replace")
    except OSError:
        return False
    return _PROLOGUE.sub("", text).lstrip("\ufeff \t\r\n").startswith("<robot")


def _from_file(description: Node, path: Path, warn: Callable[[str], object]) -> Any:
    kind = path.suffix.lower()
    if kind in (".xml", ".mjcf") and _is_urdf(path):
        kind = ".urdf"
    if kind == ".xml":
        return compiled(lambda: mujoco.MjSpec.from_file(str(path)), str(path))
    if kind == ".mjcf":  # MuJoCo's from_file knows .xml only
        spec = compiled(lambda: mujoco.MjSpec.from_string(path.read_text("utf-8")), str(path))
        spec.modelfiledir = str(path.parent)
        return spec
    try:
        format_ = MODELS.load(kind[1:])
    except UsageError as error:
        raise ModelError(f"{path}: {error}") from error
    try:
        spec, lacks = format_.read(path, {**os.environ, **description.environment})
    except DescriptionError as error:
        raise ModelError(str(error)) from error
    if lacks:
        rows = "".join(f"\n  {row}" for row in lacks)
        warn(f"{path.name}: not converted, or converted differently:{rows}")
    return spec


def _joints_of(spec: Any) -> set[str]:
    return {joint.name for joint in spec.joints}


def compiled(parse: Callable[[], Any], where: str) -> Any:
    """The result of ``parse``; an error of MuJoCo becomes a ``ModelError`` about ``where``."""
    try:
        return parse()
    except (ValueError, RuntimeError, TypeError, mujoco.FatalError) as error:
        text = " ".join(str(error).split())
        raise ModelError(f"{where}: the model does not compile: {text}") from error
