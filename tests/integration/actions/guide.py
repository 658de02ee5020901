"""Has the walker walk, too far first."""

from rclpy.action import ActionClient
from walk_msgs.action import Walk

from neuros.hooks import neuros_initialise

FEEDBACK = []


@neuros_initialise()
def begin(node):
    ros = node.get_ros_node()
    client = ActionClient(ros, Walk, "walk")
    node.set_user_data(client)

    async def guide():
        if not client.server_is_ready():
            return
        timer.cancel()
        refused = await client.send_goal_async(Walk.Goal(steps=11))
        goal = await client.send_goal_async(
            Walk.Goal(steps=3), feedback_callback=lambda m: FEEDBACK.append(m.feedback.done)
        )
        answer = await goal.get_result_async()
        node.shutdown(
            f"refused: {not refused.accepted}, feedback {FEEDBACK}, done {answer.result.done}"
        )

    timer = ros.create_timer(0.05, guide)
