"""CanDrives against a scripted drive: what goes over the wire, and what is said when something is wrong with it.

That it gives the integers of the emulator is tests/firmware/test_parity.py's.
"""

from __future__ import annotations

import re
import time

import pytest
from rigs.scripted_drive import ScriptedBus, ScriptedDrive

from drive_env import CanDrives, ObjectAccessError, motion
from drive_env.devices import find_device
from drive_env.fieldbus.errors import BusError, NoAnswerError
from drive_env.master.can.mapping import Slots
from drive_env.master.can.pdo import INTO_DRIVE, slots

EDS = find_device("tmcm1636").eds.read_text(encoding="utf-8")


@pytest.fixture
def drive():
    return ScriptedDrive()


@pytest.fixture
def bus(drive):
    with ScriptedBus(drive) as made:
        yield made


@pytest.fixture
def drives(bus):
    with CanDrives(bus=bus, pace="lockstep", safety=False, timeout=0.05) as made:
        bus.log.clear()
        yield made


def transcript(bus):
    return [f"{can_id:03X}  {data.hex(' ').upper()}".strip() for can_id, data, _ in bus.log]


# --- SDO ----------------------------------------------------------------------------------------------------------
def test_read_and_write_are_sdo_transfers(drives, bus):
    drives.write("Target velocity", -2)
    assert drives.read(0x60FF) == [-2]
    assert transcript(bus) == [
        "601  23 FF 60 00 FE FF FF FF",  # download 60FFh, four bytes
        "601  40 FF 60 00 00 00 00 00",  # upload
    ]


def test_a_long_text_comes_in_segments(drives):
    assert list(drives.read(0x1008)) == ["TMCM-1636"]


def test_an_abort_says_node_object_value_meaning_and_remedy(drives, drive):
    drive.refusals[0x6060, 0] = 0x08000022
    with pytest.raises(ObjectAccessError) as error:
        drives.write(0x6060, 3)
    assert error.value.abort_code == 0x08000022
    assert re.search(
        r"node 1 refused the write of 3 to 6060h:00 Modes of operation: the drive's present state does not allow it; "
        r"read the statusword",
        str(error.value),
    )


def test_a_silent_node_is_named_with_what_to_try_and_soon(drives, drive, bus):
    drive.silent.add((0x6064, 0))
    before = time.monotonic()
    with pytest.raises(
        NoAnswerError, match=r"node 1 did not answer the read of 6064h:00 .* within 0\.05 s; check power"
    ):
        drives.read(0x6064)
    assert time.monotonic() - before >= 0.1  # a read is asked for twice
    abort = "601  80 64 60 00 00 00 04 05"  # 0504 0000h, with the object's name
    request = "601  40 64 60 00 00 00 00 00"
    assert transcript(bus) == [request, abort, request, abort]


def test_flooded_with_foreign_frames_it_still_answers(drives, bus):
    for k in range(3000):
        bus.push(0x100 + k % 0x70, b"\x01")
    assert drives.read(0x6041) == [0x0240]


# --- PDO ----------------------------------------------------------------------------------------------------------
def test_a_tpdo_is_remapped_off_empty_filled_counted_on(drives, bus):
    drives.record([0x6041, 0x6064], 0.001)
    assert transcript(bus) == [
        "000  01 01",  # PDOs live in operational
        "601  40 00 1A 00 00 00 00 00",  # as it was
        "601  40 00 18 01 00 00 00 00",
        "601  40 00 18 02 00 00 00 00",
        "601  40 00 1A 01 00 00 00 00",
        "601  40 00 1A 02 00 00 00 00",  # not in use, and to be put back all the same
        "601  23 00 18 01 81 01 00 C0",  # off (bit 31); bit 30 stays
        "601  2F 00 18 02 01 00 00 00",  # at each SYNC
        "601  2F 00 1A 00 00 00 00 00",  # empty
        "601  23 00 1A 01 20 00 64 60",  # widest first
        "601  23 00 1A 02 10 00 41 60",
        "601  2F 00 1A 00 02 00 00 00",
        "601  23 00 18 01 81 01 00 40",  # on
        "601  40 01 18 01 00 00 00 00",
        "601  40 01 18 02 00 00 00 00",  # event-driven: it may go on
        "601  40 02 18 01 00 00 00 00",
        "601  40 02 18 02 00 00 00 00",
        "601  23 02 18 01 81 03 00 C0",  # goes with SYNC: off, since nobody asked for it
        "601  40 03 18 01 00 00 00 00",
        "601  40 03 18 02 00 00 00 00",
        "601  23 03 18 01 81 04 00 C0",
        "080",
    ]


