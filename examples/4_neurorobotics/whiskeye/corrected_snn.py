"""The spiking network that integrates the gyroscope, and takes a correction where there is one."""

from correcting_snn import estimates, start_integrator

from neuros.hooks import Optional, neuros_function, neuros_initialise


@neuros_initialise()
def start(node):
    start_integrator(node)


@neuros_function(
    inputs=["imu", Optional("odom_correction")], outputs=["estimate", "uncorrected", "activity"]
)
def integrate(node, imu, odom_correction):
    return estimates(node, imu, odom_correction)
