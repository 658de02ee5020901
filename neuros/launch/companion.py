"""Programs that run beside the nodes of a run: its recorder, its dashboard."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

from neuros.errors import EnvironmentFault
from neuros.launch.host_command import host_environment
from neuros.launch.wheels import with_libraries

_NICENESS = 10


def start_companion(
    what: str,
    command: Sequence[str],
    run: Path,
    log: Path,
    environment: Mapping[str, str],
    pass_fds: Sequence[int] = (),
    *,
    is_ours: bool = True,
) -> subprocess.Popen[bytes]:
    """Start a program in the run folder, in a session of its own, and less urgent than the nodes.

    Args:
        what: its name, for messages.
        log: where its standard error goes; input and output are pipes.
        environment: what is added to that of this process.
        is_ours: whether it is a program of this Python; others do not get the libraries of ours.

    Raises:
        EnvironmentFault: if it cannot be started.
    """
    whole = host_environment(os.environ, environment)
    try:
        with open(log, "ab") as file:
            process = subprocess.Popen(
                list(command),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=file,
                cwd=run,
                env=with_libraries(whole) if is_ours else whole,
                start_new_session=True,
                pass_fds=tuple(pass_fds),
            )
    except OSError as error:
        raise EnvironmentFault(f"the {what} cannot be started: {error}") from error
    os.setpriority(os.PRIO_PROCESS, process.pid, _NICENESS)
    return process
