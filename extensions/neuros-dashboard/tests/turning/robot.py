"""An arm that turns, at half of real time."""

from neuros.hooks import neuros_initialise, neuros_tick
from neuros.simulators.mujoco import MuJoCo

WORLD = """
<mujoco>
  <option gravity="0 0 0"/>
  <visual><headlight ambient=".6 .6 .6"/></visual>
  <worldbody>
    <body name="arm"><joint name="turn" axis="0 0 1"/>
      <geom type="box" pos=".5 0 0" size=".5 .1 .1" rgba="1 0 0 1"/>
    </body>
    <geom pos="0 0 -.5" size=".2" rgba="0 1 0 1"/>
    <camera name="above" pos="0 0 4"/>
  </worldbody>
</mujoco>"""


@neuros_initialise()
def start(node):
    sim = MuJoCo(node, WORLD)
    sim.data.joint("turn").qvel[0] = 5
    node.set_user_data(sim)


@neuros_tick(seconds=0.02)
def turn(node):
    node.get_user_data().step_synchronous(5)
