"""Plain ROS 2 programs in processes of their own, beside a project under test."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from neuros.backends.node_command import with_libraries

ENDS_WITHIN_S = 10.0


@contextmanager
def plain_program(
    file: Path, domain_id: int, **environment: str
) -> Iterator[subprocess.Popen[str]]:
    """Start it with ``environment`` beside that of the test; ended at the end."""
    added = {"ROS_DOMAIN_ID": str(domain_id), **environment}
    with subprocess.Popen(
        [sys.executable, "-u", str(file)],
        env=with_libraries({**os.environ, **added}),
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)  # so that its DDS cleans up after itself
            try:
                process.wait(ENDS_WITHIN_S)
            except subprocess.TimeoutExpired:
                process.kill()
