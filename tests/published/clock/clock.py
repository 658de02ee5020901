import datetime
import os

from neuros.hooks import neuros_tick


@neuros_tick(seconds=0.2)
def strike(node):
    sounds = ("ding", "dong")
    count = node.get_user_data() or 0
    node.set_user_data(count + 1)
    now = datetime.datetime.now().strftime(os.environ["FORMAT"])
    node.get_ros_node().get_logger().info(f"{sounds[count % 2]} at {now}")