def test_set_points_go_out_before_their_sync(drives, bus, drive):
    drive.motion = lambda d: d.set(0x6064, d.get(0x6064) + d.get(0x60FF))
    drives.record([0x6064], 0.001, play={0x60FF: [0]})
    bus.log.clear()
    trace = drives.record([0x6064], 0.003, play={0x60FF: [1, -2, 3]})
    assert transcript(bus) == [
        "201  01 00 00 00", "080", "201  FE FF FF FF", "080", "201  03 00 00 00", "080",
    ]  # fmt: skip
    assert trace[0x6064][:, 0].tolist() == [0, 1, -1]  # row k is sampled at SYNC k, before the cycle
    assert trace.t.tolist() == [0.0, 0.001, 0.002]


# --- network ------------------------------------------------------------------------------------------------------
def test_closed_drives_say_so(bus):
    drives = CanDrives(bus=bus, pace="lockstep")
    drives.close()
    drives.close()
    with pytest.raises(BusError, match="closed"):
        drives.read(0x6041)


# --- other devices ------------------------------------------------------------------------------------------------
def test_a_known_device_has_its_own_traits(drives, drive):
    drives.record([0x6041], 0.001, play={0x60FF: [1]})
    assert drive.get(0x1400, 2) == 0  # TMCM-1636 manual, 3.1.17
    assert slots(drives.description, INTO_DRIVE, 0) == Slots((0, 1, 2, 3), 3)


@pytest.mark.parametrize(
    ("options", "name", "seconds"),
    [({}, 0x6041, 0.5), ({}, (0x1010, 1), 10.0), ({"timeout": 2.0}, 0x6041, 2.0), ({"timeout": 2.0}, (0x1011, 1), 10.0),
     ({"timeouts": {(0x1010, 1): 20.0}}, (0x1010, 1), 20.0)],
)  # fmt: skip
@pytest.mark.parametrize("patient_masters", [None], ids=["as they are"])
def test_time_outs_are_the_devices_unless_given(bus, patient_masters, options, name, seconds):
    with CanDrives(bus=bus, pace="lockstep", **options) as drives:
        assert drives.description.patience(drives.description.dictionary.find(name)) == seconds


def test_a_file_that_is_no_eds_of_a_drive_is_told(tmp_path):
    with pytest.raises(ValueError, match=r"there is no EDS at .*missing\.eds"):
        CanDrives(eds=tmp_path / "missing.eds")
    path = tmp_path / "io.eds"
    path.write_text(EDS[: EDS.index("[6040]")], encoding="utf-8")
    with pytest.raises(ValueError, match="describes no CiA 402 drive: it has no statusword"):
        CanDrives(eds=path)
    path.write_text("]garbage", encoding="utf-8")
    with pytest.raises(ValueError, match="describes no CiA 402 drive: it has no statusword"):
        CanDrives(eds=path)


# --- dry run ------------------------------------------------------------------------------------------------------
def test_a_dry_run_prints_frames_and_opens_nothing(capsys):
    with CanDrives(dry_run=True, nodes=[4]) as drives:
        motion.enable(drives, mode="pp")
        motion.move_to(drives, 1000)
        drives.record([0x6064], 0.002, play={0x60FF: [1, 2]})
        motion.disable(drives)
    lines = capsys.readouterr().out.splitlines()
    assert "604   [8]  2B 40 60 00 0F 00 00 00" in lines
    assert "604   [8]  23 7A 60 00 E8 03 00 00" in lines
    assert lines.count("204   [4]  01 00 00 00") == 1  # an RPDO at its place before SYNC
    assert lines[lines.index("204   [4]  01 00 00 00") + 1] == "080   [0]"


def test_homing_that_the_drive_gives_up_is_told(bus, drive):
    with CanDrives(bus=bus, pace="lockstep") as drives:
        drive.motion = lambda d: d.set(0x6041, 0x0637)  # bit 10 without bit 12
        with pytest.raises(
            RuntimeError, match=r"axis 0 did not complete homing: statusword 0637h; check the method 6098h"
        ):
            motion.home(drives)
        drive.motion = lambda d: d.set(0x6041, 0x1637)
        motion.home(drives)
        assert drive.get(0x6040) == 0x0F
