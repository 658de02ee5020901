"""Three boxes before a camera: red, green and blue, from left to right."""

from neuros.hooks import neuros_initialise
from neuros.simulators.mujoco import MuJoCo

SCENE = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <camera name="eye" pos="0 -3 0" xyaxes="1 0 0 0 0 1" fovy="60"/>
    <geom type="box" size=".4 .4 .4" pos="-1.2 0 0" rgba="1 0 0 1"/>
    <geom type="box" size=".4 .4 .4" pos="0 0 0" rgba="0 1 0 1"/>
    <geom type="box" size=".4 .4 .4" pos="1.2 0 0" rgba="0 0 1 1"/>
  </worldbody>
</mujoco>
"""


@neuros_initialise()
def begin(node):
    sim = MuJoCo(node, SCENE)
    node.set_user_data(sim)
    sim.run_asynchronous(1.0)
