"""Parameters are written all or none: verified, taken back, and said so when even that fails."""

from __future__ import annotations

import pytest
from scripted_drive import ScriptedBus, ScriptedDrive

from drive_env import CanDrives
from drive_env.master.parameters import NotRestoredError, RollbackError, compare, parameters, write_all_or_none

WANTED = {(0x6081, 0): 77, (0x2003, 0): 500, (0x6065, 0): 99}
REFUSED = 0x06090030


@pytest.fixture
def drive():
    return ScriptedDrive(values={(0x6081, 0): (1, 4), (0x2003, 0): (2, 4), (0x6065, 0): (3, 4)})


@pytest.fixture
def drives(drive):
    with ScriptedBus(drive) as bus, CanDrives(bus=bus, pace="lockstep", safety=False, timeout=0.02) as made:
        yield made


def values(drive):
    return [drive.get(*key) for key in WANTED]


def test_only_what_differs_is_written(drives, drive):
    drive.set(0x2003, 500)
    changes = write_all_or_none(drives, WANTED)
    assert [(change.entry.index, change.found, change.wanted) for change in changes] == [
        (0x6081, 1, 77),
        (0x6065, 3, 99),
    ]
    assert values(drive) == [77, 500, 99]
    assert compare(drives, WANTED) == []


def test_a_refusal_takes_back_what_was_written_before_it(drives, drive):
    drive.refusals[0x6065, 0] = REFUSED
    with pytest.raises(NotRestoredError, match=r"refused the write of 99 to 6065h.*everything was taken back"):
        write_all_or_none(drives, WANTED)
    assert values(drive) == [1, 2, 3]


def test_a_value_that_does_not_read_back_is_a_failure(drives, drive, monkeypatch):
    truly = drive.set
    monkeypatch.setattr(
        drive, "set", lambda index, value, sub=0: truly(index, min(value, 400) if index == 0x2003 else value, sub)
    )
    with pytest.raises(
        NotRestoredError, match=r"does not hold what was written: 2003h:00 Maximum Current is 400, not 500"
    ):
        write_all_or_none(drives, WANTED)
    assert values(drive) == [1, 2, 3]


def test_a_rollback_that_fails_names_what_is_left(drives, drive, monkeypatch):
    truly = drive.set

    def jam(index, value, sub=0):
        truly(index, value, sub)
        drive.refusals[0x6065, 0] = drive.refusals[0x6081, 0] = REFUSED  # from the first write on

    monkeypatch.setattr(drive, "set", jam)
    with pytest.raises(
        RollbackError, match=r"refused the write of 99 to 6065h.*taking it back failed: .* holds a mixture"
    ):
        write_all_or_none(drives, WANTED)
    assert values(drive) == [77, 500, 3] or values(drive) == [77, 2, 3]


def test_a_drive_that_falls_silent_is_a_mixture(drives, drive):
    truly = drive._sdo

    def deaf(data):
        return [] if drive.get(0x2003) == 500 else truly(data)

    drive._sdo = deaf
    with pytest.raises(RollbackError, match=r"did not answer .*; and taking it back failed: .* did not answer"):
        write_all_or_none(drives, WANTED)


def test_an_object_that_the_drive_has_not_is_told_before_anything_is_written(drives, drive):
    with pytest.raises(NotRestoredError, match=r"the drive has no 605Ah:00 .*; nothing was written"):
        write_all_or_none(drives, {**WANTED, (0x605A, 0): 2})
    assert values(drive) == [1, 2, 3]


def test_commands_and_services_are_no_parameters(drives):
    indices = {entry.index for entry in parameters(drives)}
    assert not indices & {0x1010, 0x1011, 0x6040, 0x6060, 0x607A, 0x60FF, 0x5FFF}
    assert {0x2003, 0x2042, 0x6081, 0x1400, 0x1A00} <= indices
