"""A rover on a line: it drives as it is told, and has its battery charged when that is low."""

from std_srvs.srv import Trigger

from neuros.hooks import Optional, neuros_function, neuros_initialise, neuros_tick

PERIOD_S = 0.05


class Rover:
    """Where it is (metres), how fast it goes (metres per second), and how often it was charged."""

    def __init__(self, ros_node):
        self.x, self.speed = 0.0, 0.0
        self.charges, self.is_charging = 0, False
        self.charger = ros_node.create_client(Trigger, "charge")


@neuros_initialise(outputs="state")
def begin(node):
    rover = Rover(node.get_ros_node())
    node.set_user_data(rover)

    def stop(request, response):
        rover.speed = 0.0
        response.success = True
        return response

    node.get_ros_node().create_service(Trigger, "stop", stop)
    return say(node, "ready")


@neuros_function(inputs="command")
def obey(node, command):
    most = parameter(node, "max_speed")
    node.get_user_data().speed = max(-most, min(most, command.linear.x))


@neuros_tick(seconds=PERIOD_S, outputs="position")
def drive(node):
    rover = node.get_user_data()
    rover.x += rover.speed * PERIOD_S
    position = node.make_packet("position")
    position.x = rover.x
    return position


@neuros_function(inputs="battery", outputs=Optional("state"))
def watch(node, battery):
    rover = node.get_user_data()
    is_low = battery.percentage < parameter(node, "low_battery")
    if not is_low or rover.is_charging or not rover.charger.service_is_ready():
        return None
    rover.is_charging = True

    def charged(future):
        rover.is_charging = False
        rover.charges += 1
        node.get_logger().info(f"charged at {rover.x:.1f} m: {future.result().message}")
        if rover.charges == parameter(node, "charges"):
            node.shutdown(f"charged {rover.charges} times")

    rover.charger.call_async(Trigger.Request()).add_done_callback(charged)
    return say(node, f"charging, {100 * battery.percentage:.0f} % were left")


def parameter(node, name):
    """It can be changed while the rover drives, as in `ros2 param set /rover max_speed 0.1`."""
    return node.get_ros_node().get_parameter(name).value


def say(node, text):
    state = node.make_packet("state")
    state.data = text
    return state
