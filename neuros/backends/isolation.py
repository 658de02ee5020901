"""A network of the run's own (``--isolate``): a Linux network namespace with loopback alone.

This process enters it, and so does all that it starts. An ordinary user gets one with a user
namespace, in which everything still belongs to that user; root needs none.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import socket
import struct
from pathlib import Path

from neuros.errors import EnvironmentFault

# <linux/sched.h>, <linux/sockios.h>, <net/if.h>
_NEW_USER, _NEW_NET = 0x10000000, 0x40000000
_SET_FLAGS, _UP = 0x8914, 1

_REMEDY = (
    "run it as root, allow user namespaces (sysctl kernel.unprivileged_userns_clone=1,"
    " kernel.apparmor_restrict_unprivileged_userns=0, user.max_user_namespaces > 0), use"
    " --backend docker, or leave --isolate out"
)


def enter_own_network() -> None:
    """Leave the network of this machine, for good.

    Raises:
        EnvironmentFault: if that is not allowed here, or this process has threads already.
    """
    is_root = os.geteuid() == 0
    user, group = os.geteuid(), os.getegid()
    unshare = ctypes.CDLL(None, use_errno=True).unshare
    if unshare(_NEW_NET if is_root else _NEW_USER | _NEW_NET):
        reason = os.strerror(ctypes.get_errno())
        raise EnvironmentFault(f"--isolate: no network of its own here ({reason}): {_REMEDY}")
    try:
        if not is_root:
            itself = Path("/proc/self")
            (itself / "setgroups").write_text("deny")
            (itself / "uid_map").write_text(f"{user} {user} 1")
            (itself / "gid_map").write_text(f"{group} {group} 1")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
            fcntl.ioctl(any_socket, _SET_FLAGS, struct.pack("16sh14x", b"lo", _UP))
    except OSError as error:
        raise EnvironmentFault(
            f"--isolate: no network of its own here ({error.strerror}): {_REMEDY}"
        ) from error
