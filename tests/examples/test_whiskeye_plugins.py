"""What WhiskEye's plugins do by themselves: integrate by stamp, plot, write files."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import pytest
from geometry_msgs.msg import PoseStamped, Vector3Stamped

from neuros.testing import PluginHarness

EXAMPLE = Path(__file__).parents[2] / "examples/4_neurorobotics/whiskeye"
PERIOD_NS = 20_000_000
SCATTER_RAD = math.radians(8)  # of what is decoded from the spikes of one window


def turning(rate_rad_s, packets):
    return {
        index * PERIOD_NS: math.remainder(rate_rad_s * index * 0.02, math.tau)
        for index in range(1, packets + 1)
    }


class FakeNetwork:
    """Turns exactly, and keeps what it was asked to simulate."""

    quantum_s = 0.001

    def __init__(self):
        self.heading_rad = 0.0
        self.steps_s = []

    def step(self, rate_rad_s, duration_s):
        self.steps_s.append(duration_s)
        self.heading_rad += rate_rad_s * duration_s
        return self.heading_rad


class TestIntegrator:
    """Lost packets are not lost angle."""

    @pytest.fixture
    def integrate(self, load):
        pytest.importorskip("nest")
        snn = load("snn")

        def final_heading(stamps_ns, rate_rad_s=1.0, bias_rad_s=0.0):
            network = snn.HeadDirectionNetwork(seed=1)
            network.settle()
            integrator = snn.GyroIntegrator(network, bias_rad_s)
            return [integrator.integrate(stamp, rate_rad_s) for stamp in stamps_ns][-1]

        return final_heading

    def test_a_series_with_gaps_ends_where_the_whole_series_ends(self, integrate):
        whole = range(PERIOD_NS, 51 * PERIOD_NS, PERIOD_NS)
        thinned = [*whole[::7], whole[-1]]
        assert integrate(thinned) == pytest.approx(integrate(whole), abs=SCATTER_RAD)

    def test_the_first_packet_may_be_the_one_that_was_lost(self, integrate):
        whole = range(PERIOD_NS, 11 * PERIOD_NS, PERIOD_NS)
        assert integrate(whole[3:]) == pytest.approx(integrate(whole), abs=SCATTER_RAD)

    def test_the_network_simulates_one_window_however_long_the_gap_was(self, load):
        network = FakeNetwork()
        integrator = load("snn").GyroIntegrator(network)
        integrator.integrate(PERIOD_NS, 0.5)
        heading = integrator.integrate(100 * PERIOD_NS + 300_000, 0.5)
        assert network.steps_s == pytest.approx([0.02, 0.02])
        assert heading == pytest.approx(100 * 0.02 * 0.5)

    def test_without_bridges_a_packet_that_was_lost_is_lost_angle(self, load):
        network = FakeNetwork()
        integrator = load("snn").GyroIntegrator(network, bridges=False)
        integrator.integrate(PERIOD_NS, 0.5)
        assert integrator.integrate(100 * PERIOD_NS, 0.5) == pytest.approx(2 * 0.02 * 0.5)
        assert network.steps_s == pytest.approx([0.02, 0.02])

    def test_without_a_gap_the_heading_is_the_networks_own_bit_for_bit(self, load):
        network = FakeNetwork()
        integrator = load("snn").GyroIntegrator(network)
        for packet in range(1, 101):
            assert integrator.integrate(packet * PERIOD_NS, 0.7) == network.heading_rad

    def test_a_packet_that_comes_twice_changes_nothing(self, integrate):
        whole = range(PERIOD_NS, 6 * PERIOD_NS, PERIOD_NS)
        assert integrate([*whole, whole[-1]]) == integrate(whole)

    def test_what_is_left_of_a_quantum_is_not_forgotten(self, integrate):
        odd_ns = 20_300_000
        odd = integrate([odd_ns * index for index in range(1, 51)])
        assert odd == pytest.approx(1.015, abs=math.radians(12))

    def test_a_bias_is_added_to_what_the_gyroscope_says(self, integrate):
        stamps = range(PERIOD_NS, 26 * PERIOD_NS, PERIOD_NS)
        assert integrate(stamps, 1.0, bias_rad_s=0.5) == integrate(stamps, 1.5)


class TestPlot:
    """A picture on the Agg canvas where there is no display."""

    @pytest.fixture
    def plot_module(self, load):
        pytest.importorskip("matplotlib")
        return load("heading_plot")

    def test_it_redraws_at_most_once_in_a_fifth_of_a_second(self, plot_module):
        plot = plot_module.HeadingPlot()
        series = turning(1.0, 10)
        for _ in range(3):
            plot.redraw_if_due(series, series)
        assert not plot.is_window
        assert plot.redraws == 1

    def test_a_slow_consumer_redraws_every_time(self, plot_module):
        plot = plot_module.HeadingPlot(every_time=True)
        for _ in range(3):
            plot.redraw_if_due({}, {})
        assert plot.redraws == 3

    def test_while_it_runs_the_end_of_a_long_run_is_drawn(self, plot_module, monkeypatch):
        monkeypatch.setattr(plot_module, "MOST_DRAWN", 100)
        plot, series = plot_module.HeadingPlot(), turning(1.0, 1000)
        monkeypatch.setattr(plot, "redraw", lambda *drawn: seen.append(drawn))
        seen = []
        plot.redraw_if_due(series, series)
        (drawn,) = seen
        assert [sorted(each) for each in drawn] == [sorted(series)[-100:]] * 2

    def test_the_picture_is_saved(self, plot_module, tmp_path):
        plot = plot_module.HeadingPlot()
        plot.redraw(turning(1.0, 400), turning(1.0, 300))
        plot.save(tmp_path / "heading.png", "a caption")
        assert (tmp_path / "heading.png").read_bytes().startswith(b"\x89PNG")


def test_the_error_is_a_result_of_the_run_and_so_a_column_of_a_sweep(tmp_path):
    pytest.importorskip("matplotlib")
    with PluginHarness.from_project(
        EXAMPLE / "strict.json", "visualiser", run_folder=tmp_path
    ) as visualiser:
        pose, estimate = PoseStamped(), Vector3Stamped()
        pose.pose.orientation.w, estimate.vector.z = 1.0, math.radians(2.0)
        visualiser.send("truth", pose)
        visualiser.send("estimate", estimate)
        visualiser.run()
        visualiser.finalise()
        results = json.loads((visualiser.run_dir / "results.json").read_text())
    assert results["rms_deg"] == results["max_deg"] == pytest.approx(2.0)
    assert results["samples"] == 1


def test_the_csv_keeps_every_bit_and_leaves_lost_values_empty(load, tmp_path):
    pytest.importorskip("matplotlib")
    estimates = {40_000_000: 0.1 + 0.2, PERIOD_NS: -1e-17}
    load("visualiser").write_csv(tmp_path / "h.csv", estimates, {PERIOD_NS: math.pi})
    with (tmp_path / "h.csv").open() as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["stamp_ns", "estimate_rad", "truth_rad"]
    assert [float(value) for value in rows[1]] == [PERIOD_NS, -1e-17, math.pi]
    assert rows[2] == ["40000000", repr(0.1 + 0.2), ""]


VARIANTS = {
    "project": ("robot.json", {("imu", 0), ("truth", None), ("estimate", None)}),
    "strict": ("robot.json", {("imu", 0), ("truth", 0), ("estimate", 0)}),
    "no_discard_limit": ("robot.json", {("imu", None), ("truth", None), ("estimate", None)}),
    "asynchronous": (
        "robot_asynchronous.json",
        {("imu", None), ("truth", None), ("estimate", None)},
    ),
    "tick_20ms": ("0.02", {("imu", None), ("truth", None), ("estimate", None)}),
    "tick_60ms": ("0.06", {("imu", None), ("truth", None), ("estimate", None)}),
    "tick_100ms": ("0.1", {("imu", None), ("truth", None), ("estimate", None)}),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_variants_differ_in_their_robot_and_their_limits_only(variant):
    project = json.loads((EXAMPLE / f"{variant}.json").read_text())
    robot, limits = VARIANTS[variant]
    first = project["nodes"][0]
    assert (first if isinstance(first, str) else first["environment"]["TICK_SECONDS"]) == robot
    found = {
        (connection["destination_input"], connection.get("discard_limit"))
        for connection in project["connections"]
    }
    assert found == limits


@pytest.mark.acceptance
def test_the_floor_runs_the_experiment_without_neuros(load):
    pytest.importorskip("mujoco")
    pytest.importorskip("nest")
    pytest.importorskip("matplotlib")
    found = load("floor").run(duration_s=20.0, rate_rad_s=1.0, seed=1)
    assert found["samples"] == 1000
    assert found["rms_deg"] <= 5
    assert found["max_deg"] <= 12
    assert found["real_time_factor"] > 0


class StandIn:
    """A simulator of which only time and commands count."""

    timestep = 0.002

    def __init__(self):
        self.sim_time = 0.0
        self.rates = []

    def actuate(self, name, value):
        assert name == "pose_theta"
        self.rates.append(value)


def test_rates_change_with_simulated_time_and_only_where_they_vary(load):
    pytest.importorskip("mujoco")
    turning = load("turning_robot")
    sim = StandIn()
    robot = turning.TurningRobot(sim, 3.0, [0.5, -1.0], 1.0)
    for sim.sim_time in (0.0, 0.98, 0.9999, 1.0, 2.5):
        robot.turn()
    assert sim.rates == [0.5, 0.5, -1.0, -1.0, 0.5]
    turning.TurningRobot(sim, 3.0).turn()
    assert len(sim.rates) == 5
