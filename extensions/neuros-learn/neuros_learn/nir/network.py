"""Steps a network in NIR with NumPy, in the way of the library that wrote it.

NIR's equations are continuous, and a file has no time step. All supported exporters step by forward
Euler, in single precision; :data:`EXPORTERS` and the parameters of a node have their differences. A
neuron spikes where its potential is *above* its threshold.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from neuros.distribution import install_command
from neuros.errors import Problem
from neuros.ports import PluginCheck
from neuros.project.model import Node, Port
from neuros.project.scanner import problem_in
from neuros.project.suggest import did_you_mean, listed
from neuros_learn.nir.network_file import (
    MOST_VALUES,
    NEURONS,
    Graph,
    NetworkError,
    Part,
    read_graph,
)

Values: TypeAlias = NDArray[np.float32]
_Step: TypeAlias = "Callable[[Values], Values]"
_RESETS = ("subtract", "v_reset", "none")
_TYPES = re.compile(r"std_msgs/msg/Float(32|64)(MultiArray)?|float(32|64)\[.*\]")
_TYPES_IN_WORDS = (
    "float32[...], float64[...], std_msgs/msg/Float32MultiArray, Float32, Float64MultiArray or"
    " Float64"
)
# ROS itself declares these parameters.
_OF_ROS = ("use_sim_time", "start_type_description_service")


@dataclass(frozen=True)
class Discretisation:
    """The discretisation of a network in time.

    Attributes:
        exporter: the library that has written the file.
        dt: seconds of a step.
        reset: the effect of a spike on the potential: ``subtract`` the threshold, set it to
            ``v_reset``, or ``none``.
        reset_delay: whether the reset waits for the next step (snnTorch only).
    """

    exporter: str = "nir"
    dt: float = 1e-4
    reset: str = "v_reset"
    reset_delay: bool = False


EXPORTERS: Mapping[str, Discretisation] = {
    "nir": Discretisation(),
    "snntorch": Discretisation("snntorch", reset="subtract", reset_delay=True),
    # `to_nir` of Norse 1.1 writes dt * tau for tau, with dt = 1e-3 by default.
    "norse": Discretisation("norse", dt=1e-6),
}


def discretisation_of(parameters: Mapping[str, Any]) -> Discretisation:
    """The discretisation that a node's parameters ask for; raises :class:`NetworkError`."""
    given = {name: value for name, value in parameters.items() if name not in _OF_ROS}
    known = ("exporter", "dt", "reset", "reset_delay")
    exporter, problems = given.get("exporter", "nir"), []
    for name in given:
        if name not in known:
            hint = did_you_mean(name, known)
            text = f"a network has no parameter '{name}'"
            problems.append(f"{text} ({hint or f'it has {listed(known)}'})")
    if exporter not in EXPORTERS:
        problems.append(f"the parameter 'exporter' must be {listed(sorted(EXPORTERS))}")
    if given.get("reset", "none") not in _RESETS:
        problems.append(f"the parameter 'reset' must be {listed(_RESETS)}")
    if not isinstance(given.get("reset_delay", True), bool):
        problems.append("the parameter 'reset_delay' must be true or false")
    elif given.get("reset_delay", False) and exporter != "snntorch":
        problems.append("the parameter 'reset_delay' is one of snntorch")
    dt = given.get("dt", 1.0)
    if isinstance(dt, bool) or not isinstance(dt, int | float) or not 0 < dt < math.inf:
        problems.append("the parameter 'dt' must be a number of seconds, above 0")
    if problems:
        raise NetworkError(problems)
    return replace(EXPORTERS[str(exporter)], **given)


class Network:
    """A network and its state. A trial step with zeros checks all shapes.

    Raises:
        NetworkError: the shapes of its nodes do not fit each other.
    """

    def __init__(self, graph: Graph, how: Discretisation) -> None:
        self._parts, self._how = graph.parts, how
        self.inputs = {
            name: tuple(map(int, np.atleast_1d(graph.parts[name].values["shape"])))
            for name in graph.names("Input")
        }
        self.outputs = graph.names("Output")
        with np.errstate(all="ignore"):
            self.reset()
            self.step({name: np.zeros(shape, np.float32) for name, shape in self.inputs.items()})
            self.reset()

    def reset(self) -> None:
        """Go back to the state before the first step."""
        parts = self._parts.items()
        # The last outputs of neurons, for loops that go back.
        self._values = {
            path: np.zeros(np.shape(part.values["r"]), np.float32)
            for path, part in parts
            if part.kind in NEURONS
        }
        self._steps: dict[str, _Step] = {}
        for path, part in parts:
            with _naming(path, part):
                self._steps[path] = _step_of(part, self._how)

    def step(self, inputs: Mapping[str, Values]) -> dict[str, Values]:
        """The outputs of the next step, by name; inputs have the shapes of :attr:`inputs`."""
        values = self._values
        for path, part in self._parts.items():
            if part.kind == "Input":
                values[path] = inputs[path]
                continue
            with _naming(path, part):
                first, *others = (values[each] for each in part.sources)
                for other in others:
                    if other.shape != first.shape:
                        text = f"is given values of the shapes {first.shape} and {other.shape}"
                        raise ValueError(text)
                    first = first + other
                values[path] = self._steps[path](first)
        return {name: values[name] for name in self.outputs}


