"""The NMT slave, as transcripts: boot-up, the five commands, what lives in which state (manual, section 2.2)."""

from __future__ import annotations

import pytest

from drive_env.canopen.frames import Frame
from drive_env.canopen.nmt import NmtState
from drive_env.canopen.node import Node
from drive_env.firmware.common import fsa


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


def test_what_lives_in_which_state(wire):
    wire.play("""
        rx 605  2B 17 10 00 64 00 00 00   # heartbeat every 100 ms
        tx 585  60 17 10 00 00 00 00 00
        wait 1 ms
        tx 705  7F                        # pre-operational: it begins at once
        rx 080                            # no PDO on SYNC
        rx 205  06 00                     # no RPDO
        rx 605  40 41 60 00 00 00 00 00
        tx 585  4B 41 60 00 50 02 00 00
        rx 000  01 05                     # operational
        wait 1 ms
        tx 185  50 02                     # event-driven PDOs tell their values
        tx 285  50 02 00
        rx 080
        tx 385  50 02 .. .. .. ..
        tx 485  50 02 .. .. .. ..
        rx 205  06 00
        wait 1 ms
        tx 185  31 02
        tx 285  31 02 00
        rx 605  40 41 60 00 00 00 00 00
        tx 585  4B 41 60 00 31 02 00 00
        rx 000  02 05                     # stopped
        rx 080
        rx 205  00 00
        rx 605  40 41 60 00 00 00 00 00
        wait 97 ms
        wait 1 ms
        tx 705  04                        # error control lives
        rx 000  80 05
        rx 605  40 41 60 00 00 00 00 00
        tx 585  4B 41 60 00 31 02 00 00   # the RPDO of before was not taken
        rx 080
        rx 205  00 00
        wait 99 ms
        wait 1 ms
        tx 705  7F
    """)


def test_a_moving_axis_brakes_on_the_quick_stop_ramp_when_stopped(wire):
    wire.enable()
    assert wire.download(0x6085, 0, 2_000_000, 4) == 0
    assert wire.download(0x60FF, 0, 500_000, 4) == 0
    wire.wait(300)
    assert wire.value(0x606C) > 450_000
    wire.receive(0, "02 05")
    wire.wait(100)
    assert wire.node._axes[0].state == fsa.State.FAULT_REACTION_ACTIVE
    assert 200_000 < wire.drives.read(0x606C)[0] < 400_000
    wire.wait(300)
    assert wire.node._axes[0].state == fsa.State.FAULT
    assert abs(wire.drives.read(0x606C)[0]) < 20_000


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
