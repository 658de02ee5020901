"""Program of ``python -m neuros.cli``; the command ``neuros`` is ``script/neuros``.

Ctrl+C waits while the command is imported: then that can end as it should.
"""

import signal

if __name__ == "__main__":
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    from neuros.cli.main import console_script

    console_script()
