"""Whether this machine has SocketCAN with an interface for tests: what runs on python-can's virtual bus runs there too.

sudo ip link add vcan0 type vcan && sudo ip link set vcan0 up
"""

from __future__ import annotations

import socket

import pytest

CHANNEL = "vcan0"


def _missing() -> str:
    """Return why there is none; empty if there is one."""
    if not hasattr(socket, "AF_CAN"):
        return "this Python has no AF_CAN"
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as probe:
            probe.bind((CHANNEL,))
    except OSError as error:
        return f"no SocketCAN interface {CHANNEL}: {error.strerror}"
    return ""


# A value for pytest.mark.parametrize and fixtures, beside "virtual".
SOCKETCAN = pytest.param("socketcan", marks=pytest.mark.skipif(bool(_missing()), reason=_missing()))