@contextmanager
def _naming(path: str, part: Part) -> Iterator[None]:
    """Turn NumPy's errors about parameters that do not fit into errors about the node."""
    try:
        yield
    except (ArithmeticError, LookupError, MemoryError, TypeError, ValueError) as error:
        text = str(error).partition("\n")[0]
        raise NetworkError([f"node '{path}' ({part.kind}) {text}"]) from None


def problems_of(node: Node, path: Path) -> list[str]:
    """All reasons why the network of a file cannot run as a node."""
    problems: list[str] = []
    graph, how = None, Discretisation()
    try:
        how = discretisation_of(node.parameters)
    except NetworkError as error:
        problems += error.problems
    try:
        graph = read_graph(path)
        Network(graph, how)
    except NetworkError as error:
        problems += error.problems
    if graph is not None:
        problems += _port_problems(graph.names("Input"), node.inputs, "input", "Input")
        problems += _port_problems(graph.names("Output"), node.outputs, "output", "Output")
    return problems


class _Check(PluginCheck):
    """Checks the network of a node before a run, as far as this Python can."""

    def problems(self, node: Node) -> Iterator[Problem]:
        if find_spec("h5py"):
            for text in problems_of(node, Path(node.environment.get("NETWORK", ""))):
                yield _at_network(node, text)

    def doubts(self, node: Node) -> Iterator[Problem]:
        if not find_spec("h5py"):
            hint = f"h5py is not installed: {install_command('nir')}"
            yield _at_network(node, "the network cannot be checked before the run", hint)
        if "exporter" not in node.parameters:
            text = "is stepped by NIR's own equations, but the library that wrote it may use others"
            hint = (
                'name that library: "parameters": {"exporter": "snntorch"}, see'
                " extensions/neuros-learn/README.md"
            )
            yield _at_network(node, text, hint)


CHECK = _Check()


def _at_network(node: Node, text: str, hint: str = "") -> Problem:
    return problem_in(node.file, f"{node.pointer}/network", text, hint)


def _port_problems(
    names: Sequence[str], ports: Sequence[Port], side: str, kind: str
) -> Iterator[str]:
    """Problems of ports, which must have the names of the network's Inputs and Outputs."""
    for port in ports:
        if port.name not in names:
            yield f"the network has no {kind} '{port.name}', as the {side} (it has {listed(names)})"
        if not _TYPES.fullmatch(port.type):
            yield f"the {side} '{port.name}' must be of {_TYPES_IN_WORDS}, but is {port.type}"
    for name in {*names} - {port.name for port in ports}:
        yield f"the node declares no {side} '{name}', but the network has an {kind} of that name"


def _step_of(part: Part, how: Discretisation) -> _Step:
    weights = {
        name: _single(part.values[name]) for name in ("weight", "bias") if name in part.values
    }
    values = {**part.values, **weights}
    match part.kind:
        case "Affine" | "Linear":
            return lambda x: _linear(values, x)
        case "Scale":
            scale = _single(values["scale"])
            return lambda x: x * _of_shape(scale, x)
        case "Threshold":
            threshold = _single(values["threshold"])
            return lambda x: (x > _of_shape(threshold, x)).astype(np.float32)
        case "Flatten":
            return lambda x: _flatten(values, x)
        case "Conv1d" | "Conv2d":
            return lambda x: _convolution(values, x)
        case "SumPool2d" | "AvgPool2d":
            return lambda x: _pool(values, x, is_mean=part.kind == "AvgPool2d")
        case "Delay":
            return _Delay(values["delay"], how.dt)
        case "Input" | "Output":
            return lambda x: x
        case _:
            return _Neuron(part, how)


# ---------------------------------------------------------------------- nodes with a state


