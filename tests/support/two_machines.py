"""Two machines joined by a cable: network namespaces and a veth pair, as far as DDS can tell.

In place of the veth pair there may be a :class:`~cable.Cable`, which delays and reorders, too.

Each has addresses of its own (192.0.2.1 and 192.0.2.2, which are reserved for such ends: RFC 5737),
a host name, shared memory, and an engine of its own where a test asks for one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

from cable import Cable
from docker import DockerClient
from engines import OwnEngine, own_engine
from launching import Running, start
from machines import Machine, require_machines, run
from needs import cannot_run

ADDRESSES = {"left": "192.0.2.1", "right": "192.0.2.2"}
CABLE = "cable"


class TwoMachines:
    """``left`` and ``right``, and the cable between them."""

    def __init__(self, machines: Mapping[str, Machine], cable: Cable | None = None) -> None:
        self._machines = machines
        self._engines: Mapping[str, OwnEngine] = {}
        left, right = (machine.pid for machine in machines.values())
        link = f"ip link add {CABLE} netns {left} type veth peer name {CABLE} netns {right}"
        if cable is None:
            run(*link.split())
        else:
            cable.lay(machines, CABLE)
        for side, machine in machines.items():
            machine.run("ip", "address", "add", f"{ADDRESSES[side]}/24", "dev", CABLE)
            machine.run("ip", "link", "set", "lo", "up")
        self.repair()

    def repair(self) -> None:
        """The cable is in, loses nothing, and lets multicast pass."""
        for machine in self._machines.values():
            machine.run("iptables", "--flush", "INPUT")
            machine.run("ip", "link", "set", CABLE, "up")
        for machine in self._machines.values():
            machine.run("ip", "route", "replace", "default", "dev", CABLE)

    def lose(self, share: float) -> None:
        """Lose this share of what arrives, at both ends."""
        self._filter("-m", "statistic", "--mode", "random", "--probability", str(share))

    def stop_multicast(self) -> None:
        """Let no multicast pass."""
        self._filter("-d", "224.0.0.0/4")

    def unplug(self) -> None:
        """Pull the cable."""
        self._machines["left"].run("ip", "link", "set", CABLE, "down")

    @contextmanager
    def engines(self) -> Iterator[None]:
        """An engine on each of them, with the images of the engine for tests."""
        with ExitStack() as stack:
            self._engines = {
                side: stack.enter_context(own_engine(machine))
                for side, machine in self._machines.items()
            }
            yield

    def start(
        self, side: str, project: Path, *arguments: str, cwd: Path, **environment: str
    ) -> Running:
        """``neuros launch PROJECT ARGUMENTS`` on one of them; run folders are in ``cwd/SIDE``."""
        folder = cwd / side
        folder.mkdir(exist_ok=True)
        if side in self._engines:
            environment = {"DOCKER_HOST": self._engines[side].address, **environment}
        inside = self._machines[side].inside(folder)
        return start(project, *arguments, cwd=folder, through=inside, **environment)

    def inside(self, side: str, folder: Path) -> list[str]:
        """The command that executes the one behind it on one of them."""
        return self._machines[side].inside(folder)

    def containers(self) -> list[str]:
        """What the engines have, running or not."""
        found: list[str] = []
        for engine in self._engines.values():
            client: DockerClient = engine.connect()
            found += [container.name for container in client.containers.list(all=True)]
            client.close()
        return found

    def _filter(self, *rule: str) -> None:
        for machine in self._machines.values():
            machine.run("iptables", "-A", "INPUT", "-i", CABLE, *rule, "-j", "DROP")


@contextmanager
def two_machines(cable: Cable | None = None) -> Iterator[TwoMachines]:
    """Made, and removed; with a veth pair between them unless there is a ``cable``."""
    require_machines("ip", "iptables")
    if cable is not None and not Path("/dev/net/tun").exists():
        cannot_run("/dev/net/tun", "the kernel has no TAP devices here")
    with ExitStack() as stack:
        machines = {
            side: stack.enter_context(closing(Machine(side, is_apart=True))) for side in ADDRESSES
        }
        if cable is not None:
            stack.enter_context(closing(cable))
        yield TwoMachines(machines, cable)
