"""The console script ``neuros``, and the program of ``python -m neuros.cli``.

Ctrl+C waits while the commands are imported: then they can end as they should.
"""

import signal


def console_script() -> None:
    """Entry point of the installed ``neuros`` command."""
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    from neuros.cli.main import console_script as run

    run()


if __name__ == "__main__":
    console_script()
