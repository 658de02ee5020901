"""The corrected network in step, which learns the bias of its gyroscope and tells it."""

from correcting_snn import estimates, start_integrator

from neuros.hooks import neuros_finalise, neuros_function, neuros_initialise


@neuros_initialise(outputs="estimate")
def start(node):
    start_integrator(node)
    return node.make_packet("estimate")  # heading 0, before the first packet of the IMU


@neuros_function(
    inputs=["imu", "odom_correction"], outputs=["estimate", "uncorrected", "activity", "bias"]
)
def integrate(node, imu, odom_correction):
    bias = node.make_packet("bias")
    estimate, uncorrected, activity = estimates(node, imu, odom_correction)
    bias.header, bias.vector.z = estimate.header, node.get_user_data().learnt_rad_s
    return estimate, uncorrected, activity, bias


@neuros_finalise()
def report(node):
    integrator = node.get_user_data()
    if integrator is not None:  # else it ended before the start
        node.set_result("learnt_bias_rad_s", integrator.learnt_rad_s)
        node.get_logger().info(f"learnt bias of the gyroscope: {integrator.learnt_rad_s:.4f} rad/s")
