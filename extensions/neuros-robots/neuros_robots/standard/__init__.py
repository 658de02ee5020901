"""A plugin that drives any simulator that serves ``simulation_interfaces``, in lockstep.

:mod:`~neuros_robots.standard.settings` has its parameters and checks them before a run,
:mod:`~neuros_robots.standard.lockstep` what one start of its hook does, and
:mod:`~neuros_robots.standard.foreign` what it exchanges with the simulator over ROS.
:mod:`~neuros_robots.standard.serving` is the other side: a MuJoCo node that serves the standard.
Source: https://github.com/ros-simulation/simulation_interfaces, 2.0 and 2.1.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from neuros.hooks import Optional, neuros_function, neuros_initialise, neuros_reset
from neuros.project.model import Node
from neuros_robots.standard.serving import serve

__all__ = ["neuros_hooks", "serve"]


def neuros_hooks(node: Node) -> list[Callable[..., Any]]:
    """The hooks of a node of this plugin: its ports are the inputs and outputs of ``step``."""
    from neuros_robots.standard.foreign import Foreign
    from neuros_robots.standard.lockstep import Lockstep
    from neuros_robots.standard.settings import Settings

    settings = Settings.of(node)
    names = [port.name for port in node.inputs]
    inputs = [Optional(name) if name in settings.optional else name for name in names]
    outputs = [
        Optional(port.name) if settings.every.get(port.name, 1) > 1 else port.name
        for port in node.outputs
    ]

    @neuros_initialise()
    def start(node: Any) -> None:
        foreign = Foreign(node, settings)
        node.on_close(foreign.close)
        simulator = Lockstep(node, settings, foreign)
        node.set_user_data(simulator)
        simulator.begin()
        node.own_simulated_time(lambda: simulator.time_s)

    @neuros_reset()
    def begin_again(node: Any) -> None:
        node.get_user_data().begin()

    @neuros_function(inputs=inputs, outputs=outputs)
    def step(node: Any, *packets: Any) -> list[Any]:
        simulator: Lockstep = node.get_user_data()
        return simulator.step(dict(zip(names, packets, strict=True)))

    return [start, begin_again, step]
