from neuros.hooks import neuros_initialise, neuros_function

PERIOD = 0.02


@neuros_initialise()
def initialise(node):
    node.set_user_data(0.0)


@neuros_function(inputs="imu", outputs="heading")
def integrate(node, imu):
    node.set_user_data(node.get_user_data() + imu.angular_velocity.z * PERIOD)
    heading = node.make_packet("heading")
    heading.data = node.get_user_data()
    return heading
