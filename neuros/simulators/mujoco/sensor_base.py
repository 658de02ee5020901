"""The common part of MuJoCo sensors: declaration, base class, frames, and parts of messages."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, TypeAlias

import mujoco
import numpy as np
import numpy.typing as npt

from neuros.ports import Packet
from neuros.project.message_types import ArrayType, array_type
from neuros.simulators.mujoco.cameras import Cameras
from neuros.simulators.mujoco.lookup import Problems, find
from neuros.time import set_stamp

Vector: TypeAlias = "list[float]"
"""3 numbers, or 4 for a quaternion, w first, as plain floats."""

WORLD_FRAME = "world"


class Key(NamedTuple):
    """A key of a declaration with a numeric value.

    Attributes:
        default: the value where the key is left out.
        what: a description of valid values, for messages.
    """

    default: float
    what: str
    is_whole: bool = False
    least: float = -math.inf
    most: float = math.inf

    def holds(self, value: Any) -> bool:
        """Whether a value is valid."""
        kinds = int if self.is_whole else (int, float)
        is_number = isinstance(value, kinds) and not isinstance(value, bool)
        return is_number and math.isfinite(value) and self.least <= value <= self.most


def pixels(default: int) -> Key:
    """The key of a width or height."""
    return Key(default, "a number of pixels from 1 to 16384", is_whole=True, least=1, most=16384)


PICTURE: Mapping[str, Key] = MappingProxyType({"width": pixels(640), "height": pixels(480)})
DEVIATION = Key(0.0, "a standard deviation, 0 or more", least=0.0)


@dataclass(frozen=True)
class SensorDeclaration:
    """A sensor behind an output. ``pointer`` is the place of its ``mujoco`` key in the file."""

    output: str
    type: str
    kind: str
    elements: tuple[str, ...]
    rate_hz: float
    pointer: str
    options: Mapping[str, float] = field(default_factory=dict)

    @property
    def array(self) -> ArrayType | None:
        """The type of the output if it sends arrays."""
        return array_type(self.type)

    @property
    def width(self) -> int:
        """Pixels per row, of a camera."""
        return int(self.options["width"])

    @property
    def height(self) -> int:
        """Rows of pixels."""
        return int(self.options["height"])


class Noise:
    """White noise and a drifting bias (a random walk) of one sensor, in the units of its numbers.

    Each sensor draws from a stream of its own, which follows from the seed of the node and the name
    of the output. It goes on where entities come and go, and begins anew at a reset.

    Attributes:
        deviation: standard deviation of the white noise of a reading, key ``noise``.
        is_on: whether there is any.
    """

    def __init__(self, declared: SensorDeclaration) -> None:
        self.deviation = declared.options.get("noise", 0.0)
        # The bias of a firing differs from that of the one before, which is 1 / rate older.
        self._drift = declared.options.get("bias_drift", 0.0) / math.sqrt(declared.rate_hz)
        self.is_on = bool(self.deviation or self._drift)
        self._output = declared.output

    def begin(self, seed: int) -> None:
        """Begin anew, with a bias of 0."""
        self._generator = np.random.default_rng([seed, *self._output.encode()])
        self._bias: Any = 0.0

    def of(self, values: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Values as measured, with noise; called once for each firing."""
        values = np.asarray(values, np.float64)
        white = self._generator.standard_normal(values.shape)
        if self._drift:
            self._bias += self._drift * self._generator.standard_normal(values.shape)
        noisy: npt.NDArray[np.float64] = values + self._bias + self.deviation * white
        return noisy


