"""What a program leaves behind on a bus: nothing, and where that cannot be, one line that says what."""

from __future__ import annotations

import logging
import threading
import time

import numpy as np
import pytest
from rigs.scripted_drive import ScriptedBus, ScriptedDrive

from drive_env import CanDrives
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.fieldbus.errors import BusError, NoAnswerError
from drive_env.fieldbus.tidying import Tidying

CONSUMER, FIRST_TPDO = (0x1016, 1), (0x1800, 1)


@pytest.fixture
def drive():
    return ScriptedDrive()


@pytest.fixture
def bus(drive):
    with ScriptedBus(drive) as made:
        yield made


def settings(drive):
    return {key: value for key, value in drive.values.items() if key[0] < 0x1B00}


def used(bus):
    """Return drives that have watched over their master and had PDOs of ours."""
    drives = CanDrives(bus=bus, timeout=0.1)
    drives.write(0x6060, 3)
    for word in (0x06, 0x07, 0x0F):
        drives.write(0x6040, word)
    drives.record([0x6041, 0x6064], 0.002, play={0x60FF: np.array([1, 2]), 0x6040: np.array([15, 15])})
    drives.write(0x6040, 0x00)
    return drives


def test_everything_is_as_it_was_unused_entries_of_mappings_too(drive, bus, caplog):
    before = settings(drive)
    drives = used(bus)
    assert settings(drive) != before and drive.values[CONSUMER][0] != 0
    drives.close()
    assert settings(drive) == before
    assert not caplog.records


def test_heartbeats_go_on_until_the_drive_no_longer_waits_for_them(drive, bus):
    drives = used(bus)
    bus.log.clear()
    alive = []
    truly = drive.receive

    def receive(can_id, data, remote):
        if can_id == 0x601 and data[1:4] == b"\x16\x10\x01" and data[0] & 0xE0 == 0x20:
            alive.append(any(thread.name == "drive supervisor" for thread in threading.enumerate()))
        return truly(can_id, data, remote)

    drive.receive = receive
    drives.close()
    assert alive == [True]


def test_a_node_that_was_stopped_is_woken_to_be_put_back(drive, bus, caplog):
    """In the NMT state stopped no SDO is answered (CiA 301, 7.3.2.2.4): a node gets there when it misses heartbeats."""
    before = settings(drive)
    drives = used(bus)
    stopped = [True]
    truly = drive.receive

    def receive(can_id, data, remote):
        if can_id == 0x000 and data[0] in (0x01, 0x80):
            stopped.clear()
        return [] if stopped and can_id == 0x601 else truly(can_id, data, remote)

    drive.receive = receive
    drives.close()
    assert settings(drive) == before
    assert not [record for record in caplog.records if record.levelno >= logging.ERROR]


@pytest.mark.slow
def test_a_node_that_is_gone_costs_a_few_waits_and_a_line_for_each_matter(drive, bus, caplog):
    drives = used(bus)
    asked = []
    drive.receive = lambda can_id, data, remote: asked.append(can_id) or []
    drives.close()
    lines = [record.getMessage() for record in caplog.records]
    assert "node 1 could not be proved to be off: its watchdog stays on and it gets no more heartbeats" in lines[-1]
    assert len(lines) <= 6
    beats = sum(0x760 <= can_id <= 0x77F for can_id in asked)
    # Quick stop and voltage off go on being sent blindly; twice the last heartbeats, after which it watches anew.
    assert asked.count(0x601) <= 400 and beats <= 16
    time.sleep(0.5)
    assert sum(0x760 <= can_id <= 0x77F for can_id in asked) == beats


def test_steps_are_tried_whatever_becomes_of_the_others():
    done = []

    def fails(error):
        def act():
            raise error

        return act

    tidying = Tidying()
    for act in (fails(ObjectAccessError(0, "no")), lambda: done.append(1), fails(NoAnswerError("silent")),
                lambda: done.append(2), fails(NoAnswerError("silent")), fails(NoAnswerError("silent")),
                lambda: done.append("a silent node is not asked again")):  # fmt: skip
        tidying.step(act)
    assert done == [1, 2]
    with pytest.raises(BusError, match=r"^no.* \(and 3 more\)$"):
        tidying.end()
    Tidying().end()
