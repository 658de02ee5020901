"""Makes WhiskEye's film: eyes, what the network predicts, the ring's bump, the robot from outside.

The parts of ``prediction.json`` in one loop, as ``floor.py`` of the example has those of
``project.json``: the robot wanders in its room, its gyroscope has a bias, and vision corrects the
ring. For ``docs/gallery.py``.
"""

from __future__ import annotations

import math
import os
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from neuros.installation.machine import offscreen_opengl

EXAMPLE = Path(__file__).resolve().parents[1] / "examples/4_neurorobotics/whiskeye"
DURATION_S, FRAME_S, PERIOD_S = 8.0, 0.1, 0.02
RATE_RAD_S, SPEED_M_S, BIAS_RAD_S = 1.0, 0.2, 0.1
PEAK_PA = 300.0  # as in prediction.json
EYE, OUTSIDE = (60, 80), (300, 400)  # height and width, pixels
SHOWN_S = 5.0  # in the picture


class Robot:
    """WhiskEye in its room, and the pictures of it."""

    def __init__(self) -> None:
        import mujoco
        from wandering import Wanderer

        self._mujoco = mujoco
        self._model = mujoco.MjModel.from_xml_path(str(EXAMPLE / "room.xml"))
        self._data = mujoco.MjData(self._model)
        self._data.actuator("whiskeye/neck_gmbl").ctrl = math.pi / 2
        self._wanderer = Wanderer(RATE_RAD_S, randomise=False, speed_m_s=SPEED_M_S, seed=7)
        self._eye = mujoco.Renderer(self._model, *EYE)
        self._outside = mujoco.Renderer(self._model, *OUTSIDE)
        self._camera = mujoco.MjvCamera()
        self._camera.azimuth, self._camera.elevation, self._camera.distance = 115, -50, 1.9

    @property
    def heading_rad(self) -> float:
        return float(self._data.joint("whiskeye/pose_theta").qpos[0])

    def advance(self) -> float:
        """Go on for one period; the yaw rate in rad/s."""
        place = (float(self._data.joint(f"whiskeye/pose_{axis}").qpos[0]) for axis in "xy")
        told = self._wanderer.velocities(float(self._data.time), *place)
        for axis, velocity in zip(("x", "y", "theta"), told, strict=True):
            self._data.actuator(f"whiskeye/pose_{axis}").ctrl = velocity
        self._mujoco.mj_step(self._model, self._data, round(PERIOD_S / self._model.opt.timestep))
        return float(self._data.joint("whiskeye/pose_theta").qvel[0])

    def seen(self, camera: str) -> Any:
        """The picture of an eye, ``(60, 80, 3)``."""
        self._eye.update_scene(self._data, f"whiskeye/{camera}")
        return self._eye.render()

    def from_outside(self) -> Any:
        """``(300, 400, 3)``."""
        self._camera.lookat[:] = self._data.body("whiskeye/head").xipos
        self._outside.update_scene(self._data, self._camera)
        return self._outside.render()


class SpikeTee:
    """The reader of a ring, which remembers the spikes since :meth:`taken`."""

    def __init__(self, reader: Any, neurons: int) -> None:
        self._reader, self._counts = reader, np.zeros(neurons)

    def read(self) -> Any:
        spikes = self._reader.read()
        self._counts += spikes.counts(len(self._counts))
        return spikes

    def taken(self) -> Any:
        """Spikes of each neuron."""
        counts, self._counts = self._counts, np.zeros_like(self._counts)
        return counts


