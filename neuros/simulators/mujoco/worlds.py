"""Many worlds of one model, for the copies of a node: one call steps them all.

Each world is an ``MjData`` of its own, stepped by ``mj_step``, which lets other threads run. So a
copy is bit for bit what it is alone. ``mujoco.rollout`` steps as fast, but begins each call without
the solution that the solver of the last step has left (``qacc_warmstart``), which it does not
return.
"""

from __future__ import annotations

import copy
import os
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import mujoco
import numpy as np

from neuros.errors import ModelError
from neuros.ports import NodeContext
from neuros.project.model import MODEL_FIELDS
from neuros.simulators.mujoco.readings import (
    AFTER_CONSTRAINT,
    STATE,
    compute_forces,
    field_of,
    no_field,
    part_of,
)
from neuros.simulators.mujoco.scene import WorldView
from neuros.simulators.mujoco.timing import Timebase
from neuros.simulators.mujoco.world import (
    ModelFields,
    compiled,
    forward,
    load_spec,
    report_warnings,
)

_COPIES_PER_THREAD = 8
"""Waking a thread takes as long as a step of a few small worlds."""


class MuJoCoWorlds:
    """The worlds of a node with ``"copies"``: equal models, each with a state of its own.

    A hook steps them, and reads arrays with an axis of copies::

        worlds = MuJoCoWorlds(node, "cheetah.xml")
        worlds.step(torques, 5)             # (64, 6)
        joints = worlds.read("qpos", "qvel")  # (64, 18)

    Args:
        node: the ``node`` of the hook.
        model: path of an MJCF, URDF or SDF file (looked up as paths in node files are), MJCF as
            text, or a ``mujoco.MjSpec`` (copied).
        begin: called with the ``MjData`` and the generator of each copy that begins anew, from the
            model's initial state: it sets another one.
        randomise: called before with the ``MjModel`` and the generator of that copy, which has
            then a model of its own: it changes that of the file.
        threads: that step the copies; ``None``: one for each 8 copies, at most one for each core.

    Attributes:
        copies: their number.
        models, data: the ``mujoco.MjModel`` and ``mujoco.MjData`` of each copy.

    Raises:
        ModelError: if the model does not compile.
        NodeError: if ``begin`` or ``randomise`` needs seeds, and the node has none.
    """

    def __init__(
        self,
        node: NodeContext,
        model: Any,
        *,
        begin: Callable[[Any, np.random.Generator], object] | None = None,
        randomise: Callable[[Any, np.random.Generator], object] | None = None,
        threads: int | None = None,
    ) -> None:
        self.copies = node.copies
        self._node, self._begin, self._randomise = node, begin, randomise
        spec, self._where = load_spec(node, model)
        self._model = compiled(spec.compile, self._where)
        self._time = Timebase(self._model.opt.timestep)
        self._fields = ModelFields(self._where)
        self.models = [self._model] * self.copies
        self.data = [mujoco.MjData(self._model) for _ in range(self.copies)]
        self._ctrls = [data.ctrl for data in self.data]
        self._numbers = [data.warning.number for data in self.data]
        self._seen_warnings: set[int] = set()
        # By what is read: the views of all copies, in turn, and whether mj_forward comes before.
        self._views: dict[tuple[str, ...], tuple[list[Any], bool, bool]] = {}
        self._times = np.zeros((self.copies, 1))
        usual_threads = min(len(os.sched_getaffinity(0)), self.copies // _COPIES_PER_THREAD)
        self._threads = max(1, threads if threads is not None else usual_threads)
        self._pool: ThreadPoolExecutor | None = None
        self._view = WorldView(lambda: (self.models[0], self.data[0], self.sim_time))
        self.reset()
        node.own_simulated_time(lambda: self.sim_time)
        node.show_world(self._view.observe)
        node.on_close(self.close)
        node.on_change(self._change_fields, self._check_fields)

    @property
    def sim_time(self) -> float:
        """Simulated seconds since the start, or since the last reset of all copies."""
        return self._time.seconds(self._steps)

    @property
    def timestep(self) -> float:
        """Simulated seconds per step."""
        return self._time.timestep_s

    def step(self, ctrl: Any = None, count: int = 1, *, reset: Any = None) -> None:
        """Advance each copy by ``count`` timesteps.

        Args:
            ctrl: the controls, ``(copies, nu)``; ``None``: those of before.
            count: a whole number from 1 on.
            reset: which copies begin anew in the place of these steps, ``copies`` truth values;
                ``None``: none.

        Raises:
            ModelError: for an array of another shape, or if a copy has become unstable.
        """
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise ModelError(f"step: count is a whole number from 1, not {count!r}")
        if ctrl is not None:
            self._control(np.asarray(ctrl))
        going: Iterable[int] = range(self.copies)
        if reset is not None:
            anew = self._chosen(reset)
            going = np.flatnonzero(~anew).tolist()
            self._begin_anew(np.flatnonzero(anew).tolist())
        self._view.is_stepping = True
        self._for_each(going, partial(mujoco.mj_step, nstep=count))
        self._view.is_stepping = False
        self._steps += count
        self._is_forward = False
        if np.concatenate(self._numbers).any():
            since = self._time.seconds(self._steps - count)
            when = f"between {since:g} s and {self.sim_time:g} s of simulated time"
            for index, data in enumerate(self.data):
                where = f"{self._where}: copy {index}"
                report_warnings(self._node, data, where, when, self._seen_warnings)
        if self._view.is_watched:
            self._view.record()

    def read(self, *names: str) -> Any:
        """Arrays of ``mjData`` of all copies, ``(copies, n)``: those of a copy follow each other.

        What MuJoCo computes from the state, as ``sensordata`` and ``xpos``, belongs to the present
        state.

        Args:
            names: ``"qpos"``, or a part, ``"qpos[2:]"``; as for the sensor ``data``.

        Raises:
            ModelError: if there is no such array.
        """
        if names not in self._views:
            self._views[names] = self._views_of(names)
        views, is_computed, is_after_constraint = self._views[names]
        if is_computed and not self._is_forward:
            self._for_each(range(self.copies), forward)
            self._is_forward = True
        if is_after_constraint:
            self._for_each(range(self.copies), compute_forces)
        self._times[:, 0] = [data.time for data in self.data]
        return np.concatenate(views).reshape(self.copies, -1)

    def reset(self, mask: Any = None) -> None:
        """Let copies begin anew, at time zero and in the initial state.

        Args:
            mask: which, ``copies`` truth values. ``None``: all, with the generators of the start,
                or of the seed that a session gives; a field of the model that it sets is set now.

        Raises:
            ModelError: for a mask of another number or type; for a field that the model lacks.
        """
        if mask is None:
            self._fields.apply(self._model)
            self._steps = 0
            self._generators = []
            if self._begin is not None or self._randomise is not None:
                self._generators = [np.random.default_rng(seed) for seed in self._node.seeds]
            self._begin_anew(range(self.copies))
        else:
            self._begin_anew(np.flatnonzero(self._chosen(mask)).tolist())

    def close(self) -> None:
        """End the threads. The node calls it at its end."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None

    # ---- inside -----------------------------------------------------------------------------

    def _check_fields(self, variables: Mapping[str, str]) -> None:
        """Check the fields of the model that a fork will change. Raises ``ModelError``."""
        self._fields.check(self._model, variables)
        if MODEL_FIELDS in variables and self._randomise is not None:
            raise ModelError(
                f"{self._where}: each copy has a model of its own (randomise), so a fork cannot"
                " change fields of all"
            )

    def _change_fields(self) -> None:
        self._is_forward &= not self._fields.apply(self._model)

    def _control(self, ctrl: Any) -> None:
        if ctrl.shape != (self.copies, self._model.nu):
            raise ModelError(
                f"{self._where}: the controls of {self.copies} copies with {self._model.nu}"
                f" actuators have the shape {(self.copies, self._model.nu)}, not {ctrl.shape}"
            )
        for own, values in zip(self._ctrls, ctrl, strict=True):
            own[:] = values

    def _chosen(self, mask: Any) -> Any:
        """A mask as one row of truth values."""
        chosen = np.asarray(mask)
        if chosen.dtype != bool or chosen.size != self.copies:
            raise ModelError(
                f"reset: a mask has {self.copies} truth values, one for each copy, not"
                f" {chosen.dtype}{list(chosen.shape)}"
            )
        return chosen.reshape(-1)

    def _begin_anew(self, copies: Iterable[int]) -> None:
        for index in copies:
            data = self.data[index]
            if self._randomise is not None:
                model = self.models[index] = copy.copy(self._model)
                self._randomise(model, self._generators[index])
                mujoco.mj_setConst(model, data)  # what MuJoCo has derived from its fields
            mujoco.mj_resetData(self.models[index], data)
            if self._begin is not None:
                self._begin(data, self._generators[index])
        self._is_forward = False

    def _views_of(self, names: tuple[str, ...]) -> tuple[list[Any], bool, bool]:
        fields = {field_of(name) for name in names}
        if wrong := [name for name in names if field_of(name) is None]:
            raise ModelError(f"read: {no_field(wrong[0])}")
        if not names:
            raise ModelError("read: name an array of mjData: read('qpos', 'qvel')")
        views = [
            part_of(data, name, time)
            for data, time in zip(self.data, self._times, strict=True)
            for name in names
        ]
        return views, not fields <= {*STATE}, not fields.isdisjoint(AFTER_CONSTRAINT)

    def _for_each(self, copies: Iterable[int], call: Callable[[Any, Any], object]) -> None:
        """Call something with the model and data of these copies, in all threads."""
        waiting, models, data = deque(copies), self.models, self.data

        def work() -> None:
            while waiting:
                try:
                    index = waiting.popleft()
                except IndexError:  # another thread was faster
                    return
                call(models[index], data[index])

        others = min(self._threads, len(waiting)) - 1
        if others < 1:
            work()
            return
        if self._pool is None:
            self._pool = ThreadPoolExecutor(self._threads - 1, "worlds")
        futures = [self._pool.submit(work) for _ in range(others)]
        try:
            work()
        finally:
            waiting.clear()  # after an error
            for future in futures:
                future.cancel() or future.result()
