"""An ``sshd`` on a machine of the tests, with keys of its own; no setting of the user matters."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from machines import Machine
from needs import require

_SOON_S = 20.0


@dataclass(frozen=True)
class SshServer:
    """A server at work.

    Attributes:
        cache: ``XDG_CACHE_HOME`` of those that log in.
        options: arguments of an ``ssh`` that may.
    """

    process: subprocess.Popen[bytes]
    cache: Path
    options: tuple[str, ...]


@contextmanager
def ssh_server(machine: Machine, address: str, folder: Path) -> Iterator[SshServer]:
    """``sshd`` on a machine; ended, with the sessions that it has, by its own handle."""
    require("sshd", "ssh")
    host, user, cache = folder / "host", folder / "user", folder / "cache"
    for key in (host, user):
        command = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(key)]
        subprocess.run(command, check=True, stdin=subprocess.DEVNULL)
    known = folder / "known_hosts"
    known.write_text(f"{address} {host.with_suffix('.pub').read_text()}")
    settings = folder / "sshd_config"
    settings.write_text(
        f"HostKey {host}\nAuthorizedKeysFile {user.with_suffix('.pub')}\nPidFile none\n"
        f"ListenAddress {address}\nPasswordAuthentication no\nUsePAM no\nStrictModes no\n"
        f"PermitRootLogin prohibit-password\nSetEnv XDG_CACHE_HOME={cache}\n"
    )
    Path("/run/sshd").mkdir(exist_ok=True)  # where it separates privileges
    log = folder / "sshd.log"
    with open(log, "wb") as output:
        process = subprocess.Popen(
            [*machine.inside(), "/usr/sbin/sshd", "-D", "-e", "-f", str(settings)],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
        )
    try:
        deadline_s = time.monotonic() + _SOON_S
        while "Server listening" not in log.read_text():
            assert process.poll() is None, f"sshd does not start: {log.read_text()}"
            assert time.monotonic() < deadline_s, log.read_text()
            time.sleep(0.02)
        options = ("-F", "none", "-i", str(user), "-o", f"UserKnownHostsFile={known}")
        yield SshServer(process, cache, options)
    finally:
        process.terminate()
        process.wait(_SOON_S)
