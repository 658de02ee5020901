"""MuJoCo's native viewer for real, on a display without a screen."""

from __future__ import annotations

import os
import selectors
import subprocess
import sys
import time
from pathlib import Path

import pytest
from simulated_node import WORLD, SimulatedNode
from virtual_display import DEADLINE_S, virtual_display

from neuros.simulators.mujoco import MuJoCo

PROGRAM = Path(__file__).parents[1] / "support/viewed_simulation.py"


class Simulation:
    """The program in a process of its own: OpenGL, GLFW and their threads end with it."""

    def __init__(self, display: str) -> None:
        environment = {**os.environ, "DISPLAY": display}
        environment.pop("WAYLAND_DISPLAY", None)
        self._process = subprocess.Popen(
            [sys.executable, str(PROGRAM)],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        self._output = b""

    def wait_for(self, line: str) -> None:
        """Until it prints this line."""
        assert self._process.stdout is not None
        end_s = time.monotonic() + DEADLINE_S
        with selectors.DefaultSelector() as selector:
            selector.register(self._process.stdout, selectors.EVENT_READ)
            while True:
                *whole, self._output = self._output.split(b"\n")
                if line.encode() in whole:
                    return
                left_s = max(0.0, end_s - time.monotonic())
                assert selector.select(left_s), f"'{line}' was not printed"
                new = os.read(self._process.stdout.fileno(), 4096)
                assert new, f"ended without '{line}': {self._output.decode()}"
                self._output += new

    def spawn(self, name: str) -> None:
        """Have it add an entity to its world."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{name}\n".encode())
        self._process.stdin.flush()

    def end(self) -> int:
        """Have it close the simulation; its exit code."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self.wait_for("closed")
        return self._process.wait(DEADLINE_S)

    def __enter__(self) -> Simulation:
        return self

    def __exit__(self, *_: object) -> None:
        with self._process:
            self._process.kill()


def test_it_opens_pauses_resumes_and_closes():
    with virtual_display() as user, Simulation(user.display) as simulation:
        window = user.find("MuJoCo")
        simulation.wait_for("moving")
        user.press(window, "space")
        simulation.wait_for("standing")
        user.press(window, "space")
        simulation.wait_for("moving")
        assert simulation.end() == 0


def test_a_simulation_that_was_paused_goes_on_when_its_window_is_closed():
    with virtual_display() as user, Simulation(user.display) as simulation:
        window = user.find("MuJoCo")
        simulation.wait_for("moving")
        user.press(window, "space")
        simulation.wait_for("standing")
        user.close(window)
        simulation.wait_for("moving")
        assert simulation.end() == 0


def test_another_world_is_shown_in_another_window_of_which_nothing_is_left_at_the_end():
    with virtual_display() as user, Simulation(user.display) as simulation:
        first = user.find("MuJoCo")
        simulation.wait_for("moving")
        simulation.spawn("wall")
        simulation.wait_for("spawned wall")
        second = user.find("MuJoCo")
        assert second != first
        assert simulation.end() == 0  # and not by a signal: GLFW and its threads end in order


def test_without_a_display_there_is_one_warning_and_no_window(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    node = SimulatedNode(environment={"NEUROS_GUI": "1"})
    sim = MuJoCo(node, WORLD)
    sim.step_synchronous()
    node.close()
    assert node.log.warnings == ["NEUROS_GUI is set, but no viewer opens: there is no display"]


@pytest.mark.parametrize("value", ["", "0"])
def test_a_display_alone_opens_no_viewer(monkeypatch, value):
    monkeypatch.setenv("DISPLAY", ":77")
    node = SimulatedNode(environment={"NEUROS_GUI": value})
    MuJoCo(node, WORLD)
    assert node.log.warnings == []
