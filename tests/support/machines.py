"""Machines within this one: namespaces of their own for mounts, host name and network.

Nothing outside of them is touched, and they are gone with the process that holds them. It takes
root.
"""

from __future__ import annotations

import subprocess
from pathlib import Path

from needs import cannot_run, require

_APART = 'mount -t tmpfs tmpfs /dev/shm && hostname "$0" && '
_HOLD = "echo ready && exec cat"
APART_S = 100_000
"""How far the monotonic clock of a machine with a clock of its own is ahead."""


class Machine:
    """A machine called ``name``.

    Apart from this one it has a network without any cable, shared memory and its name to itself;
    else it is this one, but for what is mounted. With a clock of its own, its monotonic time began
    :data:`APART_S` seconds earlier.

    Raises:
        RuntimeError: if that is impossible here (root in a container may not).
    """

    def __init__(self, name: str, *, is_apart: bool = False, has_own_clock: bool = False) -> None:
        namespaces = ["--mount", *(["--uts", "--net"] if is_apart else [])]
        self._has_own_clock = has_own_clock
        if has_own_clock:  # children of the holder are in it, and what is run inside
            namespaces += ["--time", f"--monotonic={APART_S}"]
        # It reads until the test closes the pipe, or has ended in whatever way.
        self._holder = subprocess.Popen(
            ["unshare", *namespaces, "sh", "-c", _APART * is_apart + _HOLD, name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # Ctrl+C ends the tests, and they end it
        )
        assert self._holder.stdout is not None
        if (said := self._holder.stdout.readline()) != b"ready\n":
            self.close()
            raise RuntimeError(f"no namespaces: {said.decode().strip()}")

    @property
    def pid(self) -> int:
        """Of the process that holds the namespaces."""
        return self._holder.pid

    def inside(self, folder: Path = Path("/")) -> list[str]:
        """The command that executes the one behind it there, with the same process id."""
        clock = [f"--time=/proc/{self.pid}/ns/time_for_children"] if self._has_own_clock else []
        spaces = ["--mount", "--uts", "--net", *clock]
        return ["nsenter", f"--target={self.pid}", *spaces, f"--wd={folder}"]

    def run(self, *command: str) -> None:
        """Run a command there, which must succeed."""
        run(*self.inside(), *command)

    def close(self) -> None:
        """Leave it; processes that are still there keep it until they end."""
        assert self._holder.stdin is not None
        assert self._holder.stdout is not None
        self._holder.stdin.close()
        self._holder.stdout.close()
        self._holder.wait()


def run(*command: str) -> None:
    """Run a command, which must succeed."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{' '.join(command)}: {done.stderr}"


def require_machines(*tools: str, has_own_clock: bool = False) -> None:
    """End the test where it cannot have machines, one of these tools, or a clock of its own."""
    require("root")
    require(*tools)
    clock = ["--time", "--monotonic=1"] if has_own_clock else []
    command = ["unshare", "--mount", "--uts", "--net", *clock, "true"]
    if subprocess.call(command, stderr=subprocess.DEVNULL):
        cannot_run("namespaces", "the kernel lets root have none here, as in a container")
