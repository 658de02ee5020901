"""An elevator, advanced from one reading of its cabin to the next."""

from neuros.hooks import neuros_function, neuros_initialise
from neuros.simulators.mujoco import MuJoCo


@neuros_initialise()
def start(node):
    node.set_user_data(MuJoCo(node, "elevator.xml"))


# The command has a hook of its own. As Optional input of the hook below it would wait there until
# that hook may run again, which is when the controller has taken the last reading; and the
# controller takes none while its last command waits. Each would wait for the other.
@neuros_function(inputs="target")
def obey(node, target):
    node.get_user_data().command("target", target)


# No required input: this is the main loop. It runs as often as its output may be sent.
@neuros_function(outputs="cabin")
def move(node):
    sim = node.get_user_data()
    sim.step_to_next()
    return sim.read("cabin")
