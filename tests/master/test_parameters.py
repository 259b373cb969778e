"""Parameters are written all or none: verified, taken back, and said so when even that fails."""

from __future__ import annotations

import contextlib
import dataclasses
from types import SimpleNamespace

import pytest
from rigs.held_objects import HeldObjects
from rigs.scripted_drive import ScriptedBus, ScriptedDrive

from drive_env import CanDrives
from drive_env.devices import device_names, find_device
from drive_env.dictionary.entries import Entry
from drive_env.master.parameters import (
    COMMANDS,
    CommandObjectError,
    Difference,
    NotRestoredError,
    RollbackError,
    _in_order,
    _pdo_of,
    check_at_rest,
    check_no_commands,
    command,
    compare,
    list_differences,
    parameters,
    read_parameters,
    restorable,
    write_all_or_none,
)

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


# --- the order of writes ----------------------------------------------------------------------------------------------
OFF = 0x80000000  # bit 31 of a COB-ID (CiA 301)
TPDO = {
    (0x1800, 1): 0x181, (0x1800, 2): 255, (0x1800, 5): 0, (0x1A00, 0): 2, (0x1A00, 1): 0x60410010,
    (0x1A00, 2): 0x60640020, (0x1A00, 3): 0,
}  # fmt: skip
EMPTY_AND_ON = [
    ((0x1A00, 0), 0),
    ((0x1A00, 1), 0x60410010),
    ((0x1A00, 2), 0x60640020),
    ((0x1A00, 0), 2),
    ((0x1800, 1), 0x181),
]


@pytest.mark.parametrize(
    ("changes", "written"),
    [
        ({(0x6081, 0): 5, (0x1017, 0): 7}, [((0x6081, 0), 5), ((0x1017, 0), 7)]),
        # A transmission type is written while the PDO is off, and the mapping as it was.
        ({(0x1800, 2): 1}, [((0x1800, 1), 0x181 | OFF), ((0x1800, 2), 1), *EMPTY_AND_ON]),
        ({(0x1800, 1): 0x182}, [((0x1800, 1), 0x181 | OFF), *EMPTY_AND_ON[:-1], ((0x1800, 1), 0x182)]),
        ({(0x1800, 1): 0x181 | OFF, (0x6081, 0): 5},
         [((0x6081, 0), 5), ((0x1800, 1), 0x181 | OFF), *EMPTY_AND_ON[:-1], ((0x1800, 1), 0x181 | OFF)]),
        ({(0x1A00, 0): 1}, [((0x1800, 1), 0x181 | OFF), ((0x1A00, 0), 0), ((0x1A00, 1), 0x60410010), ((0x1A00, 0), 1),
                            ((0x1800, 1), 0x181)]),
        # An entry beyond those in use is written if it changes.
        ({(0x1A00, 3): 0x60770010}, [((0x1800, 1), 0x181 | OFF), *EMPTY_AND_ON[:3], ((0x1A00, 3), 0x60770010),
                                     *EMPTY_AND_ON[3:]]),
        ({(0x1801, 2): 1}, [((0x1801, 2), 1)]),  # of a PDO that is not there
    ],
)  # fmt: skip
def test_a_pdo_is_switched_off_and_emptied_then_filled_then_switched_on(changes, written):
    assert list(_in_order(changes, TPDO)) == written


@pytest.mark.parametrize(("index", "base"), [
    (0x1400, 0x1400), (0x15FF, 0x15FF), (0x1600, 0x1400), (0x17FF, 0x15FF), (0x1800, 0x1800), (0x19FF, 0x19FF),
    (0x1A00, 0x1800), (0x1BFF, 0x19FF), (0x13FF, None), (0x1C00, None), (0x6041, None),
])  # fmt: skip
def test_which_pdo_an_object_belongs_to(index, base):
    assert _pdo_of(index) == base


def test_differences_are_told_up_to_the_fifth():
    entries = [Entry(0x2000 + k, 0, "it", 8, "rw", 0, 9, 0, "", False) for k in range(7)]
    rows = [Difference(entry, 2, k) for k, entry in enumerate(entries)]
    assert list_differences(rows[:1]) == "2000h:00 it is 0, not 2"
    assert list_differences(rows[:5]).count("not 2") == 5 and "more" not in list_differences(rows[:5])
    assert list_differences(rows).endswith("2004h:00 it is 4, not 2 and 2 more")


