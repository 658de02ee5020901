"""Simulator of a plugin: it steps the world, sends the packets of its sensors, shows a window."""

from __future__ import annotations

import os
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, TimeoutError
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from neuros.errors import ModelError
from neuros.ports import NodeContext, Packet
from neuros.simulators.mujoco.commands import Command, Controls, control
from neuros.simulators.mujoco.lookup import did_you_mean
from neuros.simulators.mujoco.scene import WorldView
from neuros.simulators.mujoco.timing import FreeRun, StepLock
from neuros.simulators.mujoco.world import World

_BOUT_S = 0.005
_BOUT_STEPS = 20
_IDLE_S = 0.1
_REFRESH_S = 1 / 60
_SPACE = 32
_CLOSE_S = 4.0  # shorter than a node's time to end; software OpenGL is slow to close


class MuJoCo:
    """A MuJoCo world whose sensors and actuators the node file declares.

    Either the plugin steps it (``step_synchronous``, ``step_to_next``, then ``read``), or it steps
    itself (``run_asynchronous``) and sends its packets as if a hook had returned them.

    A sensor of period T fires at T, 2T, ... exactly; stamps are simulated time. A given model and
    sequence of commands gives bit-identical packets in every run.

    Args:
        node: the ``node`` of the hook.
        model: path of an MJCF, URDF or SDF file (looked up as paths in node files are), MJCF as
            text, or a ``mujoco.MjSpec`` (copied).
        fine_rendering: cameras with shadows, reflections and multisampling, about 7 x slower.
        clock, wait: wall clock in seconds, and a sleep; for tests.

    Raises:
        ModelError: with every problem of the declarations and the model, by file and key.
    """

    def __init__(
        self,
        node: NodeContext,
        model: Any,
        *,
        fine_rendering: bool = False,
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[[float], object] | None = None,
    ) -> None:
        self._node, self._clock, self._wait = node, clock, wait
        self._world = World(node, model, fine=fine_rendering)
        self._view = WorldView(lambda: (self.model, self.data, self._world.time_s))
        self._lock = StepLock()
        self._unread: dict[str, Packet] = {}
        self._run: FreeRun | None = None
        self._viewer: Viewer | None = None
        if launch := find_launcher(node):
            self._viewer = Viewer(
                launch,
                self.model,
                self.data,
                toggle=self._toggle_pause,
                closed=self.resume,
            )
        self._is_over = self._is_shared = False
        world = self._world
        node.own_simulated_time(lambda: world.time_s)
        node.show_world(self._view.observe)
        node.on_close(self.close)
        node.on_change(self._change_fields, self._world.check_fields)

    # ---- what it is -------------------------------------------------------------------------

    @property
    def model(self) -> Any:
        """The ``mujoco.MjModel``; another one when entities come or go."""
        return self._world.model

    @property
    def data(self) -> Any:
        """The ``mujoco.MjData``; another one when entities come or go."""
        return self._world.data

    @property
    def sim_time(self) -> float:
        """Simulated seconds since the start, or the last reset; from any thread."""
        steps = self._seen_steps() if self.is_running else self._world.steps
        return self._world.time.seconds(steps)

    @property
    def timestep(self) -> float:
        """Simulated seconds per step."""
        return self._world.time.timestep_s

    @property
    def is_running(self) -> bool:
        """Whether it steps itself (paused or not)."""
        return self._run is not None and self._run.is_running

    # ---- the plugin steps it ----------------------------------------------------------------

    def step_synchronous(self, count: int = 1) -> None:
        """Advance ``count`` timesteps; nothing is sent.

        Raises ``ModelError``, before any step, if a sensor would fire while its last packet is
        unread, or twice.
        """
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise ModelError(f"step_synchronous: count is a whole number from 1, not {count!r}")
        self._step_to(self._world.steps + count, may_cross=True)

    def step_to_next(self) -> None:
        """Advance to the next firing of any sensor."""
        target = self._world.schedule.next_firing(self._world.steps)
        if target is None:
            raise ModelError(f"{self._node.description.file}: no output has a sensor to step to")
        self._step_to(target, may_cross=bool(self._unread))

    def _step_to(self, target: int, *, may_cross: bool) -> None:
        world = self._world
        if self._run is not None:
            self._refuse_while_running("step_synchronous")
        if not world.bound.is_complete:
            world.require_bound()
        # While the plugin waits here, only others can resume: in the viewer, or from a thread.
        has_viewer = self._viewer is not None and self._viewer.is_open
        if self._lock.is_paused and not (has_viewer or self._is_shared):
            raise ModelError("the simulation is paused: resume() it before it is stepped")
        while not self._is_over and self._lock.is_paused and not self._is_shared:
            self._sync_viewer()
            self._lock.wait_resumed(_IDLE_S)
        crossing = may_cross and world.schedule.find_crossing(self._unread, world.steps, target)
        if crossing:
            output, first, second = crossing
            when = world.time.seconds
            raise ModelError(
                f"{self._node.description.file}: sensor '{output}' would fire again at "
                f"{when(second):g} s while its packet of {when(first):g} s is unread: call "
                f"read('{output}') after each firing, every {second - first} steps"
            )
        virtual_time = self._node.virtual_time
        if virtual_time is not None:
            virtual_time.will_step_to(world.time.seconds(target))
        if self._is_shared:
            self._advance_shared(target)
        else:
            self._advance_to(target)

    def _advance_shared(self, target: int) -> None:
        """Step as far as a pause allows, and wait for more; other threads may visit meanwhile."""
        while self._world.steps < target:
            if not self._lock.enter(lambda: self._is_over or self._node.is_ending, _IDLE_S):
                if self._is_over or self._node.is_ending:  # nobody resumes it any more
                    self._lock.resume()
                    self._advance_to(target)
                self._sync_viewer()
                continue
            try:
                steps = self._world.steps
                self._advance_to(steps + self._lock.allowed(target - steps))
            finally:
                self._lock.leave()

    def read(self, output: str) -> Packet | None:
        """The packet of the sensor behind ``output`` that has come due since the last read."""
        if self._run is not None:
            self._refuse_while_running("read")
        packet = self._unread.pop(output, None)
        if packet is None:
            if output not in self._world.schedule:
                hint = did_you_mean(output, self._world.schedule)
                raise ModelError(f"no output '{output}' has a sensor{hint}")
            self._world.require_bound()
        return packet

    # ---- it steps itself --------------------------------------------------------------------

    def run_asynchronous(self, real_time_factor: float | None = 1.0) -> None:
        """Step in a thread of its own, ``real_time_factor`` simulated seconds per wall second.

        ``None``: as fast as possible. Packets that are due leave together; stepping waits while a
        reliable connection of one of them is blocked.
        """
        self._refuse_while_running("run_asynchronous")
        if real_time_factor is not None and not 0 < real_time_factor < float("inf"):
            raise ModelError(f"real_time_factor is positive or None, not {real_time_factor!r}")
        if real_time_factor is None and self._node.virtual_time is not None:
            raise ModelError(
                "run_asynchronous(None) takes no virtual time: give a real_time_factor, such as 1.0"
            )
        self._world.require_bound()
        self._world.cameras.close()  # its OpenGL belongs to this thread, not to the new one
        steps = _BOUT_STEPS
        if real_time_factor is not None:
            steps = max(1, round(_BOUT_S * real_time_factor / self.timestep))
        self._run = FreeRun(
            self._node,
            self._lock,
            lambda: self._bout(steps),
            lambda: self.sim_time,
            lambda: self._world.cameras.close(),
            None if self._viewer is None else self._sync_viewer,
            real_time_factor,
            self._clock,
            self._wait,
        )
        self._run.start()

    def stop(self) -> None:
        """End :meth:`run_asynchronous`; the plugin may step again."""
        if self._run is not None:
            is_running = self.is_running
            self._run.stop()
            if is_running:
                self._seen_steps()
                self._unread.clear()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Inside, no step runs: the place to touch ``model`` and ``data``. Nests."""
        with self._lock.visit():
            if self.is_running:
                self._seen_steps()
            yield

    def pause(self) -> None:
        """Let no further step begin until :meth:`resume`."""
        self._lock.pause()

    def resume(self) -> None:
        """Go on; the time spent in the pause is not caught up."""
        if self._run is not None:
            self._run.pacer.restart()
        self._lock.resume()

    def share(self) -> None:
        """From now on, other threads may use it, too, inside ``with sim.paused():``.

        A pause then lets the hook that steps it wait, until :meth:`resume` or :meth:`step_paused`.
        """
        self._is_shared = True

    def step_paused(self, count: int, cancelled: Callable[[], bool]) -> int:
        """In a pause, let whatever steps it make ``count`` timesteps; call it in another thread.

        Returns:
            How many were not made, since ``cancelled()`` or the end of the pause came first.
        """
        return self._lock.grant(count, cancelled)

    @property
    def is_paused(self) -> bool:
        """Whether no step begins but those of :meth:`step_paused`."""
        return self._lock.is_paused

    # ---- acting on it -----------------------------------------------------------------------

    def command(self, input_name: str, packet: Packet) -> None:
        """Drive the actuators that the node file declares for an input, from the next step on."""
        command = self._world.bound.commands.get(input_name)
        if command is None:
            self._world.require_bound()
            hint = did_you_mean(input_name, self._world.bound.commands)
            raise ModelError(f"no input '{input_name}' has an actuator{hint}")
        self._set(command, packet)

    def actuate(self, name: str, value: float) -> None:
        """Drive one actuator of the model, whether declared or not, from the next step on."""
        self._set(lambda _: control(self.model, name, value), None)

    def spawn_entity(self, path: str | Path, position: Sequence[float], name: str) -> None:
        """Attach the model of a file to the world at ``position`` (x, y, z in metres).

        Its elements are called ``name/...``; sensors and actuators that the node file declares for
        them are bound now. Everything that exists keeps its state; ``model`` and
        ``data`` are new objects, and changes that were made to the old ``model`` are gone.
        """
        with self.paused():
            self._world.spawn(str(path), position, name)
            if self._viewer is not None:
                self._viewer.show(self.model, self.data)

    def remove_entity(self, name: str) -> None:
        """Remove what :meth:`spawn_entity` has attached; everything else keeps its state.

        Sensors and actuators that the node file declares for it wait for another entity of that
        name, which must be spawned before the next step.

        Raises:
            ModelError: if there is none of that name, or if such sensors and actuators would be
                missing in a simulation that steps itself.
        """
        with self.paused():
            self._world.remove(name, may_unbind=not self.is_running)
            if self._viewer is not None:
                self._viewer.show(self.model, self.data)

    def reset(self) -> None:
        """Back to time zero and the initial state; unread packets are dropped."""
        with self.paused():
            self._world.reset()
            self._unread.clear()
            if self._run is not None:
                self._run.pacer.restart()

    def close(self) -> None:
        """Stop stepping, close windows, free OpenGL. The node calls it at its end."""
        self._is_over = True
        self.stop()
        self._lock.wake()
        self._world.cameras.close()
        if self._viewer is not None:
            self._viewer.close()

    # ---- inside -----------------------------------------------------------------------------

    def _set(self, command: Command, packet: Packet) -> None:
        if self._run is None and not self._is_shared:  # no other thread uses the data
            self._put(command(packet))
        else:
            with self.paused():
                self._put(command(packet))

    def _put(self, controls: Controls) -> None:
        ctrl = self._world.data.ctrl
        for actuator, value in controls:
            ctrl[actuator] = value

    def _bout(self, steps: int) -> Mapping[str, Packet]:
        """Up to ``steps`` steps, ending at a firing; the packets that are due then."""
        if not self._unread:  # packets that the plugin has not read are sent first
            world = self._world
            firing = world.schedule.next_firing(world.steps)
            target = world.steps + self._lock.allowed(steps)
            self._advance_to(target if firing is None else min(firing, target))
        due, self._unread = self._unread, {}
        return due

    def _advance_to(self, target: int) -> None:
        world, view = self._world, self._view
        view.is_stepping = True
        before = world.steps
        while world.steps < target:
            firing = world.schedule.next_firing(world.steps)
            stop = target if firing is None else min(firing, target)
            world.step(stop - world.steps)
            due = world.schedule.due(world.steps)
            if due:
                self._unread.update(world.sense(due))
            if view.is_watched:
                view.record()
        view.is_stepping = False
        self._lock.use(target - before)
        if self._viewer is not None:
            self._viewer.sync()

    def _change_fields(self) -> None:
        with self.paused():
            self._world.change_fields()

    def _seen_steps(self) -> int:
        """After how many steps a hook sees a world that steps itself; a replay goes on to there."""
        steps = self._node.reading(self._world.steps)
        if steps > self._world.steps:
            self._advance_to(steps)
        return steps

    def _refuse_while_running(self, what: str) -> None:
        if self._run is not None and self._run.is_running:
            raise ModelError(f"{what} is for a simulation that the plugin steps: stop() it first")

    def _sync_viewer(self) -> None:
        """Update the viewer, or notice that the user has closed it, during a pause."""
        with self.paused():
            if self._viewer is not None:
                self._viewer.sync()

    def _toggle_pause(self) -> None:
        if self._lock.is_paused:
            self.resume()
        else:
            self.pause()


class Viewer:
    """MuJoCo's native window, passive: it shows the simulation, and can pause it.

    The space bar pauses and resumes; closing the window resumes for good. ``launch`` is
    ``mujoco.viewer.launch_passive`` or a function with its signature.
    """

    def __init__(
        self,
        launch: Callable[..., Any],
        model: Any,
        data: Any,
        *,
        toggle: Callable[[], None],
        closed: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
        opens_within_s: float = 10.0,
    ) -> None:
        self._opens_within_s = opens_within_s
        self._launch, self._toggle, self._closed, self._clock = launch, toggle, closed, clock
        self._next = 0.0
        self._handle: Any = None
        self._threads: set[threading.Thread] = set()
        self.show(model, data)

    @property
    def is_open(self) -> bool:
        return self._handle is not None and bool(self._handle.is_running())

    def show(self, model: Any, data: Any) -> None:
        """Open the window for another model."""
        self.close()
        others = set(threading.enumerate())
        # launch_passive never returns if the user closes the window before it is up.
        opening: Future[Any] = Future()

        def on_key(key: int) -> None:
            if key == _SPACE:
                self._toggle()

        def launch() -> None:
            try:
                opening.set_result(self._launch(model, data, key_callback=on_key))
            except BaseException as error:
                opening.set_exception(error)

        threading.Thread(target=launch, name="viewer", daemon=True).start()
        try:
            self._handle = opening.result(self._opens_within_s)
        except TimeoutError:
            opening.add_done_callback(lambda late: late.result().close())
            self._closed()
            return
        fresh = set(threading.enumerate()) - others
        # launch_passive draws in a thread that is named after its function.
        self._threads = {thread for thread in fresh if "_launch_internal" in thread.name}

    def sync(self) -> None:
        """Show the present data, at most 60 times per wall second; not during a step."""
        if self._handle is None or self._clock() < self._next:
            return
        self._next = self._clock() + _REFRESH_S
        if self._handle.is_running():
            self._handle.sync()
        else:
            self._handle = None
            self._closed()

    def close(self) -> None:
        """Close the window and wait until it is gone.

        GLFW ends with the process, and crashes if a window is still drawn then.
        """
        handle, self._handle = self._handle, None
        if handle is not None:
            handle.close()
        for thread in self._threads:
            thread.join(_CLOSE_S)
        self._threads = set()


def find_launcher(node: NodeContext) -> Callable[..., Any] | None:
    """The function that opens a window, if ``NEUROS_GUI`` asks for one; else ``None``.

    Where no window can open, a warning says why.
    """
    wanted = node.description.environment.get("NEUROS_GUI", os.environ.get("NEUROS_GUI", ""))
    if wanted in ("", "0"):
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # glfw warns of what is reported below
            # launch_passive would wait for ever where GLFW finds no display.
            reason = "" if _has_display() else "there is no display"
            if not reason:
                import mujoco.viewer

                launch: Callable[..., Any] = mujoco.viewer.launch_passive
                return launch
    except ImportError as error:
        reason = str(error)
    node.get_logger().warning(f"NEUROS_GUI is set, but no viewer opens: {reason}")
    return None


def _has_display() -> bool:
    variables = ("DISPLAY", "WAYLAND_DISPLAY")
    if sys.platform.startswith("linux") and not any(map(os.environ.get, variables)):
        return False
    import glfw

    return bool(glfw.init())
