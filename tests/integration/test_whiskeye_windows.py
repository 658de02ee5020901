"""WhiskEye with windows, on a display without a screen: they open, and may be closed early."""

from __future__ import annotations

import pytest
from launching import EXAMPLES, start
from virtual_display import virtual_display

for needed in ("mujoco", "nest", "matplotlib"):
    pytest.importorskip(needed)

PROJECT = EXAMPLES / "4_neurorobotics/whiskeye/asynchronous.json"
TIMEOUT_S = 60.0


@pytest.mark.needs("tkinter")
@pytest.mark.parametrize(
    "backend", ["process", pytest.param("in-process", marks=pytest.mark.acceptance)]
)
def test_the_viewer_and_the_plot_open_and_may_be_closed(backend, tmp_path):
    with virtual_display() as user:
        arguments = ("--backend", backend, "--set", "nodes.robot.environment.DURATION=4")
        environment = {"DISPLAY": user.display, "WAYLAND_DISPLAY": "", "NEUROS_GUI": "1"}
        with start(PROJECT, *arguments, cwd=tmp_path, **environment) as running:
            viewer = user.find("MuJoCo")
            if backend == "process":  # early, while MuJoCo still loads the model into it
                user.close(viewer)
            user.close(user.find("WhiskEye: head direction"))
            if backend != "process":
                user.close(viewer)
            run = running.finish(TIMEOUT_S)
    assert run.exit_code == 0, run.output
    assert (run.run_folder / "visualiser/head_direction.png").stat().st_size > 10_000
    assert run.record["sim_s"] == pytest.approx(4.0, abs=0.1)
    assert not [line for line in run.said("visualiser") if "no window" in line]