def test_commands_of_further_axes_are_commands_and_what_makes_a_node_mute_is_never_written_back():
    hints = find_device("tmcm1636").master
    assert command(0x6840, hints) == command(0x6040, hints) == "controlword: a command"
    assert command(0x1010, hints) == "store: a service" and command(0x6081, hints) == ""
    with pytest.raises(
        CommandObjectError, match=r"f holds objects that are not parameters: 6040h .* 60FFh .*Nothing was"
    ):
        check_no_commands([(0x6040, 0), (0x6081, 0), (0x60FF, 0), (0x6040, 0)], "f", hints)
    check_no_commands([(0x6081, 0)], "f", hints)
    address = next(iter(hints.addresses))
    assert restorable({(address, 0): 1, (0x6081, 0): 2}, hints) == {(0x6081, 0): 2}


def test_no_node_id_and_no_bit_rate_is_ever_written_back():
    for device in map(find_device, device_names()):
        objects = [device.canopen.objects.get(what) for what in ("node_id", "bit_rate")]
        assert {key[0] for key in objects if key} <= set(device.master.addresses), device.name


def test_what_commands_and_serves_by_cia_301_and_402():
    services = {0x1003, 0x1010, 0x1011, 0x1F50, 0x1F51, 0x1F52}
    commands = {0x6040, 0x6042, 0x6060, 0x6071, 0x607A, 0x60B0, 0x60B1, 0x60B2, 0x60B8, 0x60C1, 0x60FE, 0x60FF}
    assert set(COMMANDS) == services | commands
    for index, told in COMMANDS.items():
        assert told.endswith(": a service" if index in services else ": a command")


# --- at rest ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("keys", "affected"),
    [
        ([(0x2003, 0), (0x6081, 0)], [4]),
        ([(0x2000, 0)], [4]),
        ([(0x1FFF, 0)], [3, 4, 5]),  # how a node talks is of all its axes
        ([(0x6081, 0), (0x1400, 1)], [3, 4, 5]),
        ([(0x6881, 0)], [3, 4, 5]),  # by a further axis' own index
        ([], [4]),
    ],
)
def test_no_axis_that_a_change_touches_may_be_enabled(keys, affected):
    for live in range(6):
        drives = SimpleNamespace(
            nodes=(1, 2),
            description=SimpleNamespace(num_axes=3, dictionary=SimpleNamespace(find=lambda index: index)),
            read_axis=lambda index, axis, live=live: 0x0637 if (index, axis) == (0x6041, live) else 0x0240,
        )
        said = pytest.raises(NotRestoredError, match=f"^axis {live} is enabled, and parameters are not exchanged")
        with said if live in affected else contextlib.nullcontext():
            check_at_rest(drives, keys, 4)


def held(values, axes=2, refused=()):
    """Drives of one node that hold parameters, whose `log` has what was written."""
    drives = HeldObjects(values, axes, refused=refused)
    entries = {**drives.entries}
    drives.description.dictionary = type(
        "Known",
        (),
        {
            "find": lambda self, key: entries[key if isinstance(key, tuple) else (key, 0)],
            "__iter__": lambda self: iter(entries.values()),
        },
    )()
    drives.description.hints = find_device("tmcm1636").master
    drives.description.is_number = lambda entry: entry.index != 0x1008
    drives.description.of_further_axes = dict
    drives.write_axis = drives.write_raw
    return drives


def test_the_parameters_of_an_axis_are_what_it_shows_of_all_that_stays():
    drives = held({(0x6081, 0): (5, 6), (0x6040, 0): 1, (0x1008, 0): 2, (0x6064, 0): 3}, refused=((0x6065, 0),))
    drives.entries[0x6064, 0] = None
    assert read_parameters(drives) == {(0x6081, 0): 5, (0x6064, 0): 3}
    assert read_parameters(drives, 1) == {(0x6081, 0): 6, (0x6064, 0): 3}


