#!/usr/bin/env python3
"""Makes the pictures of the gallery and the tutorial: graphs of the examples, robots in MuJoCo.

::

    .venv/bin/python docs/gallery.py [--weights RUN/trainer/weights.npz]

It needs what the examples need, and Matplotlib; with the weights of a run of WhiskEye's
``training.json`` it makes the film of that example, too. Look at what it has made.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from neuros_analysis.graph_picture import graph_svg
from tutorial_files import files_of, steps

from neuros.installation.machine import offscreen_opengl
from neuros.project.load import load_project

ROOT = Path(__file__).resolve().parents[1]
FIGURES = ROOT / "docs" / "figures"
EXAMPLES = ROOT / "examples"
WIDTH, HEIGHT = 480, 360
# Model, simulated seconds, joints and where they are; azimuth, elevation, distance of the camera.
SCENES = {
    "3_physics_simulation/elevator/elevator.xml": ({"lift": 6.0}, (130, -10, 17.0), (0, 0, 5)),
    "4_neurorobotics/whiskeye/whiskeye.xml": ({}, (140, -20, 1.6), (0.1, 0, 0.4)),
}


def draw_graphs() -> None:
    """One SVG per example."""
    for file in sorted(EXAMPLES.glob("*/*/project.json")):
        project = load_project(file, workspace=ROOT / "workspace").project
        (FIGURES / f"gallery_{file.parent.name}.svg").write_text(graph_svg(project), "utf-8")


def render_scenes() -> None:
    """One PNG per model."""
    os.environ.setdefault("MUJOCO_GL", offscreen_opengl())
    import mujoco

    for name, (joints, view, target) in SCENES.items():
        model = mujoco.MjModel.from_xml_path(str(EXAMPLES / name))
        data = mujoco.MjData(model)
        for joint, position in joints.items():
            data.joint(joint).qpos[0] = position
        render(model, data, view, target, FIGURES / f"gallery_{Path(name).stem}.png")


def render(
    model: Any, data: Any, view: tuple[float, ...], target: tuple[float, ...], file: Path
) -> None:
    """A picture, from azimuth, elevation and distance of the camera to what it looks at."""
    import mujoco
    from matplotlib.image import imsave

    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.azimuth, camera.elevation, camera.distance = view
    camera.lookat[:] = target
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        renderer.update_scene(data, camera)
        imsave(file, renderer.render())


def draw_vehicle() -> None:
    """The tutorial's last robot, and the plot of a run of it."""
    os.environ.setdefault("MUJOCO_GL", offscreen_opengl())
    import mujoco

    with tempfile.TemporaryDirectory() as folder:
        for name, text in files_of(steps()[-1]).items():
            (Path(folder) / name).parent.mkdir(exist_ok=True)
            (Path(folder) / name).write_text(text, "utf-8")
        model = mujoco.MjModel.from_xml_path(f"{folder}/vehicle/vehicle.xml")
        data = mujoco.MjData(model)
        data.mocap_pos[0] = 0.8, 0.35, 0.15
        view, target = (35.0, -30.0, 1.5), (0.35, 0.1, 0.1)
        render(model, data, view, target, FIGURES / "tutorial_vehicle.png")
        launch = [sys.executable, "-m", "neuros.cli", "launch", "vehicle", "-o", "run"]
        subprocess.run([*launch, "--backend", "process"], cwd=folder, check=True)
        shutil.copy(f"{folder}/run/plot/paths.png", FIGURES / "tutorial_paths.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Make the pictures of the gallery.")
    parser.add_argument("--weights", type=Path, help="of WhiskEye's training.json, for its film")
    weights = parser.parse_args().weights
    draw_graphs()
    render_scenes()
    draw_vehicle()
    if weights:
        from whiskeye_film import make_film

        make_film(weights, FIGURES / "whiskeye.webp", FIGURES / "whiskeye_views.png")
