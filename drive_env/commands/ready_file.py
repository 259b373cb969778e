"""`drive-env serve --ready-file`: the address of emulated drives, as JSON for scripts."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    from drive_env.bus.transport import Transport
    from drive_env.ethercat.ways import EtherCatWay

OWNER_ONLY = 0o077  # umask: a reader of the token could move the drives


def can_address(transport: Transport, interface: str | None, channel: str | None) -> dict[str, Any]:
    """Return how python-can opens the bus of a server; `interface` is None for its hub."""
    from drive_env.bus.hub import Hub

    if isinstance(transport, Hub):
        return {"interface": "slcan", "channel": transport.channel}
    return {"interface": interface, "channel": channel}


def ethercat_address(way: EtherCatWay, interface: str | None) -> dict[str, Any]:
    """Return the interface and channel by which drive-env opens a server's way on EtherCAT."""
    from drive_env.ethercat.ways import UdpSocket

    return {"interface": interface, "channel": str(way.port) if isinstance(way, UdpSocket) else way.name}


@contextmanager
def told_ready(path: Path | None, address: Mapping[str, Any], fail: Callable[[str], NoReturn]) -> Iterator[None]:
    """Provide a file while a block serves: the address without None values, and the process; None: no file.

    Args:
        path: The file; it is written atomically, readable only by its owner.
        address: Its content besides the process.
        fail: Ends the command with a message if the file cannot be written.
    """
    from drive_env.whole_file import write_whole

    if path is None:
        yield
        return
    ready = {name: value for name, value in address.items() if value is not None} | {"pid": os.getpid()}
    umask = os.umask(OWNER_ONLY)
    try:
        write_whole(path, json.dumps(ready, indent=2) + "\n")
    except OSError as error:
        fail(f"--ready-file {path}: {error.strerror}; give another file")
    finally:
        os.umask(umask)
    try:
        yield
    finally:
        if path.is_file():  # a device file is not removed
            path.unlink(missing_ok=True)
