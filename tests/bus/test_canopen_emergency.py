"""Emergencies, as transcripts: codes of table 303, error register, inhibit time, identifier, error behaviour."""

from __future__ import annotations

import pytest
from rigs.canopen_wire import Wire

from drive_env.canopen.emergency import QUEUE
from drive_env.canopen.nmt import NmtState
from drive_env.devices import find_device
from drive_env.firmware.servo.causes import CAUSES
from drive_env.node.error_history import CONDITIONS


@pytest.fixture
def wire(drives):
    drives.machine.reset()
    drives.machine.enable_input = True
    yield Wire(drives)
    drives.machine.enable_input = True


def test_every_cause_and_condition_has_a_row_in_the_device():
    assert set(find_device("tmcm1636").emergencies) == {cause.name for cause in CAUSES} | set(CONDITIONS)


def test_a_full_queue_loses_the_newest(wire):
    wire.start()
    assert wire.download(0x1015, 0, 10_000, 2) == 0  # one second
    for k in range(2 * QUEUE):
        wire.receive(0x205, "00" if k % 2 == 0 else "00 00 00")
    wire.wait(10_000)
    codes = [frame.data[:2].hex() for frame in wire.take()]
    assert codes == ["2082", "1082"] * (QUEUE // 2), "the first went at once"


def test_stopped_tells_later(wire):
    wire.enable()
    wire.start()
    wire.drives.machine.enable_input = False
    wire.wait(1)
    assert [str(f) for f in wire.take() if f.can_id == 0x085] == ["085  41 54 81 00 FF 00 00 00"]
    wire.play("""
        rx 000  02 05
        wait 10 ms
    """)
    wire.node.overrun(wire.now)
    wire.play("""
        wait 10 ms
        rx 000  80 05
        tx 085  10 81 91 01 FF 00 00 00
    """)


def test_an_error_that_nobody_was_told_of_has_no_end(wire):
    wire.start()
    wire.play("""
        rx 605  23 14 10 00 85 00 00 80   # off
        tx 585  60 14 10 00 00 00 00 00
        rx 205  00
        rx 605  23 14 10 00 85 00 00 00   # on
        tx 585  60 14 10 00 00 00 00 00
        rx 205  00 00
        wait 10 ms
    """)


# --- bus-off ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_bus_off_enters_stopped_by_default(wire):
    wire.enable()
    wire.start()
    wire.node.bus_off(wire.now)
    wire.wait(5)
    wire.node.bus_on(wire.now)
    wire.play("""
        rx 605  40 41 60 00 00 00 00 00   # stopped: silent
        rx 000  80 05
        tx 085  40 81 11 00 FF 00 00 00
    """)


def test_recovery_without_bus_off_is_nothing(wire):
    wire.node.bus_on(wire.now)
    assert wire.take() == []


# --- error behaviour --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("raw", [0, 1])
def test_in_pre_operational_no_error_changes_the_state(wire, raw):
    assert wire.download(0x1029, 2, raw, 1) == 0
    wire.enable()
    wire.drives.machine.enable_input = False
    wire.wait(2)
    assert wire.node.state is NmtState.PRE_OPERATIONAL
