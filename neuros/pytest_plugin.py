"""The fixture ``neuros_session``, for the tests of users (entry point of the group ``pytest11``).

It costs a test run nothing where it is not used.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from typing import Any

import pytest


@pytest.fixture
def neuros_session() -> Iterator[Callable[..., Any]]:
    """Start a session of a project: ``neuros_session("project.json", backend="in-process")``.

    It takes the arguments of ``neuros.Project.session``. At the end of the test the session is
    closed, and the run must have ended well, unless a step has raised ``RunError``.
    """
    import neuros

    with contextlib.ExitStack() as stack:

        def start(project: str | os.PathLike[str], **options: Any) -> Any:
            session = neuros.Project.from_file(project).session(**options)

            def end() -> None:
                if session.is_running:
                    session.close().check()

            stack.callback(end)
            return session

        yield start
