"""Says the namespace that it is in, on all of its outputs."""

from neuros.hooks import neuros_tick


@neuros_tick(seconds=0.02, outputs=["inside", "said", "shared"])
def talk(node):
    packet = node.make_packet("inside")
    packet.data = node.get_ros_node().get_namespace()
    return packet, packet, packet
