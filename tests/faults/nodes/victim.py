"""Passes whole numbers on, until the fault that its environment names strikes at a place of it.

Just before, the file ``struck`` in its run folder appears.
"""

import ctypes
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

from neuros.hooks import neuros_finalise, neuros_function, neuros_initialise, neuros_tick

_FAULT, _PLACE = os.environ["FAULT"], os.environ["PLACE"]
_SIZE = int(os.environ["FAULT_BYTES"])
_AFTER = 5
"""Executions of a hook before the fault strikes in it."""

_RUN_FOLDER = Path(os.environ["NEUROS_RUN_DIR"])
_executions = {"tick": 0, "function": 0, "thread": 0}
_is_due = threading.Event()


def kill():
    """In a container, where the kernel keeps process 1 from it, the test does it from outside."""
    os.kill(os.getpid(), signal.SIGKILL)
    signal.pause()


def kill_later():
    """While the test steps the clock."""
    threading.Timer(0.5, kill).start()


def stop_and_continue():
    """Stand still for a second; process 1 of a container cannot, and is stopped from outside."""
    if os.getpid() == 1:
        return
    wake = f"import os, time; time.sleep(1); os.kill({os.getpid()}, {int(signal.SIGCONT)})"
    subprocess.Popen([sys.executable, "-I", "-S", "-c", wake])
    os.kill(os.getpid(), signal.SIGSTOP)


def segfault():
    ctypes.string_at(0)


def out_of_memory():
    """Memory ends, as it does for a process with a limit."""
    with open("/proc/self/statm") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 26), hard))
    try:
        bytearray(1 << 30)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def loop_in_python():
    while True:
        pass


def loop_in_c():
    """Never come back, and never let go of the GIL."""
    lock = ctypes.create_string_buffer(64)
    for _ in range(2):
        ctypes.PyDLL(None).pthread_mutex_lock(lock)


def exception():
    raise RuntimeError("the fault")


def sys_exit():
    sys.exit(0)


def os_exit():
    os._exit(0)


def fork():
    """A child that outlives everything, if it may."""
    if os.fork() == 0:
        while True:
            time.sleep(60)


def close_descriptors():
    os.closerange(3, 1 << 16)


def change_signals():
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        # As C libraries do it: Python allows it in the main thread only.
        ctypes.CDLL(None).signal(int(number), ctypes.c_void_p(1))


def flood_output():
    line = b"x" * 1023 + b"\n"
    for _ in range(_SIZE // len(line)):
        os.write(1, line)


def pass_by():
    """No fault of the plugin's: the test does something to the run."""


def dawdle():
    """So that the run stays where it is, while the test does something to it."""
    time.sleep(0.6)


def print_much():
    """As a plugin does: through Python, and through its logger."""
    for _ in range(_SIZE // 1024):
        print("x" * 1023)
    sys.stdout.flush()
    print("to standard error", file=sys.stderr)


def binary_output():
    for _ in range(100):
        os.write(1, bytes(range(256)))
        os.write(2, b"\xff\xfe\x00\x1b[2J" + os.urandom(100))


def _strike(place):
    if place != _PLACE:
        return
    if place in _executions:
        _executions[place] += 1
        if _executions[place] != _AFTER:
            return
    (_RUN_FOLDER / "struck").write_text(str(time.monotonic()))
    globals()[_FAULT]()


def _strike_in_thread():
    _is_due.wait()
    for _ in range(_AFTER):
        _strike("thread")


@neuros_initialise()
def initialise(node):
    threading.Thread(target=_strike_in_thread, name="fault", daemon=True).start()
    _strike("initialise")


@neuros_tick(seconds=0.05)
def tick(node):
    _strike("tick")


@neuros_function(inputs="number", outputs="passed")
def function(node, number):
    _is_due.set()
    _strike("function")
    return number


@neuros_finalise()
def finalise(node):
    _strike("finalise")


_strike("import")
