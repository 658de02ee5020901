"""A program that holds a session of a project and lets it run for a time: FILE FOLDER SECONDS."""

from __future__ import annotations

import faulthandler
import signal
import sys

# Python loses a KeyboardInterrupt that comes in a callback of its import system.
signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})

from neuros import Project  # noqa: E402


def main(file: str, folder: str, seconds: str) -> None:
    """Run, and end the run, drained."""
    faulthandler.enable()  # says where it stands when it is killed
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
    with Project.from_file(file).session(backend="local", output=folder) as session:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        session.run(duration_s=float(seconds))


if __name__ == "__main__":
    main(*sys.argv[1:])
