"""Asks where the camera is in the world."""

from neuros.hooks import neuros_function, neuros_initialise
from neuros.tf import TransformBuffer, TransformError


@neuros_initialise()
def start(node):
    node.set_user_data(TransformBuffer())


@neuros_function(inputs="tf_static")
def note_mounts(node, packet):
    node.get_user_data().add(packet, is_static=True)


@neuros_function(inputs="tf")
def look(node, packet):
    buffer = node.get_user_data()
    buffer.add(packet)
    try:
        camera = buffer.lookup("world", "camera").transform.translation
    except TransformError as error:
        node.get_logger().info(f"not yet: {error}")
        return
    base = packet.transforms[0].transform.translation
    node.shutdown(f"the camera is {camera.x - base.x:.2f} m ahead, {camera.z:.2f} m up")
