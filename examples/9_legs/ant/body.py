"""The ant of Gymnasium in MuJoCo, with feet that feel the ground. It waits for each command."""

import math
import os
from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np

from neuros.hooks import neuros_function, neuros_initialise
from neuros.simulators.mujoco import MuJoCo

# Legs 1 to 4: front left, hind left, hind right, front right.
BACKWARDS = np.array([1, 1, -1, -1])  # the sign of a hip's angle that moves the foot backwards
DOWN = np.array([1, -1, -1, 1])  # the sign of an ankle's angle that presses the foot down
HIP_RAD = math.radians(30)
ANKLE_RAD = math.radians(50), math.radians(20)  # its middle, and how far it moves from there
STIFFNESS, DAMPING = 30.0, 3.0  # N m/rad and N m s/rad, of each joint
STEPS = 2  # of 10 ms each, between two packets
EDGE_M = 0.2  # half an edge of a slab of rough ground


def ant_file():
    """The path of the model in the package Gymnasium, which this does not import."""
    package = find_spec("gymnasium")
    if package is None:
        raise ModuleNotFoundError(
            "the model of the ant is in Gymnasium: pip install 'gymnasium>=1.0,<2'"
        )
    return Path(package.origin).parent / "envs/mujoco/assets/ant.xml"


def ant(rough_m, seed):
    """The model with servos in the place of motors, a touch sensor at each foot, and its ground.

    The ground is flat, or strewn with slabs of up to this height.
    """
    spec = mujoco.MjSpec.from_file(str(ant_file()))
    for motor in list(spec.actuators):
        spec.delete(motor)
    for leg in range(1, 5):
        for name in (f"hip_{leg}", f"ankle_{leg}"):
            servo = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            servo.set_to_position(kp=STIFFNESS, kv=DAMPING)
        shank = spec.joint(f"ankle_{leg}").parent
        foot = shank.add_site(name=f"foot_{leg}", pos=shank.geoms[0].fromto[3:], size=[0.1] * 3)
        spec.add_sensor(
            name=f"touch_{leg}",
            type=mujoco.mjtSensor.mjSENS_TOUCH,
            objtype=mujoco.mjtObj.mjOBJ_SITE,
            objname=foot.name,
        )
    random = np.random.default_rng(seed)
    for x, y in random.uniform((-2.0, -4.0), (10.0, 4.0), (400, 2)) if rough_m else ():
        if math.hypot(x, y) > 1.0:  # the ant begins on flat ground
            half = [EDGE_M, EDGE_M, random.uniform(0.0, rough_m)]
            box = mujoco.mjtGeom.mjGEOM_BOX
            spec.worldbody.add_geom(type=box, pos=[x, y, 0.0], size=half, conaffinity=1)
    return spec


class Body:
    def __init__(self, simulator, seconds):
        self.simulator = simulator
        self.seconds = seconds
        data = simulator.data
        data.qpos[7:] = np.ravel([np.zeros(4), DOWN * ANKLE_RAD[0]], order="F")
        mujoco.mj_forward(simulator.model, data)

    @property
    def position(self):
        """Where the torso is: x, y and z (m)."""
        return self.simulator.data.qpos[:3].copy()

    def touch(self):
        """Whether each foot is on the ground, 0 or 1."""
        return (self.simulator.data.sensordata > 0).astype(float)

    def move(self, power):
        """Follow what the network wants of each leg, -1 (swing, forwards) to 1 (stance)."""
        control = self.simulator.data.ctrl
        control[0::2] = BACKWARDS * HIP_RAD * power
        control[1::2] = DOWN * (ANKLE_RAD[0] + ANKLE_RAD[1] * power)
        self.simulator.step_synchronous(STEPS)


@neuros_initialise(outputs=["touch", "position"])
def start(node):
    spec = ant(float(os.environ["ROUGH_M"]), int(os.environ["SEED"]))
    simulator = MuJoCo(node, spec)
    body = Body(simulator, float(os.environ["SECONDS"]))
    node.set_user_data(body)
    return body.touch(), body.position


@neuros_function(inputs="power", outputs=["touch", "position"])
def walk(node, power):
    body = node.get_user_data()
    body.move(power)
    if body.simulator.sim_time >= body.seconds:
        node.shutdown(f"{body.position[0]:.2f} m forwards in {body.seconds:g} s")
    return body.touch(), body.position
