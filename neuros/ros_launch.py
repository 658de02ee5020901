"""A project as an action of a ROS launch file: it starts and stops with the other nodes there.

``launch`` comes with a ROS distribution (no wheel has it), so nothing else imports this module.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from launch.actions import ExecuteProcess
from launch.some_substitutions_type import SomeSubstitutionsType

from neuros.distribution import python_command


class NeurosProject(ExecuteProcess):  # type: ignore[misc]  # without a ROS distribution
    """Launch a project beside the other nodes of a launch file: ``neuros launch PROJECT``.

    ``project`` is a project file or its folder, ``arguments`` are options of ``neuros launch``;
    both may be substitutions. Other arguments are those of ``ExecuteProcess``. The run ends, as
    with Ctrl+C, when the launch file's does; its exit code is that of ``neuros launch``.
    """

    def __init__(
        self,
        project: SomeSubstitutionsType,
        *,
        arguments: Iterable[SomeSubstitutionsType] = (),
        **options: Any,
    ) -> None:
        # Longer than a run needs to end by itself: its bag would lack the last packets.
        options = {"output": "screen", "sigterm_timeout": "30", **options}
        command = python_command("neuros.cli", "launch")
        super().__init__(cmd=[*command, project, *arguments], **options)
