"""The same network, with one correction for every packet of the IMU: it waits for both."""

from correcting_snn import estimates, start_integrator

from neuros.hooks import neuros_function, neuros_initialise


@neuros_initialise()
def start(node):
    start_integrator(node)


@neuros_function(inputs=["imu", "odom_correction"], outputs=["estimate", "uncorrected", "activity"])
def integrate(node, imu, odom_correction):
    return estimates(node, imu, odom_correction)
