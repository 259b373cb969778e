"""Two network namespaces of Linux with a cable between them: slave and master on one machine, as if they were two.

An EtherCAT master needs an interface of its own, and its frames must not reach the rest of the network.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass


@dataclass(frozen=True)
class Namespaces:
    """Names of the two namespaces and of the interface in each."""

    slave: str = "drive-env-slave"
    master: str = "drive-env-master"
    slave_interface: str = "veth1"
    master_interface: str = "veth0"

    def make(self) -> None:
        """Create them, and switch their interfaces on.

        Raises:
            OSError: If this system has no namespaces, a right is missing, or they exist already; nothing is created
                then.
        """
        _check()
        there = [name for name in (self.slave, self.master) if name in existing()]
        if there:
            raise OSError(f"the namespace {there[0]} exists already; remove it with --remove, or use it as it is")
        try:
            _ip("netns", "add", self.slave)
            _ip("netns", "add", self.master)
            _ip(
                "link", "add", self.master_interface, "netns", self.master, "type", "veth",
                "peer", "name", self.slave_interface, "netns", self.slave,
            )  # fmt: skip
            for space, interface in ((self.slave, self.slave_interface), (self.master, self.master_interface)):
                _ip("-n", space, "link", "set", "lo", "up")
                _ip("-n", space, "link", "set", interface, "up")
        except OSError:
            self.remove()
            raise

    def remove(self) -> bool:
        """Remove the existing ones and their cable; return whether there were any.

        Raises:
            OSError: If this system has no namespaces, or a right is missing.
        """
        _check()
        there = [name for name in (self.slave, self.master) if name in existing()]
        for name in there:
            _ip("netns", "delete", name)
        return bool(there)


def existing() -> list[str]:
    """Return the existing ones among the two namespaces."""
    return [line.split()[0] for line in _ip("netns", "list").splitlines() if line.strip()]


def _check() -> None:
    if sys.platform != "linux" or shutil.which("ip") is None:
        raise OSError(
            "network namespaces are Linux's, made by the program ip (Debian: apt install iproute2), which is not here; "
            "use --interface ethercat-udp"
        )
    if os.geteuid() != 0:
        program = shutil.which("drive-env") or "drive-env"
        raise OSError(
            f"no namespace can be made: it takes the right CAP_NET_ADMIN: run it as root, as in: sudo {program} "
            "ethercat namespace"
        )


def _ip(*arguments: str) -> str:
    """Run `ip` and return its output; OSError with its own words if it fails."""
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True, timeout=30, check=False)
    if done.returncode != 0:
        raise OSError(f"ip {' '.join(arguments)} failed: {done.stderr.strip() or done.returncode}")
    return done.stdout
