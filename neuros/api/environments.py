"""Makes what a run needs before it begins: virtual environments, and message packages."""

from __future__ import annotations

import os

from neuros.installation.progress import Progress, Stream
from neuros.launch.environments.pythons import Pythons
from neuros.launch.node_command import without_mark
from neuros.launch.reaper import Reaper
from neuros.launch.run_processes import RUN_ID
from neuros.messages.needed import Messages


def make_environments(pythons: Pythons, messages: Messages | None, output: Stream) -> None:
    """Make what is missing, and say so; ``KeyboardInterrupt`` ends it at any time.

    Raises:
        EnvironmentFault: with all that failed.
    """
    pythons.note_use()
    if messages is not None:
        messages.note_use()
    if are_made(pythons, messages):
        return
    # pip, the compiler, and what they start must not outlive a launcher that is killed.
    run_id = os.urandom(8).hex()
    reaper = Reaper.start(run_id)
    try:
        progress = Progress(output)
        if messages is not None:
            messages.make(progress, {**without_mark(os.environ), RUN_ID: run_id})
        pythons.make(progress, {RUN_ID: run_id})
    finally:
        reaper.finish()


def are_made(pythons: Pythons, messages: Messages | None) -> bool:
    """Whether nothing is missing."""
    return pythons.is_made and (messages is None or messages.is_made)
