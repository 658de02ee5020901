"""The simulation steps itself: packets, blocking, pauses and the wall clock."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import pytest
from simulated_node import DEADLINE_S, WORLD, SimulatedNode, imu, stamp_ns

from neuros.errors import ModelError
from neuros.simulators.mujoco import MuJoCo
from neuros.simulators.mujoco.simulator import Viewer
from neuros.simulators.mujoco.timing import Pacer, StepLock

CLOCK = ("rosgraph_msgs/msg/Clock", {"sensor": "clock", "rate": 25})


class WallClock:
    """Time passes only in waits; a stall is a jump."""

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.waits: list[float] = []

    def __call__(self) -> float:
        return self.now_s

    def wait(self, seconds: float) -> None:
        self.waits.append(seconds)
        self.now_s += seconds


@pytest.fixture
def node():
    node = SimulatedNode({"imu": imu("turn_imu"), "clock": CLOCK})
    yield node
    node.close()
    assert not any("simulation" in thread.name for thread in threading.enumerate())
    assert node.failures == []


def test_packets_of_one_step_leave_together_and_in_order(node):
    MuJoCo(node, WORLD).run_asynchronous(None)
    node.wait_until(lambda: len(node.sent) >= 6)
    assert [sorted(packets) for packets in node.sent[:4]] == [
        ["imu"],
        ["clock", "imu"],
        ["imu"],
        ["clock", "imu"],
    ]
    stamps = [stamp_ns(packets["imu"]) for packets in node.sent[:6]]
    assert stamps == [k * 20_000_000 for k in range(1, 7)]


def test_the_packets_are_those_of_the_synchronous_simulation(node):
    reference = MuJoCo(SimulatedNode({"imu": imu("turn_imu")}), WORLD)
    reference.actuate("turn_speed", 2.0)
    sim = MuJoCo(node, WORLD)
    sim.actuate("turn_speed", 2.0)
    sim.run_asynchronous(None)
    node.wait_until(lambda: len(node.sent) >= 20)
    for packets in node.sent[:20]:
        reference.step_to_next()
        assert str(packets["imu"]) == str(reference.read("imu"))


def test_where_the_node_drives_the_world_there_is_no_thread_and_the_packets_are_the_same(node):
    reference = MuJoCo(SimulatedNode({"imu": imu("turn_imu"), "clock": CLOCK}), WORLD)
    node.is_driving = True
    sim = MuJoCo(node, WORLD)
    sim.run_asynchronous(1.0)
    assert sim.is_running
    assert not any("simulation" in thread.name for thread in threading.enumerate())
    found = []
    while len(found) < 4:
        if packets := node.advance():
            found.append(packets)
    for packets in found:
        reference.step_to_next()
        for name in ("imu", "clock"):
            assert str(packets.get(name)) == str(reference.read(name))
    sim.stop()
    assert not sim.is_running


def test_a_world_that_the_node_drives_goes_on_to_the_step_at_which_a_hook_saw_it(node):
    """As in a replay: a command takes effect at the step of the run, and firings are not lost."""
    seen = iter([3, 14, 14])
    node.is_driving = True
    sim, reference = MuJoCo(node, WORLD), MuJoCo(SimulatedNode({"imu": imu("turn_imu")}), WORLD)
    sim.run_asynchronous(1.0)
    node.reading = lambda steps: next(seen, steps)
    sim.actuate("turn_speed", 2.0)
    assert sim.sim_time == pytest.approx(14 * sim.timestep)
    with sim.paused():
        assert sim.data.time == pytest.approx(14 * sim.timestep)
    reference.step_synchronous(3)
    reference.actuate("turn_speed", 2.0)
    for _ in range(2):
        reference.step_to_next()
        while not (packets := node.advance()):
            pass
        assert str(packets["imu"]) == str(reference.read("imu"))


def test_it_stands_still_until_every_node_is_ready_and_then_begins_at_time_zero(node):
    node.is_active = False
    sim = MuJoCo(node, WORLD)
    sim.run_asynchronous(None)
    node.wait_until(lambda: node.is_waiting)
    assert (sim.sim_time, node.sent) == (0.0, [])
    node.is_active = True
    node.wait_until(lambda: len(node.sent) >= 1)
    assert stamp_ns(node.sent[0]["imu"]) == 20_000_000


def test_it_can_be_stopped_before_every_node_is_ready(node):
    node.is_active = False
    sim = MuJoCo(node, WORLD)
    sim.run_asynchronous(None)
    node.wait_until(lambda: node.is_waiting)
    sim.stop()
    assert (sim.is_running, node.sent) == (False, [])


def test_stepping_waits_while_a_connection_is_blocked(node):
    sim = MuJoCo(node, WORLD)
    node.block(True)
    sim.run_asynchronous(None)
    node.wait_until(lambda: node.is_waiting)
    assert sim.sim_time == 0.02
    with sim.paused():  # the plugin gets at the data meanwhile
        assert sim.data.time == pytest.approx(0.02)
    node.block(False)
    node.wait_until(lambda: len(node.sent) >= 2)


def test_a_blocked_simulation_ends_at_once(node):
    node.block(True)
    sim = MuJoCo(node, WORLD)
    sim.run_asynchronous(None)
    node.wait_until(lambda: node.is_waiting)
    sim.stop()
    assert not sim.is_running
    assert node.sent == []


def test_inside_paused_nothing_moves(node):
    sim = MuJoCo(node, WORLD)
    sim.run_asynchronous(None)
    node.wait_until(lambda: len(node.sent) >= 1)
    with sim.paused(), sim.paused():
        before = sim.sim_time
        sim.data.joint("turn").qvel[0] = 3.0
        sim.actuate("turn_speed", 3.0)
        assert sim.sim_time == before
        # Whatever was ready to leave has left; from here on nothing new can become due.
        count = len(node.sent) + 1
    node.wait_until(lambda: len(node.sent) >= count + 2)
    assert node.sent[-1]["imu"].angular_velocity.y == pytest.approx(3.0, abs=0.1)


def test_pause_and_resume(node):
    sim = MuJoCo(node, WORLD)
    sim.pause()
    sim.run_asynchronous(None)
    assert sim.is_running
    with sim.paused():
        assert sim.sim_time == 0
    sim.resume()
    node.wait_until(lambda: len(node.sent) >= 1)


def test_stop_ends_a_paused_simulation(node):
    sim = MuJoCo(node, WORLD)
    sim.pause()
    sim.run_asynchronous(None)
    sim.stop()
    assert not sim.is_running


def test_after_stop_the_plugin_steps_again(node):
    sim = MuJoCo(node, WORLD)
    sim.run_asynchronous(None)
    with pytest.raises(ModelError, match=r"stop\(\) it first"):
        sim.step_synchronous()
    with pytest.raises(ModelError, match=r"stop\(\) it first"):
        sim.read("imu")
    node.wait_until(lambda: len(node.sent) >= 1)
    sim.stop()
    for output in ("imu", "clock"):
        sim.read(output)
    sim.step_synchronous()


def test_packets_that_were_left_unread_leave_first(node):
    sim = MuJoCo(node, WORLD)
    sim.step_to_next()
    sim.run_asynchronous(None)
    node.wait_until(lambda: len(node.sent) >= 2)
    assert [stamp_ns(packets["imu"]) for packets in node.sent[:2]] == [20_000_000, 40_000_000]


def test_reset_while_it_runs(node):
    sim = MuJoCo(node, WORLD)
    sim.run_asynchronous(None)
    node.wait_until(lambda: len(node.sent) >= 3)
    with sim.paused():
        sim.reset()
        count = len(node.sent)
    node.wait_until(lambda: len(node.sent) >= count + 3)
    stamps = [stamp_ns(packets["imu"]) for packets in node.sent[count:]]
    assert 20_000_000 in stamps[:2]  # one packet of before may have been on its way


@pytest.mark.needs("OpenGL")
def test_cameras_render_in_the_stepping_thread_and_afterwards_in_the_plugins():
    camera = {"sensor": "camera", "element": "eye", "rate": 100, "width": 16, "height": 12}
    node = SimulatedNode({"image": ("sensor_msgs/msg/Image", camera)})
    sim = MuJoCo(node, WORLD)
    sim.step_to_next()
    here = sim.read("image")
    sim.run_asynchronous(None)
    node.wait_until(lambda: len(node.sent) >= 2 or bool(node.failures))
    sim.stop()
    sim.read("image")
    sim.step_to_next()
    images = [here, *(packets["image"] for packets in node.sent), sim.read("image")]
    node.close()
    assert node.failures == []
    assert all(any(image.data) for image in images)


@pytest.mark.needs("OpenGL")
def test_an_entity_that_spawns_while_it_runs_is_seen(tmp_path):
    (tmp_path / "wall.xml").write_text(
        """<mujoco model="wall"><worldbody><body name="wall">
        <geom type="box" size="5 .1 5" rgba="0 1 0 1"/></body></worldbody></mujoco>"""
    )
    camera = {"sensor": "camera", "element": "eye", "rate": 100, "width": 16, "height": 12}
    node = SimulatedNode({"image": ("sensor_msgs/msg/Image", camera)}, folder=tmp_path)
    sim = MuJoCo(node, WORLD)
    sim.run_asynchronous(None)
    node.wait_until(lambda: len(node.sent) >= 1 or bool(node.failures))
    sim.spawn_entity("wall.xml", (0, 1, 1), "wall")
    seen = len(node.sent) + 2  # one image of before may be on its way
    node.wait_until(lambda: len(node.sent) >= seen or bool(node.failures))
    node.close()
    assert node.failures == []
    before, after = (node.sent[at]["image"].data for at in (0, seen - 1))
    assert sum(after[1::3]) > sum(before[1::3]) + 1000


def test_an_error_in_the_thread_fails_the_node(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warning in the current folder
    node = SimulatedNode({"clock": CLOCK})
    sim = MuJoCo(node, WORLD)
    sim.data.qvel[:] = 1e300
    sim.run_asynchronous(None)
    node.wait_until(lambda: bool(node.failures))
    assert isinstance(node.failures[0], ModelError)
    sim.stop()


def test_stepping_ends_with_the_time_of_the_run_though_nothing_is_sent():
    node = SimulatedNode({})
    node.ends_at_s = 1.0
    sim = MuJoCo(node, WORLD)
    sim.run_asynchronous(None)
    node.wait_until(lambda: not sim.is_running)
    assert sim.sim_time == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("factor", [0, -1, float("inf"), float("nan")])
def test_a_real_time_factor_is_positive(factor, node):
    with pytest.raises(ModelError, match="real_time_factor is positive or None"):
        MuJoCo(node, WORLD).run_asynchronous(factor)


# ------------------------------------------------------------------------------ the wall clock


@pytest.mark.parametrize("factor", [0.5, 1.0, 4.0])
def test_simulated_time_follows_the_wall_clock(node, factor):
    clock = WallClock()
    sim = MuJoCo(node, WORLD, clock=clock, wait=clock.wait)
    sim.run_asynchronous(factor)
    node.wait_until(lambda: len(node.sent) >= 100)
    sim.stop()
    assert (clock.now_s - 1000.0) * factor == pytest.approx(sim.sim_time, abs=1e-6)
    assert max(clock.waits) <= 0.0051  # short bouts: commands are taken up soon


def test_late_waits_do_not_add_up():
    clock = WallClock()
    pacer = Pacer(1.0, clock, lambda s: clock.wait(s + 0.003))  # every wait is 3 ms late
    pacer.start(0.0)
    for step in range(1, 1001):
        pacer.hold(step * 0.01)
    assert clock.now_s - 1000.0 == pytest.approx(10.0, abs=0.0031)


def test_a_short_stall_is_caught_up_and_a_long_one_is_not():
    clock = WallClock()
    pacer = Pacer(1.0, clock, clock.wait, max_lag_s=0.5)
    pacer.start(0.0)
    clock.now_s += 0.3
    pacer.hold(0.1)
    assert clock.waits == []
    pacer.hold(0.4)
    assert clock.waits == [pytest.approx(0.1)]
    clock.now_s += 60.0
    pacer.hold(0.5)
    pacer.hold(0.9)
    assert len(clock.waits) == 1  # catches up with half a second ...
    pacer.hold(1.1)
    assert clock.waits[1:] == [pytest.approx(0.1)]  # ... and not with a minute


def test_a_pause_is_not_caught_up():
    clock = WallClock()
    pacer = Pacer(1.0, clock, clock.wait)
    pacer.start(0.0)
    clock.now_s += 60.0
    pacer.restart()
    pacer.hold(0.005)
    pacer.hold(0.010)
    assert clock.waits == [pytest.approx(0.005)]


def test_as_fast_as_possible_never_waits():
    clock = WallClock()
    pacer = Pacer(None, clock, clock.wait)
    pacer.start(0.0)
    pacer.hold(1000.0)
    assert clock.waits == []


def test_visitors_go_before_the_next_bout():
    """A plain lock would let the stepping thread in again and again."""
    lock, entered, left = StepLock(), threading.Event(), threading.Event()
    assert lock.enter(lambda: False)

    def visit() -> None:
        with lock.visit():
            entered.set()
            assert left.wait(DEADLINE_S)

    visitor = threading.Thread(target=visit)
    visitor.start()
    assert not entered.is_set()
    while not lock._visitors:
        visitor.join(0.001)
    lock.leave()
    assert entered.wait(DEADLINE_S)
    is_over = threading.Event()
    assert lock.enter(lambda: entered.is_set() and not left.is_set()) is False
    left.set()
    assert lock.enter(is_over.is_set)
    lock.leave()
    visitor.join(DEADLINE_S)


# ---------------------------------------------------------------------------------- the viewer


class Window:
    """Looks like the handle of ``mujoco.viewer.launch_passive``; there is no display in a test."""

    def __init__(self, model, data, *, key_callback):
        self.press, self.is_open, self.syncs = key_callback, True, 0

    def is_running(self):
        return self.is_open

    def sync(self):
        self.syncs += 1

    def close(self):
        self.is_open = False


@pytest.fixture
def window():
    clock, events, windows = WallClock(), [], []

    def launch(*arguments, **keywords):
        windows.append(Window(*arguments, **keywords))
        return windows[-1]

    viewer = Viewer(
        launch,
        None,
        None,
        toggle=lambda: events.append("toggle"),
        closed=lambda: events.append("closed"),
        clock=clock,
    )
    return viewer, windows, events, clock


def test_the_space_bar_toggles_the_pause(window):
    _, windows, events, _ = window
    windows[0].press(ord("A"))
    windows[0].press(ord(" "))
    assert events == ["toggle"]


def test_the_window_is_refreshed_at_most_sixty_times_a_second(window):
    viewer, windows, _, clock = window
    for _ in range(1000):
        viewer.sync()
        clock.now_s += 0.001
    assert 55 <= windows[0].syncs <= 60


def test_a_window_that_the_user_closes_lets_the_simulation_go_on(window):
    viewer, windows, events, clock = window
    windows[0].close()
    for _ in range(3):
        clock.now_s += 1
        viewer.sync()
    assert events == ["closed"]
    assert not viewer.is_open


def test_a_window_that_is_closed_while_it_opens_holds_up_nothing():
    events, loaded, ended = [], threading.Event(), threading.Event()

    def launch(*_, **__):
        assert loaded.wait(DEADLINE_S)
        return SimpleNamespace(close=ended.set)

    viewer = Viewer(
        launch,
        None,
        None,
        toggle=lambda: None,
        closed=lambda: events.append("closed"),
        opens_within_s=0.05,
    )
    assert events == ["closed"]
    assert not viewer.is_open
    viewer.sync()
    viewer.close()
    loaded.set()
    assert ended.wait(DEADLINE_S)


def test_another_model_gets_another_window(window):
    viewer, windows, _, _ = window
    viewer.show(None, None)
    assert [each.is_open for each in windows] == [False, True]
    viewer.close()
    assert not windows[1].is_open


def test_a_pause_in_the_viewer_holds_the_plugins_steps_until_the_user_resumes(monkeypatch):
    class ImpatientWindow(Window):
        def sync(self):
            super().sync()
            if self.syncs == 2:  # the first refresh within the pause
                self.press(ord(" "))

    windows = []

    def launch(*arguments, **keywords):
        windows.append(ImpatientWindow(*arguments, **keywords))
        return windows[-1]

    monkeypatch.setattr("neuros.simulators.mujoco.simulator.find_launcher", lambda node: launch)
    node = SimulatedNode(environment={"NEUROS_GUI": "1"})
    sim = MuJoCo(node, WORLD)
    sim.step_synchronous()
    windows[0].press(ord(" "))
    sim.step_synchronous()
    assert windows[0].syncs >= 2
    assert sim.sim_time == 0.002
    node.close()
    assert not windows[0].is_open
