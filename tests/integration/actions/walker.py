"""Walks as many steps as it is told to, up to 10, beside a hook that runs without pause."""

import os

from rclpy.action import ActionServer, GoalResponse
from walk_msgs.action import Walk

from neuros.hooks import neuros_function, neuros_initialise

ROUNDS = []
IN_HOOK = []


@neuros_initialise()
def begin(node):
    def judge(goal):
        assert os.environ["WHO"] == "walker"
        return GoalResponse.ACCEPT if goal.steps <= 10 else GoalResponse.REJECT

    def walk(goal_handle):
        assert not IN_HOOK
        assert os.environ["WHO"] == "walker"
        for step in range(goal_handle.request.steps):
            goal_handle.publish_feedback(Walk.Feedback(done=step + 1))
        goal_handle.succeed()
        return Walk.Result(done=goal_handle.request.steps)

    server = ActionServer(node.get_ros_node(), Walk, "walk", walk, goal_callback=judge)
    node.set_user_data(server)


@neuros_function()
def run_freely(node):
    IN_HOOK.append(1)
    ROUNDS.append(1)
    IN_HOOK.clear()