class Panels:
    """The figure: outside and bump to the left and right, the eyes and what is predicted above."""

    def __init__(self, neurons: int) -> None:
        self._figure = Figure(figsize=(7.2, 5.2), dpi=80, layout="constrained")
        self._canvas = FigureCanvasAgg(self._figure)
        axes = self._figure.subplot_mosaic(
            [["eyes", "predicted"], ["outside", "bump"]], height_ratios=(0.8, 1.4)
        )
        titles = {
            "eyes": "what its eyes see",
            "predicted": "what the network predicts",
            "outside": "the robot",
        }
        for name, title in titles.items():
            axes[name].set_title(title, fontsize="small")
            axes[name].axis("off")
        self._axes, bump = axes, axes["bump"]
        bump.set_title("spikes of the ring", fontsize="small")
        bump.set(xlim=(-180, 180), ylim=(0, 20), xticks=range(-180, 181, 90))
        bump.set_xlabel("heading (deg)", fontsize="small")
        self._angles_deg = np.degrees(2 * np.pi * (np.arange(neurons) + 0.5) / neurons)
        self._bump = bump.plot([], [], ".", color="C0", markersize=4)[0]
        self._lines = {
            name: bump.axvline(0, color=colour, linewidth=2, linestyle=style, label=name)
            for name, colour, style in (
                ("truth", "0.5", "-"),
                ("vision", "C2", ":"),
                ("ring", "C3", "--"),
            )
        }
        bump.legend(loc="upper right", fontsize="small", ncols=3, frameon=False)

    def drawn(
        self, images: dict[str, Any], counts: Any, zero_rad: float, told_rad: dict[str, float]
    ) -> Any:
        """The figure with these, ``(height, width, 3)``."""
        for name, image in images.items():
            for before in self._axes[name].images:
                before.remove()
            self._axes[name].imshow(image)
        away_deg = (self._angles_deg - math.degrees(zero_rad) + 180) % 360 - 180
        self._bump.set_data(np.concatenate([away_deg] * 2), counts)
        for name, angle_rad in told_rad.items():
            self._lines[name].set_xdata([math.degrees(math.remainder(angle_rad, math.tau))] * 2)
        self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()


def make_film(weights: Path, film: Path, picture: Path) -> None:
    """Write both files, from the weights of a run of ``training.json``."""
    os.environ.setdefault("MUJOCO_GL", offscreen_opengl())
    sys.path.insert(0, str(EXAMPLE))
    from correction import GATE, CorrectedIntegrator
    from head_direction import NEURONS_PER_RING
    from PIL import Image
    from predictive_coding import PredictiveCodingNetwork
    from views import heading_of, picture_of, view_of

    with np.load(weights) as file:
        learnt = dict(file)
    network = PredictiveCodingNetwork.of_weights(learnt)
    rings = CorrectedIntegrator(1, BIAS_RAD_S, PEAK_PA, GATE)
    ring: Any = rings.corrected
    ring._reader = spikes = SpikeTee(ring._reader, 2 * NEURONS_PER_RING)
    robot, panels, frames = Robot(), Panels(NEURONS_PER_RING), []
    for step in range(1, round(DURATION_S / PERIOD_S) + 1):
        rate_rad_s, stamp_ns = robot.advance(), round(step * PERIOD_S * 1e9)
        if step % round(FRAME_S / PERIOD_S):
            rings.integrate(stamp_ns, rate_rad_s)
            continue
        eyes = [robot.seen(camera) for camera in ("cam0", "cam1")]
        packets = [
            SimpleNamespace(data=each.tobytes(), height=EYE[0], width=EYE[1]) for each in eyes
        ]
        codes, ((error, *_),), (predicted,) = network.infer(view_of(*packets)[None])
        vision_rad = heading_of(codes[0])
        rings.vision.see(stamp_ns, vision_rad, error, error * float(learnt["rad_per_error"]))
        ring_rad, _ = rings.integrate(stamp_ns, rate_rad_s)
        shown = picture_of(predicted, *packets)
        images = {"eyes": np.hstack(eyes), "predicted": shown, "outside": robot.from_outside()}
        told_rad = {"truth": robot.heading_rad, "vision": vision_rad, "ring": ring_rad}
        frames.append(panels.drawn(images, spikes.taken(), ring._zero_rad, told_rad))
    pictures = [Image.fromarray(frame) for frame in frames]
    pictures[round(SHOWN_S / FRAME_S)].save(picture)
    pictures[0].save(
        film,
        save_all=True,
        append_images=pictures[1:],
        duration=round(1000 * FRAME_S),
        loop=0,
        quality=50,
        method=4,
    )
