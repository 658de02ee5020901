"""A camera that turns; the ball is 40 degrees to its left."""

from neuros.hooks import neuros_function, neuros_initialise
from neuros.simulators.mujoco import MuJoCo

WORLD = """
<mujoco>
  <option timestep="0.005"/>
  <visual><global offwidth="640" offheight="480"/></visual>
  <worldbody>
    <light pos="0 0 4"/>
    <geom type="plane" size="9 9 .1" rgba="0.2 0.3 0.8 1"/>
    <geom name="ball" pos="2.3 1.93 1" size=".3" rgba="1 0 0 1"/>
    <body pos="0 0 1">
      <joint name="neck" axis="0 0 1"/>
      <geom size=".1" mass="1"/>
      <camera name="eye" pos=".2 0 0" xyaxes="0 -1 0 0 0 1" fovy="70"/>
    </body>
  </worldbody>
  <actuator><velocity name="turn" joint="neck" kv="1"/></actuator>
</mujoco>
"""


@neuros_initialise(outputs="image")
def start(node):
    node.set_user_data(MuJoCo(node, WORLD))
    return image_after_a_period(node)


@neuros_function(inputs="turn", outputs="image")
def turn(node, turn):
    node.get_user_data().command("turn", turn)
    return image_after_a_period(node)


def image_after_a_period(node):
    sim = node.get_user_data()
    sim.step_to_next()
    return sim.read("image")