@pytest.mark.parametrize(("access", "stays"), [("rw", True), ("rwr", True), ("rww", True), ("ro", False),
                                               ("wo", False), ("const", False)])  # fmt: skip
def test_a_parameter_can_be_read_and_written(access, stays):
    drives = held({(0x6081, 0): 5})
    entry = dataclasses.replace(drives.entries[0x6081, 0], access=access)
    drives.description.dictionary = [entry]
    assert parameters(drives) == ([entry] if stays else [])


def test_what_a_device_counts_of_further_axes_is_no_parameter_either():
    """210Bh of the TMCM-6212, a step counter, is 230Bh of the axis 1."""
    drives = held({(0x210B, 1): 5, (0x230B, 1): 6, (0x2303, 0): 7})
    drives.description.hints = find_device("tmcm6212").master
    drives.description.of_further_axes = lambda: {(0x230B, 1): (drives.entries[0x210B, 1], 1)}
    assert [entry.index for entry in parameters(drives)] == [0x2303]


def test_where_an_axis_differs_and_what_it_has_not():
    drives = held({(0x6081, 0): (5, 6)}, refused=((0x6065, 0),))
    found = compare(drives, {(0x6081, 0): 6, (0x6065, 0): 7})
    assert [(one.entry.index, one.wanted, one.found) for one in found] == [(0x6081, 6, 5), (0x6065, 7, None)]
    assert [one.entry.index for one in compare(drives, {(0x6081, 0): 6, (0x6065, 0): 7}, 1)] == [0x6065]


def test_a_pdo_that_changes_is_read_whole_before_and_written_back_whole():
    """A value that the drive does not keep: what was changed is taken back, the last one first."""
    values = {(0x6041, 0): 0x0240, **TPDO, (0x1801, 1): 0x281, (0x6081, 0): 1, (0x6065, 0): 3}
    drives = held(values, axes=1)
    drives.takes[0x6065, 0] = lambda value: 3
    with pytest.raises(NotRestoredError, match=r"6065h.* is 3, not 4; everything was taken back"):
        write_all_or_none(drives, {(0x6081, 0): 2, (0x1A00, 0): 1, (0x6065, 0): 4})
    written = [(key, value) for key, _, value in drives.log]
    off = [((0x1800, 1), 0x181 | OFF), ((0x1A00, 0), 0)]
    assert written[:2] == [((0x6081, 0), 2), ((0x6065, 0), 4)]
    assert written[2:] == [*off, ((0x1A00, 1), 0x60410010), ((0x1A00, 0), 1), ((0x1800, 1), 0x181),
                           ((0x6081, 0), 1), *off, ((0x1A00, 1), 0x60410010), ((0x1A00, 2), 0x60640020),
                           ((0x1A00, 0), 2), ((0x1800, 1), 0x181)]  # fmt: skip
    assert {key: int(drives.values[key][0]) for key in values} == values


def test_what_cannot_be_taken_back_is_named():
    drives = held({(0x6041, 0): 0x0240, (0x6081, 0): 1, (0x6065, 0): 3}, axes=1)
    drives.takes |= {(0x6065, 0): lambda value: 3, (0x6081, 0): lambda value: 2}
    with pytest.raises(RollbackError, match=r"these could not be taken back: 6081h.* is 2, not 1. Reset the node"):
        write_all_or_none(drives, {(0x6081, 0): 2, (0x6065, 0): 4})


def test_what_an_interrupted_write_changed_is_taken_back_by_its_kind():
    drives = held({(0x6041, 0): 0x0240, (0x6081, 0): 1, (0x6065, 0): 3}, axes=1)
    write = drives.write_axis

    def interrupted(entry, axis, value):
        if value == 4:
            raise KeyboardInterrupt
        write(entry, axis, value)

    drives.write_axis = interrupted
    with pytest.raises(NotRestoredError, match=r"^interrupted; everything was taken back"):
        write_all_or_none(drives, {(0x6081, 0): 2, (0x6065, 0): 4})
    assert drives.values[0x6081, 0] == 1