class _Neuron:
    """I, IF, LI, LIF, CubaLI or CubaLIF.

    ``i' = (-i + w_in x) / tau_syn``, ``v' = (v_leak - v + r i) / tau``, without a leak
    ``v' = r i``. The coefficients are computed as in the exporters of snnTorch and Norse, so that a
    weight of exactly 1 there is 1 here.
    """

    def __init__(self, part: Part, how: Discretisation) -> None:
        values, self._how = part.values, how
        self._has_current = "tau_syn" in values
        # snnTorch's Leaky zeroes its potential before it adds its input; other neurons after.
        self._zeroes_all = self._has_current or part.is_recurrent
        self._decay, self._gain, self._rest = np.float32(1), _single(values["r"]), np.float32(0)
        self._keep, self._weight = np.float32(0), np.float32(1)
        tau = values.get("tau", values.get("tau_mem"))
        if tau is not None:
            self._decay, self._gain = _coefficients(tau, values["r"], how.dt)
            self._rest = _single(values["v_leak"]) * (np.float32(1) - self._decay)
        elif how.exporter != "norse":
            self._gain = _single(np.asarray(values["r"]) * how.dt)
        if self._has_current:
            self._keep, self._weight = _coefficients(values["tau_syn"], values["w_in"], how.dt)
            if how.exporter == "norse":
                self._weight = _single(values["w_in"])
        self._threshold = _single(values["v_threshold"]) if "v_threshold" in values else None
        self._v_reset = _single(values["v_reset"])
        self._all = [np.asarray(each) for each in values.values()]
        self._v: Values | None = None
        self._i = np.float32(0) * self._keep
        self._leak = _single(values.get("v_leak", 0.0))

    def __call__(self, x: Values) -> Values:
        if self._v is None:
            for each in self._all:
                _of_shape(each, x)
            self._v = np.broadcast_to(self._leak, x.shape)
        if self._has_current:
            jumped = (self._i if self._how.exporter == "norse" else self._keep * self._i) + (
                self._weight * x
            )
            x, self._i = jumped, jumped
            if self._how.exporter == "norse":
                self._i = self._keep * jumped
        # snnTorch resets where the potential was above the threshold before this step.
        was_over = np.zeros_like(self._v)
        if self._threshold is not None and self._how.exporter == "snntorch":
            was_over = (self._v > self._threshold).astype(np.float32)
        v, drive = self._v, self._gain * x
        if self._how.reset == "v_reset" and not self._zeroes_all:
            v = np.where(was_over, self._v_reset, v)
        v = self._decay * v + drive + self._rest
        if self._threshold is None:
            self._v = v
            return _single(v)
        if self._how.reset == "subtract":
            v = v - was_over * self._threshold
        elif self._how.reset == "v_reset" and self._zeroes_all:
            v = np.where(was_over, self._v_reset, v)
        spikes = (v > self._threshold).astype(np.float32)
        if not self._how.reset_delay:
            if self._how.reset == "subtract":
                v = v - (spikes - was_over) * self._threshold
            elif self._how.reset == "v_reset":
                v = np.where(spikes > 0, self._v_reset, v)
        self._v = v
        return spikes


def _coefficients(tau: Any, weight: Any, dt: float) -> tuple[Values, Values]:
    """``1 - dt / tau`` and ``weight dt / tau``, in the precision of the file."""
    tau = np.asarray(tau)
    step = np.asarray(dt, tau.dtype if tau.dtype.kind == "f" else float)
    return _single(1 - step / tau), _single(weight / (tau / step))


class _Delay:
    """Returns its input of ``delay`` seconds ago, rounded to steps; zeros before."""

    def __init__(self, delay: Any, dt: float) -> None:
        self._steps = np.rint(np.asarray(delay, float) / dt)
        self._past: Values | None = None
        self._now = 0

    def __call__(self, x: Values) -> Values:
        if self._past is None:
            steps = np.broadcast_to(_of_shape(self._steps, x), x.shape)
            _refuse_if_large((float(steps.max()) + 1) * x.size)
            if steps.min() < 0:
                raise ValueError("has a negative delay")
            self._steps = steps.astype(np.int64)
            self._past = np.zeros((int(steps.max()) + 1, *x.shape), np.float32)
        length = len(self._past)
        self._past[self._now % length] = x
        index = (self._now - self._steps) % length
        self._now += 1
        return _single(np.take_along_axis(self._past, index[None], axis=0)[0])


# ---------------------------------------------------------------------- nodes without a state


def _linear(values: Mapping[str, Any], x: Values) -> Values:
    weight = values["weight"]
    if x.ndim == 0 or weight.shape[-1] != x.shape[-1]:
        raise ValueError(f"takes {weight.shape[-1]} values, but is given the shape {x.shape}")
    y = _single((weight @ x[..., None])[..., 0])
    return _single(y + _of_shape(values["bias"], y)) if "bias" in values else y


