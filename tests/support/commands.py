"""``neuros`` in the test's own process: a Python of its own computes for half a second."""

from __future__ import annotations

import contextlib
import io
from subprocess import CompletedProcess

from neuros.cli.main import main


def neuros(*arguments: object) -> CompletedProcess[str]:
    """Run a command; returns its exit code, and what it printed itself, not its processes."""
    words = [str(each) for each in arguments]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(words)
        except SystemExit as ended:  # from argparse, which has printed why
            code = int(ended.code or 0)
    return CompletedProcess(words, code, out.getvalue(), err.getvalue())
