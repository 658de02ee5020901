"""Program of ``python -m neuros.cli``; the command ``neuros`` is ``script/neuros``.

Ctrl+C waits while the command is imported: then that can end as it should.
"""

import sys

if __name__ == "__main__":
    if not (sys.flags.isolated or getattr(sys.flags, "safe_path", False)):
        del sys.path[0]  # the current folder, which may be a stranger's project
    import signal

    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    from neuros.cli.main import console_script

    console_script()
