"""Holds the lamp, and rewards the vehicle for turning towards it.

An episode begins with the lamp to the left or to the right of where the vehicle looks.
"""

import math
import os

import numpy as np

from neuros.hooks import neuros_function, neuros_initialise

STEPS = 75  # of 20 ms, in an episode
DISTANCE_M = 3.0
START_RAD = math.radians(30), math.radians(120)
TOWARDS_RAD = math.radians(45)
FULL_RAD = 0.02  # turned in one step, for a reward of 1
LAST = 10


class Teacher:
    def __init__(self, seed, sign):
        self.random = np.random.default_rng(seed)
        self.sign = sign  # 1 rewards, -1 inverts the reward, 0 gives none
        self.lamp = np.zeros(2)
        self.step = 0
        self.angle = 0.0
        self.towards = []  # whether the vehicle looked towards the lamp at the end of each episode

    def bearing(self, pose):
        """The angle from where the vehicle looks to the lamp, -pi to pi."""
        x, y, heading = pose
        angle = math.atan2(self.lamp[1] - y, self.lamp[0] - x) - heading
        return (angle + math.pi) % (2 * math.pi) - math.pi

    def place_lamp(self, pose):
        x, y, heading = pose
        angle = heading + self.random.choice([-1, 1]) * self.random.uniform(*START_RAD)
        self.lamp = np.array([x, y]) + DISTANCE_M * np.array([math.cos(angle), math.sin(angle)])

    def reward(self, pose):
        """-1 to 1: how far the vehicle has turned towards the lamp in this step."""
        angle = abs(self.bearing(pose))
        reward = np.clip((self.angle - angle) / FULL_RAD, -1.0, 1.0)
        self.angle = angle
        return self.sign * reward


@neuros_initialise()
def start(node):
    node.set_user_data(Teacher(int(os.environ["SEED"]), float(os.environ["REWARD"])))


@neuros_function(inputs="pose", outputs=["reward", "lamp"])
def teach(node, pose):
    teacher = node.get_user_data()
    reward = teacher.reward(pose)
    if teacher.step % STEPS == 0:
        if teacher.step:
            report(node, teacher)
        teacher.place_lamp(pose)
        teacher.angle = abs(teacher.bearing(pose))
        reward = 0.0
    teacher.step += 1
    return np.array([reward]), teacher.lamp


def report(node, teacher):
    teacher.towards.append(teacher.angle < TOWARDS_RAD)
    episodes = len(teacher.towards)
    node.set_result("towards", teacher.towards)
    if episodes % LAST == 0:
        share = 100 * np.mean(teacher.towards[-LAST:])
        node.get_logger().info(f"episode {episodes}: {share:.0f} % of the last {LAST} to the lamp")
    if episodes == int(os.environ["EPISODES"]):
        node.shutdown(f"{episodes} episodes")
