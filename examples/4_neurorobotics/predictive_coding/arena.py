"""A round arena of coloured panels, and a robot with a camera that turns in its middle."""

from __future__ import annotations

import math

import numpy as np

PANELS = 24
RADIUS_M = 3.0
EYE_M = 0.5

WORLD = """
<mujoco model="arena">
  <option timestep="0.01"/>
  <visual><headlight ambient="0.6 0.6 0.6" diffuse="0.4 0.4 0.4" specular="0 0 0"/></visual>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1" rgba="0.4 0.4 0.4 1"/>
    {panels}
    <body name="robot" pos="0 0 {eye}">
      <joint name="turn" type="hinge" axis="0 0 1" armature="0.5"/>
      <geom type="cylinder" size="0.1 0.1" mass="2" pos="0 0 -0.2"/>
      <site name="head"/>
      <camera name="eye" xyaxes="0 -1 0 0 0 1" fovy="60"/>
    </body>
  </worldbody>
  <actuator><velocity name="turn" joint="turn" kv="10"/></actuator>
</mujoco>
"""
PANEL = (
    '<geom type="box" pos="{x:.4f} {y:.4f} {half:.4f}" euler="0 0 {degrees:.4f}" '
    'size="0.05 {width:.4f} {half:.4f}" rgba="{red:.3f} {green:.3f} {blue:.3f} 1" '
    'contype="0" conaffinity="0"/>'
)


def arena(seed: int) -> str:
    """MJCF of an arena whose panels have colours and heights (0.6 to 2.4 m) drawn from a seed."""
    rng = np.random.default_rng(seed)
    panels = []
    for angle in 2.0 * math.pi * np.arange(PANELS) / PANELS:
        red, green, blue = rng.uniform(0.05, 1.0, 3)
        panels.append(
            PANEL.format(
                x=RADIUS_M * math.cos(angle),
                y=RADIUS_M * math.sin(angle),
                degrees=math.degrees(angle),
                half=rng.uniform(0.3, 1.2),
                width=0.9 * math.pi * RADIUS_M / PANELS,
                red=red,
                green=green,
                blue=blue,
            )
        )
    return WORLD.format(panels="\n    ".join(panels), eye=EYE_M)
