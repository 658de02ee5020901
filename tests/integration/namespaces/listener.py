"""Fails if it hears another copy; tells by a service how much it has heard of its own."""

import json

from std_srvs.srv import Trigger

from neuros.hooks import neuros_function, neuros_initialise

HEARD = {"inside": 0, "said": 0, "shared": 0}


@neuros_initialise()
def begin(node):
    def tell(request, response):
        response.success, response.message = min(HEARD.values()) >= 5, json.dumps(HEARD)
        return response

    node.get_ros_node().create_service(Trigger, "tell", tell)


def listening(name):
    def listen(node, packet):
        own = node.get_ros_node().get_namespace()
        assert packet.data == own, f"{name}: heard {packet.data} in {own}"
        HEARD[name] += 1

    return neuros_function(inputs=name)(listen)


inside, said, shared = map(listening, HEARD)