def _flatten(values: Mapping[str, Any], x: Values) -> Values:
    start, end = (int(values[name]) for name in ("start_dim", "end_dim"))
    start, end = (each + x.ndim if each < 0 else each for each in (start, end))
    if not 0 <= start <= end < x.ndim:
        raise ValueError(f"flattens dimensions {start} to {end}, but is given the shape {x.shape}")
    return x.reshape(*x.shape[:start], -1, *x.shape[end + 1 :])


def _convolution(values: Mapping[str, Any], x: Values) -> Values:
    """Convolve ``x`` (channels, *space) with (out, channels / groups, *kernel), as PyTorch."""
    weight, groups = values["weight"], int(values["groups"])
    out, channels, *kernel = weight.shape
    if groups < 1 or out % groups or x.shape[:1] != (channels * groups,):
        raise ValueError(f"takes {channels * groups} channels, but is given the shape {x.shape}")
    dilation, stride = (_each(values[name], len(kernel)) for name in ("dilation", "stride"))
    padding = values["padding"]
    if isinstance(padding, str) and padding == "same":
        sums = [d * (k - 1) for d, k in zip(dilation, kernel, strict=True)]
        around = [(each // 2, each - each // 2) for each in sums]
    else:
        padding = 0 if isinstance(padding, str) else padding  # "valid"
        around = [(each, each) for each in _each(padding, len(kernel))]
    windows = _windows(x, kernel, stride, around, dilation)
    space = windows.shape[1 : 1 + len(kernel)]
    patches = windows.reshape(groups, channels, math.prod(space), math.prod(kernel))
    patches = patches.transpose(0, 2, 1, 3).reshape(groups, math.prod(space), -1)
    kernels = weight.reshape(groups, out // groups, -1)
    y = (kernels @ patches.transpose(0, 2, 1)).reshape(out, *space)
    return _single(y + values["bias"].reshape(-1, *(1 for _ in kernel)))


def _pool(values: Mapping[str, Any], x: Values, *, is_mean: bool) -> Values:
    kernel, stride, padding = (_each(values[n], 2) for n in ("kernel_size", "stride", "padding"))
    windows = _windows(x, kernel, stride, [(each, each) for each in padding], [1, 1])
    return _single(windows.mean((-2, -1)) if is_mean else windows.sum((-2, -1)))


def _windows(
    x: Values,
    kernel: list[int],
    stride: list[int],
    around: list[tuple[int, int]],
    dilation: list[int],
) -> Values:
    """The values under the kernel at each place: (channels, *places, *kernel)."""
    spans = [d * (k - 1) + 1 for d, k in zip(dilation, kernel, strict=True)]
    if min(*kernel, *stride, *dilation, 1) < 1 or min(map(min, around)) < 0:
        raise ValueError("has a kernel, stride or dilation below 1, or padding below 0")
    sizes = [sum(each, size) for each, size in zip(around, x.shape[1:], strict=False)]
    if x.ndim != len(kernel) + 1 or any(a < b for a, b in zip(sizes, spans, strict=True)):
        raise ValueError(f"has a kernel that does not fit into the shape {x.shape}")
    places = [(a - b) // s + 1 for a, b, s in zip(sizes, spans, stride, strict=True)]
    _refuse_if_large(x.shape[0] * max(math.prod(sizes), math.prod(places) * math.prod(kernel)))
    padded = np.pad(x, [(0, 0), *around])
    axes = tuple(range(1, x.ndim))
    windows = sliding_window_view(padded, tuple(spans), axes)
    every = (slice(None, None, each) for each in (1, *stride, *dilation))
    return windows[tuple(every)]


# ---------------------------------------------------------------------- shapes


def _single(value: Any) -> Values:
    return np.asarray(value, np.float32)


def _each(value: Any, dimensions: int) -> list[int]:
    """One whole number per dimension; a file may have one for all."""
    array = np.asarray(value)
    if array.dtype.kind not in "iu" or array.size not in (1, dimensions):
        raise ValueError(f"needs {dimensions} whole numbers for each of its dimensions")
    return [int(each) for each in np.broadcast_to(array.ravel(), dimensions)]


def _of_shape(parameter: Any, x: Values) -> Any:
    """Check that a parameter has one value for all of ``x``, or one for each; returns it."""
    fits = parameter.ndim <= x.ndim and all(
        a in (1, b) for a, b in zip(parameter.shape[::-1], x.shape[::-1], strict=False)
    )
    if not fits:
        text = f"has parameters of the shape {parameter.shape}, but is given the shape {x.shape}"
        raise ValueError(text)
    return parameter


def _refuse_if_large(size: float) -> None:
    if size > MOST_VALUES:
        raise ValueError(f"would hold more than {MOST_VALUES} values")
