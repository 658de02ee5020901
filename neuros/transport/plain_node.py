"""The ROS node of a NeuROS node: rclpy's own, with services for parameters only where it has some.

rclpy gives each node six services for parameters: twelve of some twenty endpoints, which every
process of a domain hears of from every other, and more than half of what has to be found before
the first packet.
"""

from __future__ import annotations

from typing import Any

from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter_service import ParameterService


class PlainNode(Node):  # type: ignore[misc]
    """Offers its parameters to others as soon as a plugin has declared one."""

    def __init__(self, name: str, context: Context) -> None:
        self._is_complete = False
        super().__init__(
            name,
            context=context,
            start_parameter_services=False,
        )
        self._is_complete = True
        self._parameter_service: ParameterService | None = None

    def declare_parameters(self, *arguments: Any, **keywords: Any) -> Any:
        """As in rclpy, which comes here for a single one, too."""
        declared = super().declare_parameters(*arguments, **keywords)
        if self._is_complete and self._parameter_service is None:
            self._parameter_service = ParameterService(self)
        return declared
