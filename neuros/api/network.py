"""``--network`` and ``--peers``: how far the nodes of a run look for others."""

from __future__ import annotations

import ipaddress
import re
import socket
from collections.abc import Mapping
from dataclasses import dataclass

from neuros.errors import EnvironmentFault, UsageError
from neuros.transport.dds_profile import PEERS_VARIABLE, RANGE_VARIABLE, as_asked

_HOST_NAME = re.compile(r"(?!-)[A-Za-z0-9_-]{1,63}(\.[A-Za-z0-9_-]{1,63})*\.?")  # RFC 1123
_LOOKS_LIKE_AN_ADDRESS = re.compile(r"[\d.]+")


@dataclass(frozen=True)
class Network:
    """How far nodes look for others.

    Attributes:
        is_wide: whether beyond this machine.
        peers: IPv4 addresses of machines that multicast does not reach.
    """

    is_wide: bool = False
    peers: tuple[str, ...] = ()

    def environment(self, environ: Mapping[str, str]) -> dict[str, str]:
        """What the nodes get; without a wish, what the launcher's own environment says."""
        if not self.is_wide:
            return {RANGE_VARIABLE: as_asked(environ).get(RANGE_VARIABLE) or "LOCALHOST"}
        peers = {PEERS_VARIABLE: ";".join(self.peers)} if self.peers else {}
        return {RANGE_VARIABLE: "SUBNET", **peers}


THIS_MACHINE = Network()


def chosen_network(network: bool, peers: str | None) -> Network:
    """What the options say.

    Raises:
        UsageError: if a peer is neither an IPv4 address nor a host name.
        EnvironmentFault: if a name is not known here.
    """
    if peers is None:
        return Network(network)
    wanted = [part.strip() for part in peers.split(",")]
    nonsense = [part for part in wanted if not _is_possible(part)]
    if nonsense:
        raise UsageError(
            f"--peers {peers}: {', '.join(map(repr, nonsense))} is neither an IPv4 address nor the"
            " name of a host: give them as in --peers 10.0.0.7,robot.local"
        )
    return Network(True, tuple(dict.fromkeys(map(_address, wanted))))


def _is_possible(text: str) -> bool:
    if _LOOKS_LIKE_AN_ADDRESS.fullmatch(text):
        try:
            address = ipaddress.IPv4Address(text)
        except ValueError:
            return False
        return not (address.is_unspecified or address.is_multicast)
    return _HOST_NAME.fullmatch(text) is not None


def _address(host: str) -> str:
    """The IPv4 address of a host: found here, since a node's container may not know the name."""
    try:
        found = socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_DGRAM)
    except OSError as error:
        raise EnvironmentFault(
            f"--peers: the host '{host}' cannot be found from here ({error.strerror}): give its"
            " IPv4 address"
        ) from error
    return str(found[0][4][0])
