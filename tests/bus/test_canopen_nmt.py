"""The NMT slave, as transcripts: boot-up, the five commands, what lives in which state (manual, section 2.2)."""

from __future__ import annotations

import pytest

from drive_env.canopen.frames import Frame
from drive_env.canopen.nmt import NmtState
from drive_env.canopen.node import Node


def test_a_node_boots_into_pre_operational(drives):
    sent = []
    node = Node(127, drives, send=sent.append)
    assert node.state is NmtState.INITIALISING
    node.receive(Frame(0, b"\x01\x00"), 0.0)
    node.after_cycle(0.001)
    assert sent == [], "it is off"
    node.power_on(0.002)
    assert sent == [Frame(0x77F, b"\x00")]
    assert node.state is NmtState.PRE_OPERATIONAL


@pytest.mark.parametrize("node_id", [0, 128, -1])
def test_a_node_has_a_number_that_canopen_knows(drives, node_id):
    with pytest.raises(ValueError, match=f"node {node_id} is impossible: CANopen has nodes 1 to 127"):
        Node(node_id, drives, send=print)


def test_a_node_has_axes_that_the_drives_have(drives):
    with pytest.raises(ValueError, match="first_axis=1: tmcm1636 has 1 of the 1 axes"):
        Node(1, drives, 1, send=print)


def test_the_boot_loader_speaks_no_canopen(wire):
    wire.enable()
    wire.play("""
        rx 605  23 FF 5F 00 78 56 34 12
        tx 585  60 FF 5F 00 00 00 00 00
        rx 605  40 41 60 00 00 00 00 00
        rx 000  81 05
        rx 705  RTR
        wait 10 ms
    """)
    assert wire.drives.read(0x6041)[0] & 0x4F == 0x40, "no firmware drives the motor"
    wire.node.power_on(wire.now)
    wire.play("""
        wait 1 ms
        tx 705  00
        rx 605  40 FF 5F 00 00 00 00 00
        tx 585  43 FF 5F 00 00 00 00 00
    """)
