"""Sends messages of the project's own, three in all; the last one says how it found their files."""

import json
import os
import time
from pathlib import Path

from neuros.hooks import neuros_function, neuros_initialise


@neuros_initialise()
def start(node):
    node.set_user_data([])
    deadline_s = time.monotonic() + float(os.environ["WAIT_FOR_LISTENER_S"])
    while time.monotonic() < deadline_s and not node.get_ros_node().count_subscribers("/told"):
        time.sleep(0.05)


@neuros_function(outputs=["joints", "told"])
def send(node):
    sent = node.get_user_data()
    joints, told = node.make_packet("joints"), node.make_packet("told")
    joints.angles = [0.5 * len(sent), 1.5]
    joints.limits[1].upper = 3.0
    joints.names = ["neck", "jaw"]
    told.joints = joints
    if len(sent) == 2:
        description = json.loads(Path(os.environ["DESCRIPTION"]).read_text())
        told.hash = description["type_hashes"][0]["hash_string"]
        assert Path(os.environ["SOURCE"]).exists()
        assert node.resolve_path("@install/demo_msgs/share/demo_msgs/msg/Joints.msg").exists()
        node.shutdown("all sent")
    sent.append(joints)
    return joints, told
