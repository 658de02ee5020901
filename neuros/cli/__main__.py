"""Program of the processes that NeuROS starts; the command ``neuros`` is ``script/neuros``.

Ctrl+C waits while the command is imported: then that can end as it should.
"""

import sys

if __name__ == "__main__":
    import os

    # With -m Python has put the current folder there, which may be a stranger's project.
    if sys.path[0] == os.path.realpath("/proc/self/cwd"):
        del sys.path[0]
    import signal

    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    from neuros.cli.main import console_script

    console_script()
