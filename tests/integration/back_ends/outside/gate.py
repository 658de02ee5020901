"""Answers on a topic, serves a service and a timer of its own, and ends when it is told to."""

from std_srvs.srv import SetBool, Trigger

from neuros.hooks import neuros_function, neuros_initialise


@neuros_initialise()
def begin(node):
    counts = {"timer": 0, "asked": 0}
    node.set_user_data(counts)
    ros = node.get_ros_node()

    def tick():
        counts["timer"] += 1

    def tell(request, response):
        response.success = counts["timer"] > 0
        response.message = str(counts["asked"])
        return response

    def stop(request, response):
        if request.data:
            node.shutdown("told to by a service")
        response.success = request.data
        return response

    ros.create_timer(0.01, tick)
    ros.create_service(Trigger, "/gate/tell", tell)
    ros.create_service(SetBool, "/gate/stop", stop)


@neuros_function(inputs="asked", outputs=["answered", "passed"])
def answer(node, asked):
    node.get_user_data()["asked"] += 1
    answered = node.make_packet("answered")
    answered.data = 2 * asked.data
    return answered, asked
