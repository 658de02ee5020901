"""A simulation that other threads use, too: they pause it, step it, and look at its world.

Whatever steps it, a hook or its own thread, a pause holds it, and exactly the granted timesteps are
made. One thread here stands for the hook, the test for the others.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import pytest
from simulated_node import DEADLINE_S, WORLD, SimulatedNode, imu

from neuros.errors import ModelError
from neuros.simulators.mujoco import MuJoCo


class Hook(threading.Thread):
    """Steps a simulation, in a thread that stands for that of the hooks."""

    def __init__(self, step: Callable[[], object]) -> None:
        super().__init__(daemon=True)
        self._step = step
        self.error: BaseException | None = None
        self.start()

    def run(self) -> None:
        try:
            self._step()
        except BaseException as error:
            self.error = error

    def has_ended(self) -> bool:
        self.join(DEADLINE_S)
        return not self.is_alive() and self.error is None


@pytest.fixture
def node() -> Iterator[SimulatedNode]:
    node = SimulatedNode({"imu": imu("box_imu", 50)})
    yield node
    node.close()


@pytest.fixture
def sim(node: SimulatedNode) -> MuJoCo:
    sim = MuJoCo(node, WORLD)
    sim.share()
    return sim


def never() -> bool:
    return False


class TestSteppedByAHook:
    def test_a_hook_waits_in_its_steps_until_all_are_granted(self, sim: MuJoCo) -> None:
        sim.pause()
        hook = Hook(sim.step_to_next)
        assert sim.step_paused(5, never) == 0
        assert (sim.data.time, hook.is_alive()) == (pytest.approx(0.005), True)
        assert sim.step_paused(15, never) == 0
        assert hook.has_ended()
        assert sim.sim_time == 0.02
        assert sim.read("imu") is not None

    def test_a_resumed_hook_goes_on_to_the_end_of_its_steps(self, sim: MuJoCo) -> None:
        sim.pause()
        hook = Hook(lambda: sim.step_synchronous(12))
        assert sim.step_paused(5, never) == 0
        sim.resume()
        assert hook.has_ended()
        assert sim.sim_time == 0.012

    def test_the_physics_is_that_of_a_simulation_that_is_not_shared(self, sim: MuJoCo) -> None:
        alone = MuJoCo(SimulatedNode(), WORLD)
        alone.step_synchronous(30)
        sim.pause()
        hook = Hook(lambda: [sim.step_to_next(), sim.read("imu"), sim.step_synchronous(10)])
        for count in (1, 7, 22):
            assert sim.step_paused(count, never) == 0
        assert hook.has_ended()
        assert sim.data.qpos.tolist() == alone.data.qpos.tolist()

    def test_steps_that_nobody_makes_are_missing_when_the_pause_ends(self, sim: MuJoCo) -> None:
        sim.pause()
        found: list[int] = []
        asker = Hook(lambda: found.append(sim.step_paused(5, never)))
        while not sim._lock.allowed(5):
            asker.join(0.001)
        sim.resume()
        assert asker.has_ended()
        assert found == [5]

    def test_nor_are_those_of_a_request_that_is_given_up(self, sim: MuJoCo) -> None:
        sim.pause()
        assert sim.step_paused(5, lambda: True) == 5
        sim.resume()
        sim.step_synchronous(3)  # no grant is left over
        assert sim.sim_time == 0.003

    def test_the_end_of_the_run_lets_a_waiting_hook_end(
        self, sim: MuJoCo, node: SimulatedNode
    ) -> None:
        sim.pause()
        hook = Hook(sim.step_to_next)
        node.is_ending = True
        assert hook.has_ended()
        assert sim.sim_time == 0.02

    def test_no_step_is_made_while_another_thread_looks(self, sim: MuJoCo) -> None:
        with sim.paused():
            hook = Hook(lambda: sim.step_synchronous(3))
            hook.join(0.01)
            assert sim.sim_time == 0
        assert hook.has_ended()
        assert sim.sim_time == 0.003

    def test_a_control_of_the_hook_waits_until_nobody_else_uses_the_world(
        self, sim: MuJoCo
    ) -> None:
        with sim.paused():
            hook = Hook(lambda: sim.actuate("turn_speed", 1.5))
            hook.join(0.2)
            assert (hook.is_alive(), sim.data.ctrl[0]) == (True, 0.0)
        assert hook.has_ended()
        assert sim.data.ctrl[0] == 1.5

    def test_one_that_is_not_shared_is_an_error_to_step_in_a_pause(self) -> None:
        alone = MuJoCo(SimulatedNode(), WORLD)
        alone.pause()
        with pytest.raises(ModelError, match=r"resume\(\) it before it is stepped"):
            alone.step_synchronous(1)


class TestThatStepsItself:
    def test_it_makes_exactly_the_granted_steps(self, sim: MuJoCo, node: SimulatedNode) -> None:
        sim.pause()
        sim.run_asynchronous(None)
        for count, steps in ((1, 1), (45, 46), (1, 47)):
            assert sim.step_paused(count, never) == 0
            with sim.paused():
                assert sim._world.steps == steps
        node.wait_until(lambda: len(node.sent) == 2)

    def test_a_blocked_output_holds_the_steps(self, sim: MuJoCo, node: SimulatedNode) -> None:
        node.block(True)
        sim.pause()
        sim.run_asynchronous(None)
        found: list[int] = []
        asker = Hook(lambda: found.append(sim.step_paused(25, never)))
        node.wait_until(lambda: node.is_waiting)
        assert (sim.sim_time, found) == (0.02, [])
        node.block(False)
        assert asker.has_ended()
        assert (sim.sim_time, found) == (0.025, [0])

    def test_it_can_be_reset_in_a_pause(self, sim: MuJoCo) -> None:
        sim.pause()
        sim.run_asynchronous(None)
        sim.step_paused(30, never)
        sim.reset()
        assert sim.sim_time == 0
        assert sim.step_paused(2, never) == 0
        assert sim.sim_time == 0.002
