#!/usr/bin/env python3
"""What tests need of the operating system: tests/needs.py [--install]

A test says it with a marker, ``@pytest.mark.needs("git")``, a fixture or a helper with
``require("git")``. Where it is missing, an ordinary user's test is skipped and counted apart. For
root, who can install it, and on a machine for continuous integration (``CI`` is set), the test
fails: what is skipped there is a test that is missing.

As a program it names the packages of Debian that this machine lacks; with ``--install`` root gets
them. It runs on a bare Python.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple, NoReturn

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from neuros.installation.machine import OPENGL_PACKAGES, offscreen_opengl

COMPILER = ("gcc", "g++", "Python.h")
"""What builds message packages."""

_INSTALL = ("install", "-y", "--no-install-recommends", "-o", "DPkg::Lock::Timeout=120")
_POLICY = Path("/usr/sbin/policy-rc.d")
"""Debian asks it whether a package may start a daemon; 101: it may not."""
_SKIPPED = re.compile(r"needs (?P<what>.+?)(: |$)")


class Need(NamedTuple):
    """How it is seen that something is there, and the packages of Debian that bring it."""

    is_there: Callable[[], bool]
    packages: tuple[str, ...]


def _program(*names: str) -> Callable[[], bool]:
    return lambda: any(shutil.which(name) for name in names)


def _daemon(name: str) -> Callable[[], bool]:
    """Where an ordinary user's PATH does not lead."""
    return lambda: shutil.which(name, path=f"{os.environ.get('PATH', '')}:/usr/sbin") is not None


def _has_headers() -> bool:
    return Path(sysconfig.get_path("include"), "Python.h").is_file()


def _has_osmesa() -> bool:
    for library in ("libOSMesa.so.8", "libOSMesa.so.6"):
        with contextlib.suppress(OSError):
            ctypes.CDLL(library)
            return True
    return False


NEEDS = {
    "root": Need(lambda: os.geteuid() == 0, ()),
    "git": Need(_program("git"), ("git",)),
    "gcc": Need(_program("gcc"), ("gcc",)),
    "g++": Need(_program("g++"), ("g++",)),
    "Python.h": Need(_has_headers, ("python3-dev",)),
    "tkinter": Need(lambda: find_spec("_tkinter") is not None, ("python3-tk",)),
    "OpenGL": Need(lambda: bool(offscreen_opengl()), tuple(OPENGL_PACKAGES.split())),
    "OSMesa": Need(_has_osmesa, ("libosmesa6",)),
    "Xvfb": Need(_program("Xvfb"), ("xvfb",)),
    "Chromium": Need(_program("chromium", "google-chrome"), ("chromium",)),
    "munged": Need(_daemon("munged"), ("munge",)),
    "slurmctld": Need(_daemon("slurmctld"), ("slurmctld",)),
    "slurmd": Need(_daemon("slurmd"), ("slurmd",)),
    "sbatch": Need(_program("sbatch"), ("slurm-client",)),
    "docker": Need(_program("docker"), ("docker.io",)),
    "docker-compose": Need(_program("docker-compose"), ("docker-compose",)),
    "sshd": Need(_daemon("sshd"), ("openssh-server",)),
    "ssh": Need(_program("ssh"), ("openssh-client",)),
    "ip": Need(_program("ip"), ("iproute2",)),
    "iptables": Need(_program("iptables"), ("iptables",)),
}


def require(*names: str) -> None:
    """End the test where one of these is missing: skipped, or failed where it could be had."""
    missing = [name for name in names if not NEEDS[name].is_there()]
    if missing:
        packages = packages_of(missing)
        remedy = f"apt-get install -y {' '.join(packages)}" if packages else ""
        can_be_had = os.geteuid() == 0 and shutil.which("apt-get") is not None
        cannot_run(", ".join(missing), remedy, can_be_had=can_be_had)


def cannot_run(what: str, remedy: str = "", *, can_be_had: bool = False) -> NoReturn:
    """Skip the test, since it needs something; where that can be had, and in CI, it fails."""
    import pytest

    reason = f"needs {what}: {remedy}" if remedy else f"needs {what}"
    if can_be_had or os.environ.get("CI"):
        pytest.fail(reason, pytrace=False)
    pytest.skip(reason)


def summary(reasons: Iterable[str]) -> Iterator[str]:
    """One line for each thing that skipped tests need, and one that installs what can be."""
    matches = (_SKIPPED.match(reason) for reason in reasons)
    wanted = Counter(match["what"] for match in matches if match)
    for what, count in wanted.most_common():
        yield f"{count} {'test needs' if count == 1 else 'tests need'} {what}"
    names = {name for what in wanted for name in what.split(", ")}
    if packages := packages_of(name for name in NEEDS if name in names):
        yield f"sudo apt-get install -y {' '.join(packages)}"


def packages_of(names: Iterable[str]) -> list[str]:
    """The packages of Debian that bring all these."""
    return list(dict.fromkeys(package for name in names for package in NEEDS[name].packages))


def main(arguments: list[str]) -> int:
    """Name what is missing, or install it; returns the exit code."""
    packages = packages_of(name for name, need in NEEDS.items() if not need.is_there())
    if not packages:
        return 0
    what = " ".join(packages)
    if arguments != ["--install"] or os.geteuid() != 0 or shutil.which("apt-get") is None:
        print(f"this machine lacks {what}: tests that need them say so", flush=True)
        return 0
    print(f"installing what the tests need: {what}", flush=True)
    _apt_get("update")
    with _daemons_not_started():
        # A newer Debian may have dropped one of them: the others are installed nevertheless.
        missing = [] if _apt_get(*_INSTALL, *packages) else packages
        missing = [package for package in missing if not _apt_get(*_INSTALL, package)]
    if missing:
        print(f"not installed, so tests that need them fail: {' '.join(missing)}", flush=True)
    return 0


@contextlib.contextmanager
def _daemons_not_started() -> Iterator[None]:
    """Packages start their daemons (sshd, slurmd, dockerd) at once; tests start their own."""
    if _POLICY.exists():
        yield
        return
    _POLICY.write_text("#!/bin/sh\nexit 101\n")
    try:
        _POLICY.chmod(0o755)
        yield
    finally:
        _POLICY.unlink()


def _apt_get(*arguments: str) -> bool:
    done = subprocess.run(
        ["apt-get", "-qq", *arguments],
        env={**os.environ, "DEBIAN_FRONTEND": "noninteractive"},
        stdout=subprocess.DEVNULL,
        check=False,
    )
    return done.returncode == 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
