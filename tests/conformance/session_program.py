"""A program that holds a session of a project and lets it run for a time: FILE FOLDER SECONDS."""

from __future__ import annotations

import sys

from neuros import Project


def main(file: str, folder: str, seconds: str) -> None:
    """Run, and end the run, drained."""
    with Project.from_file(file).session(output=folder) as session:
        session.run(duration_s=float(seconds))


if __name__ == "__main__":
    main(*sys.argv[1:])
