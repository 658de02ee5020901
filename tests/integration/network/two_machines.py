"""Two network namespaces joined by a cable (a veth pair): two machines, as far as DDS can tell.

Each has addresses of its own (192.0.2.1 and 192.0.2.2, which are reserved for such ends: RFC 5737),
a host name, and shared memory of its own. Nothing outside the namespaces is touched. It takes root.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from launching import Running, start

ADDRESSES = {"left": "192.0.2.1", "right": "192.0.2.2"}
_INSIDE = 'mount -t tmpfs tmpfs /dev/shm && hostname "$0" && exec "$@"'


class TwoMachines:
    """``left`` and ``right``, and the cable between them."""

    def __init__(self) -> None:
        self._namespaces = {side: f"neuros-{os.getpid()}-{side}" for side in ADDRESSES}
        self._ends = {side: f"v{os.getpid()}{side[0]}" for side in ADDRESSES}

    def try_to_set_up(self) -> str | None:
        """Make all of it; says why, if that is impossible (root in a container may not)."""
        try:
            self._set_up()
        except AssertionError as error:
            return str(error)
        return None

    def _set_up(self) -> None:
        for name in self._namespaces.values():
            run("ip", "netns", "add", name)
        end, other = self._ends.values()
        here, there = self._namespaces.values()
        run(*f"ip link add {end} netns {here} type veth peer name {other} netns {there}".split())
        for side, address in ADDRESSES.items():
            ip = ("ip", "-n", self._namespaces[side])
            run(*ip, "addr", "add", f"{address}/24", "dev", self._ends[side])
            run(*ip, "link", "set", "lo", "up")
            run(*ip, "link", "set", self._ends[side], "up")
            run(*ip, "route", "add", "default", "dev", self._ends[side])

    def remove(self) -> None:
        for name in self._namespaces.values():
            if Path("/run/netns", name).exists():
                run("ip", "netns", "del", name)  # the cable goes with it

    def lose(self, share: float) -> None:
        """Lose this share of what arrives, at both ends."""
        self._filter("-m", "statistic", "--mode", "random", "--probability", str(share))

    def stop_multicast(self) -> None:
        """Let no multicast pass."""
        self._filter("-d", "224.0.0.0/4")

    def unplug(self) -> None:
        """Pull the cable."""
        run("ip", "-n", self._namespaces["left"], "link", "set", self._ends["left"], "down")

    def start(
        self, side: str, project: Path, *arguments: str, cwd: Path, **environment: str
    ) -> Running:
        """``neuros launch PROJECT ARGUMENTS`` on one of them; run folders are in ``cwd/SIDE``."""
        folder = cwd / side
        folder.mkdir(exist_ok=True)
        enter = ["ip", "netns", "exec", self._namespaces[side], "unshare", "--mount", "--uts"]
        inside = [*enter, "sh", "-c", _INSIDE, side]
        return start(project, *arguments, cwd=folder, through=inside, **environment)

    def _filter(self, *rule: str) -> None:
        for side, name in self._namespaces.items():
            enter = ("ip", "netns", "exec", name)
            run(*enter, "iptables", "-A", "INPUT", "-i", self._ends[side], *rule, "-j", "DROP")


def run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{' '.join(command)}: {done.stderr}"


def why_not() -> str | None:
    """What is missing for this, if anything is."""
    if os.geteuid() != 0:
        return "two network namespaces take root"
    missing = [tool for tool in ("ip", "iptables", "unshare") if shutil.which(tool) is None]
    return f"there is no {', '.join(missing)}" if missing else None


@contextmanager
def two_machines() -> Iterator[TwoMachines]:
    """Made, and removed; skips the test where that is impossible, but in CI it has to be."""
    machines = TwoMachines()
    try:
        reason = why_not() or machines.try_to_set_up()
        if reason is not None and os.environ.get("CI") != "true":
            pytest.skip(reason)
        assert reason is None, reason
        yield machines
    finally:
        machines.remove()
