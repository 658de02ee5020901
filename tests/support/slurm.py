"""A Slurm cluster of a test's own: controller, its nodes and authentication on this machine."""

from __future__ import annotations

import os
import pwd
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from needs import require

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch")
_SOON_S = 60.0
_CONFIGURATION = """\
ClusterName=neuros
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CredType=cred/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool-%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SwitchType=switch/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
DefMemPerCPU=256
SchedulerType=sched/backfill
SlurmdParameters=config_overrides
ReturnToService=2
MessageTimeout=60
{nodes}
PartitionName=first Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


@contextmanager
def slurm_cluster(cpus: int = 2, names: Sequence[str] = ("node",)) -> Iterator[dict[str, str]]:
    """Start a cluster; yields the environment in which its commands find it.

    Its nodes are daemons of this machine, each with its own port.
    """
    require(*PROGRAMS)
    # Sockets have short names, and the folders of pytest have not.
    folder = Path(tempfile.mkdtemp(prefix="slurm-"))
    with ExitStack() as stack:
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        for name in ("state", *(f"spool-{name}" for name in names)):
            (folder / name).mkdir()
        key = folder / "munge.key"
        key.write_bytes(os.urandom(128))
        key.chmod(0o600)
        configuration = folder / "slurm.conf"
        host = socket.gethostname().partition(".")[0]
        controller, *ports = _free_ports(1 + len(names))
        configuration.write_text(
            _CONFIGURATION.format(
                host=host,
                user=pwd.getpwuid(os.geteuid()).pw_name,
                folder=folder,
                controller=controller,
                nodes="\n".join(
                    f"NodeName={name} NodeHostname={host} NodeAddr=127.0.0.1 Port={port}"
                    f" CPUs={cpus} RealMemory=4096 State=UNKNOWN"
                    for name, port in zip(names, ports, strict=True)
                ),
            )
        )
        files = {"pid-file": "munge.pid", "log-file": "munge.log", "seed-file": "munge.seed"}
        munge = [f"--{option}={folder / name}" for option, name in files.items()]
        munge += [f"--socket={folder}/munge.socket", f"--key-file={key}"]
        stack.enter_context(_daemon(folder, "munged", "--foreground", "--force", *munge))
        _wait_until(folder, (folder / "munge.socket").exists)
        options = ("-D", "-f", str(configuration))
        stack.enter_context(_daemon(folder, "slurmctld", *options, "-c"))
        for name in names:
            stack.enter_context(_daemon(folder, "slurmd", *options, "-N", name))
        environment = {"SLURM_CONF": str(configuration)}
        _wait_until(folder, lambda: _is_idle(environment))
        yield environment


@contextmanager
def _daemon(folder: Path, program: str, *arguments: str) -> Iterator[None]:
    found = shutil.which(program, path=f"{os.environ['PATH']}:/usr/sbin:/sbin")
    with (folder / f"{program}.out").open("ab") as out:
        process = subprocess.Popen(
            ["setpriv", "--pdeathsig", "TERM", str(found), *arguments], stdout=out, stderr=out
        )
    try:
        yield
    finally:
        process.terminate()
        try:
            process.wait(_SOON_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _is_idle(environment: dict[str, str]) -> bool:
    command = ["sinfo", "--noheader", "--format=%T"]
    done = subprocess.run(
        command, env={**os.environ, **environment}, capture_output=True, text=True, check=False
    )
    return done.stdout.strip() == "idle"


def _wait_until(folder: Path, condition: object) -> None:
    assert callable(condition)
    deadline_s = time.monotonic() + _SOON_S
    while not condition():
        if time.monotonic() > deadline_s:
            logs = (f"{log.name}:\n{log.read_text()}" for log in folder.glob("*.[lo][ou][gt]"))
            raise AssertionError("Slurm does not start:\n" + "\n".join(logs))
        time.sleep(0.1)


def _free_ports(count: int) -> list[int]:
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in sockets]