class Sensor:
    """A sensor behind an output, bound to a model; one subclass for each kind.

    The first line of a subclass's docstring describes it in the schema.

    Attributes:
        kind: the value of ``"sensor"`` in a node file.
        types: the message types that it can fill, and arrays of any shape, ``float64[...]``.
        list_types: those of them that hold a list of elements.
        axes: the keys of its declaration that the axes of an array stand for, if left out.
        sorts: the sorts of elements it measures; the first sort that has the name wins.
        is_optional: whether the element may be left out.
        keys: further keys of its declaration.
        is_rendered: whether it renders pictures.
        needs_forward: whether it measures what MuJoCo computes from the state of a step only in
            ``mj_forward``.
        declared: the declaration.
        is_array: whether its packets are arrays.
        noise: its noise; a kind with keys for noise adds it.
        elements: sort and id of each element that it names.
    """

    kind: ClassVar[str]
    types: ClassVar[tuple[str, ...]]
    list_types: ClassVar[tuple[str, ...]] = ()
    sorts: ClassVar[tuple[str, ...]] = ()
    is_optional: ClassVar[bool] = False
    keys: ClassVar[Mapping[str, Key]] = MappingProxyType({})
    axes: ClassVar[tuple[str, ...]] = ()
    is_rendered: ClassVar[bool] = False
    needs_forward = True

    def __init__(
        self,
        declared: SensorDeclaration,
        model: Any,
        cameras: Cameras,
        noise: Noise,
        problems: Problems,
    ) -> None:
        self.declared, self.model, self.cameras, self.noise = declared, model, cameras, noise
        self.is_array = declared.array is not None
        found = [self.find(name, problems) for name in declared.elements]
        self.elements = [element for element in found if element]
        if len(self.elements) == len(found):
            self.bind(problems)

    def find(self, name: str, problems: Problems) -> tuple[str, int] | None:
        """Sort and id of an element that the declaration names; a problem is reported."""
        return find(self.model, self.sorts, name, f"{self.declared.pointer}/element", problems)

    def bind(self, problems: Problems) -> None:
        """Prepare to measure the elements, once; problems with them are reported."""

    def fill(self, packet: Packet, data: Any, time_ns: int) -> None:
        """Fill a message from the data right after ``mj_forward``."""
        raise NotImplementedError

    def fill_array(self, packet: Packet, data: Any) -> None:
        """Fill an array of zeros, in the place of a message."""
        raise NotImplementedError

    def check_array(self, problems: Problems, what: str, *shape: int) -> None:
        """Report an output whose arrays do not hold ``what``, of this shape.

        Numbers in one row fill an array of any shape, row by row.
        """
        array = self.declared.array
        if array is None or array.shape == shape or (len(shape) == 1 and array.size == shape[0]):
            return
        problems.add(
            self.declared.pointer,
            f"{what} fill {ArrayType(array.dtype, shape)}, but output '{self.declared.output}'"
            f" is a {array}",
        )


def set_header(header: Any, time_ns: int, frame: str) -> None:
    set_stamp(header.stamp, time_ns)
    header.frame_id = frame


def set_vector(vector: Any, values: Vector) -> None:
    vector.x, vector.y, vector.z = values


def set_quaternion(quaternion: Any, values: Vector) -> None:
    """ROS writes the real part last, MuJoCo first."""
    quaternion.w, quaternion.x, quaternion.y, quaternion.z = values


class Frame:
    """The frame of a site, or of a body (the body's own frame, not that of its inertia)."""

    def __init__(self, model: Any, sort: str, index: int) -> None:
        self._model, self._is_site, self.index = model, sort == "site", index
        objects = mujoco.mjtObj
        self.object = (objects.mjOBJ_SITE if self._is_site else objects.mjOBJ_XBODY).value
        self._spatial, self._turned = np.zeros(6), np.zeros(4)
        if self._is_site:
            self._body = int(model.site_bodyid[index])
            self._in_body = model.site_quat[index]

    def position(self, data: Any) -> Vector:
        """In the world, metres."""
        positions = data.site_xpos if self._is_site else data.xpos
        return listed(positions[self.index])

    def orientation(self, data: Any) -> Vector:
        """In the world, a unit quaternion."""
        if not self._is_site:
            return listed(data.xquat[self.index])
        mujoco.mju_mulQuat(self._turned, data.xquat[self._body], self._in_body)
        return listed(self._turned)

    def angular_velocity(self, data: Any) -> Vector:
        """In this frame, rad/s: a gyroscope."""
        mujoco.mj_objectVelocity(self._model, data, self.object, self.index, self._spatial, 1)
        return listed(self._spatial[:3])

    def acceleration(self, data: Any) -> Vector:
        """In this frame, m/s^2, gravity included: an accelerometer."""
        # mj_forward leaves the accelerations out unless a sensor of the model needs them.
        if not getattr(data, "flg_rnepost", False):
            mujoco.mj_rnePostConstraint(self._model, data)
        mujoco.mj_objectAcceleration(self._model, data, self.object, self.index, self._spatial, 1)
        return listed(self._spatial[3:])


def listed(values: Any) -> Vector:
    numbers: Vector = values.tolist()
    return numbers
