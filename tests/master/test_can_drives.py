"""CanDrives against a scripted drive: what goes over the wire, and what is said when something is wrong with it.

That it gives the integers of the emulator is tests/firmware/test_parity.py's.
"""

from __future__ import annotations

import re
import subprocess
import sys
import time

import numpy as np
import pytest
from rigs.scripted_drive import ScriptedBus, ScriptedDrive
from rigs.tables import every_row

from drive_env import CanDrives, ObjectAccessError, motion
from drive_env.devices import find_device
from drive_env.dictionary import quantities
from drive_env.fieldbus.description import describe
from drive_env.fieldbus.errors import BusError, NoAnswerError, OpenError
from drive_env.master.can.mapping import Slots
from drive_env.master.can.pdo import INTO_DRIVE, OUT_OF_DRIVE, slots

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


def test_a_write_has_the_bytes_of_its_type(drives, bus):
    drives.write(0x6040, 6)
    drives.write(0x6060, 3)
    assert transcript(bus) == ["601  2B 40 60 00 06 00 00 00", "601  2F 60 60 00 03 00 00 00"]


def test_a_long_text_comes_in_segments(drives):
    assert list(drives.read(0x1008)) == ["TMCM-1636"]


@pytest.mark.parametrize(("raw", "value"), [(b"\xff\xff", -1), (b"\x00\x80", -(2**15)), (b"\xff\x7f", 2**15 - 1)])
def test_signed_objects_come_back_signed(drives, drive, raw, value):
    drive.values[0x6077, 0] = (int.from_bytes(raw, "little"), 2)
    assert drives.read(0x6077) == [value]


def test_more_bytes_than_the_type_has_are_forgiven_and_fewer_are_not(drives, drive):
    drive.values[0x6077, 0] = (-5, 4)
    assert drives.read(0x6077) == [-5]
    drive.values[0x6064, 0] = (7, 2)
    with pytest.raises(ObjectAccessError, match=r"6064h:00 .* 4 bytes by the EDS, and 2 came: 07 00"):
        drives.read(0x6064)


def test_what_the_eds_refuses_is_not_sent(drives, bus):
    for name, value in ((0x6041, 1), (0x2003, 45_001), (0x6071, 2.5)):
        with pytest.raises(ObjectAccessError):
            drives.write(name, value)
    assert bus.log == []


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


def test_an_object_may_have_its_own_patience(bus, drive):
    drive.silent.add((0x6064, 0))
    with CanDrives(bus=bus, pace="lockstep", safety=False, timeout=0.02, timeouts={0x6064: 0.15}) as drives:
        before = time.monotonic()
        with pytest.raises(NoAnswerError, match=r"within 0\.15 s"):
            drives.read(0x6064)
        assert time.monotonic() - before >= 0.3


def test_flooded_with_foreign_frames_it_still_answers(drives, bus):
    for k in range(3000):
        bus.push(0x100 + k % 0x70, b"\x01")
    assert drives.read(0x6041) == [0x0240]


def test_where_selects_axes_and_a_wrong_mask_is_told():
    nodes = [ScriptedDrive(node) for node in (3, 1)]
    with ScriptedBus(*nodes) as bus, CanDrives(bus=bus, nodes=(3, 1), pace="lockstep", safety=False) as drives:
        drives.write(0x60FF, [10, 20])
        drives.write(0x60FF, 99, where=np.array([False, True]))
        assert [node.get(0x60FF) for node in nodes] == [10, 99]
        with pytest.raises(ValueError, match=r"boolean array of shape \(2,\)"):
            drives.write(0x60FF, 1, where=np.array([True]))


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


def test_pdos_are_as_before_when_closed(drive, bus):
    def pdos():
        return {key: value for key, value in drive.values.items() if 0x1400 <= key[0] < 0x1B00}

    before = pdos()
    with CanDrives(bus=bus, pace="lockstep") as drives:
        drives.record([0x6041, 0x6064, 0x606C], 0.002, play={0x60FF: [1, 2], 0x6040: [0, 0]})
        assert pdos() != before
    assert pdos() == before


def test_what_cannot_be_mapped_is_told_with_what_can(drives, bus):
    with pytest.raises(
        ObjectAccessError, match=r"2003h:00 .* cannot be recorded: no TPDO of .* carries it; they carry .*6064h:00"
    ) as e:
        drives.record([0x2003], 0.001)
    assert e.value.abort_code == 0x06040041
    with pytest.raises(ObjectAccessError, match=r"6081h:00 .* cannot be played: no RPDO .*; they carry .*60FFh:00"):
        drives.record([0x6041], 0.001, play={0x6081: [1]})
    assert bus.log == []


def test_more_than_fits_is_told_with_the_room_there_is(drives):
    many = [0x6041, 0x6061, 0x6062, 0x6063, 0x6064, 0x606C, 0x6077, 0x607A, 0x60B0, 0x60B1, 0x60FD]
    with pytest.raises(
        ObjectAccessError, match=r"11 objects of 296 bits do not fit: tmcm1636 has 4 TPDOs .* at most 3"
    ):
        drives.record(many, 0.001)


def test_rows_that_do_not_fit_are_told(drives):
    with pytest.raises(ValueError, match=r"60FFh:00 .* takes shape \(2,\) or \(2, 1\), one row per cycle, not \(3,\)"):
        drives.record([0x6041], 0.002, play={0x60FF: [1, 2, 3]})
    with pytest.raises(ValueError, match="not a whole number of communication cycles"):
        drives.advance(0.0015)


def test_a_tpdo_that_stays_out_is_told(drives, drive):
    drives.record([0x6064], 0.001)
    drive.operational = False
    with pytest.raises(NoAnswerError, match=r"TPDO 1 of node 1 \(181h\) came 0 times for 4 SYNCs"):
        drives.record([0x6064], 0.004)


def test_a_tpdo_of_the_wrong_length_is_told(drives, drive):
    drives.record([0x6064], 0.001)
    drive.values[0x1A00, 1] = (0x60410010, 4)  # another master remapped it
    with pytest.raises(BusError, match=r"TPDO 1 of node 1 \(181h\) has 4 bytes by its mapping, and 2 came: 40 02"):
        drives.record([0x6064], 0.001)


def test_a_refused_mapping_is_told(drives, drive):
    drive.refusals[0x1A00, 1] = 0x06040041
    with pytest.raises(
        ObjectAccessError, match=r"node 1 refused the write of 1A00h:01 = .*: it cannot be mapped to a PDO"
    ):
        drives.record([0x6064], 0.001)


# --- network ------------------------------------------------------------------------------------------------------
def test_emergencies_come_with_axis_code_register_and_name():
    nodes = [ScriptedDrive(node) for node in (5, 4)]
    with ScriptedBus(*nodes) as bus, CanDrives(bus=bus, nodes=(5, 4), pace="lockstep") as drives:
        bus.push(0x084, bytes.fromhex("11 86 21 00 00 00 00 00"))
        bus.push(0x085, bytes.fromhex("01 FF 20 03 00 00 00 00"))
        bus.push(0x085, bytes.fromhex("34 12 01 01 02 03 04 05"))
        bus.push(0x085, bytes.fromhex("30 81 11 00 00"))  # no emergency: five bytes
        assert [tuple(message) for message in drives.emergencies()] == [
            (0, 0xFF01, 0x20, (3, 0, 0, 0, 0), "positive_limit_switch"),
            (0, 0x1234, 0x01, (1, 2, 3, 4, 5), "emergency_1234h"),
            (1, 0x8611, 0x21, (0, 0, 0, 0, 0), "following_error"),
        ]
        assert drives.emergencies() == []


def test_a_reset_waits_for_the_boot_up_and_a_missing_one_is_told(drives, drive, bus, monkeypatch):
    drives.reset_node()
    assert transcript(bus) == ["000  81 01"]
    monkeypatch.setattr("drive_env.master.can.network.BOOT_TIMEOUT", 0.05)
    monkeypatch.setattr(drive, "receive", lambda *_: [])
    with pytest.raises(NoAnswerError, match=r"node 1 sent no boot-up message \(700h \+ node\)"):
        drives.reset_node()


def test_closed_drives_say_so(bus):
    drives = CanDrives(bus=bus, pace="lockstep")
    drives.close()
    drives.close()
    with pytest.raises(BusError, match="closed"):
        drives.read(0x6041)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({}, "no CAN channel is given; give interface and channel .* or set DRIVE_ENV_INTERFACE"),
        ({"channel": "can0"}, "channel 'can0' needs an interface"),
        ({"channel": "127.0.0.1:29636"}, "a hub of `drive-env serve` is socket://127.0.0.1:29636"),
        ({"interface": "nonsense", "channel": "can0"}, "cannot open interface 'nonsense'"),
        ({"channel": "socket://127.0.0.1:9"}, "no hub answers at socket://127.0.0.1:9: .*; start `drive-env serve`"),
        ({"channel": "socket://nowhere"}, "is not an address; write it as socket://127.0.0.1:PORT"),
    ],
)
def test_a_bus_that_cannot_be_opened_is_told(options, text, monkeypatch):
    monkeypatch.delenv("DRIVE_ENV_CHANNEL", raising=False)
    monkeypatch.delenv("DRIVE_ENV_INTERFACE", raising=False)
    with pytest.raises(OpenError, match=text):
        CanDrives(**options)


@pytest.mark.parametrize("nodes", [(), (0,), (128,), (1, 1)])
def test_nodes_that_cannot_be_are_told(nodes, bus):
    with pytest.raises(ValueError, match="nodes are different numbers of 1 to 127"):
        CanDrives(bus=bus, nodes=nodes)


def test_real_time_paces_syncs_by_the_clock(drive, bus):
    with CanDrives(bus=bus, safety=False) as drives:
        drives.record([0x6041], 0.001)
        drive.syncs = 0
        before = time.perf_counter()
        drives.advance(0.05)
        passed = time.perf_counter() - before
        assert passed >= 0.05
        assert 1 <= drive.syncs <= 50  # 50 unless the computer is busy
        assert drives.timing.cycles == drive.syncs


def test_a_late_program_keeps_the_time_of_advance_and_the_rows_of_record(drive, bus):
    with CanDrives(bus=bus, safety=False) as drives:
        drives.record([0x6041], 0.001)
        drive.motion = lambda d: time.sleep(0.005)  # every fifth SYNC is possible
        drive.syncs = 0
        drives.advance(0.1)
        assert drive.syncs <= 25
        drive.syncs = 0
        assert len(drives.record([0x6041], 0.01)) == 10
        assert drive.syncs == 10
        assert drives.timing.late >= 8
        assert drives.timing.worst > 0.003


# --- other devices ------------------------------------------------------------------------------------------------
def two_axes():
    """The EDS of a drive with two axes: CiA 402's objects once more at 6800h."""
    more = re.sub(r"(?m)^\[6([0-7])", lambda m: f"[6{int(m[1]) + 8:X}", EDS[EDS.index("[6040]") :])
    more = more[: more.index("[ManufacturerObjects]")]
    more = re.sub(r"(?m)^(ParameterName=.*)$", r"\1 of axis 1", more)
    return EDS + "\n" + more


def test_a_drive_with_two_axes_has_the_second_at_the_offset(tmp_path):
    path = tmp_path / "two.eds"
    path.write_text(two_axes(), encoding="utf-8")
    node = ScriptedDrive(2, axes=2)
    node.motion = lambda d: (d.set(0x6064, d.get(0x60FF)), d.set(0x6864, d.get(0x68FF)))
    with ScriptedBus(node) as bus, CanDrives(eds=path, bus=bus, nodes=[2], pace="lockstep") as drives:
        assert drives.num_axes == 2
        drives.write(0x60FF, [5, -6])
        assert (node.get(0x60FF), node.get(0x68FF)) == (5, -6)
        assert drives.read(0x60FF).tolist() == [5, -6]
        motion.enable(drives, mode="csv")
        trace = drives.record([0x6064], 0.002, play={0x60FF: [[1, 2], [3, 4]]})
        assert trace[0x6064].tolist() == [[0, 0], [1, 2]]
        assert node.get(0x1600 + 2, 1) == 0x68FF0020  # its own half of the PDOs
        with pytest.raises(ValueError, match="a node is reset with all its axes"):
            drives.reset_node(where=np.array([True, False]))
    assert slots(describe(None, path), OUT_OF_DRIVE, 1) == Slots((2, 3), 3)


def test_a_vendor_file_in_cp1252_is_read(tmp_path, drive, bus):
    path = tmp_path / "vendor.eds"
    path.write_bytes(EDS.replace("VendorName=Trinamic", "VendorName=Müller Antriebe °C").encode("cp1252"))
    with CanDrives(eds=path, bus=bus, pace="lockstep") as drives:
        assert drives.device is None
        motion.enable(drives, mode="csv")
        drives.record([0x6041], 0.001, play={0x60FF: [1]})
        assert drive.get(0x1400, 2) == 1  # CiA 301's usual synchronous type, where the device says nothing else


def test_a_known_device_has_its_own_traits(drives, drive):
    drives.record([0x6041], 0.001, play={0x60FF: [1]})
    assert drive.get(0x1400, 2) == 0  # TMCM-1636 manual, 3.1.17
    assert slots(drives.description, INTO_DRIVE, 0) == Slots((0, 1, 2, 3), 3)


WIDE = "\n" + "\n".join(
    f"""[{index:X}]
ParameterName=Wide {index:X}
ObjectType=0x7
DataType=0x{data_type:04X}
AccessType=rw
PDOMapping=0
"""
    for index, data_type in ((0x2F00, 0x15), (0x2F01, 0x1B), (0x2F02, 0x10))  # INTEGER64, UNSIGNED64, INTEGER24
)


def test_integers_of_every_width_of_cia_301(tmp_path, drive, bus):
    path = tmp_path / "wide.eds"
    path.write_text(EDS + WIDE, encoding="utf-8")
    drive.values |= {(0x2F00, 0): (-(2**62), 8), (0x2F01, 0): (2**64 - 1, 8), (0x2F02, 0): (-(2**23), 3)}
    with CanDrives(eds=path, bus=bus, pace="lockstep") as drives:
        assert drives.read(0x2F00).tolist() == [-(2**62)]
        assert drives.read(0x2F01).tolist() == [2**64 - 1]
        assert drives.read(0x2F02).tolist() == [-(2**23)]
        drives.write(0x2F01, 2**64 - 2)
        drives.write(0x2F02, -2)
        assert drives.read(0x2F01).tolist() == [2**64 - 2]
        assert drives.read(0x2F02).tolist() == [-2]
        with pytest.raises(ObjectAccessError, match="its highest is 8388607"):
            drives.write(0x2F02, 2**23)


@pytest.mark.parametrize(
    ("options", "name", "seconds"),
    [({}, 0x6041, 0.5), ({}, (0x1010, 1), 10.0), ({"timeout": 2.0}, 0x6041, 2.0), ({"timeout": 2.0}, (0x1011, 1), 10.0),
     ({"timeouts": {(0x1010, 1): 20.0}}, (0x1010, 1), 20.0)],
)  # fmt: skip
@pytest.mark.parametrize("patient_masters", [None], ids=["as they are"])
def test_time_outs_are_the_devices_unless_given(bus, patient_masters, options, name, seconds):
    with CanDrives(bus=bus, pace="lockstep", **options) as drives:
        assert drives.description.patience(drives.description.dictionary.find(name)) == seconds


@pytest.mark.parametrize("options", [{"timeout": 0.0}, {"timeout": float("nan")}, {"timeouts": {0x6041: float("inf")}}])
def test_a_time_out_that_cannot_be_is_told(bus, options):
    with pytest.raises(ValueError, match=r"a time-out of .* s is impossible; give one above 0 s"):
        CanDrives(bus=bus, pace="lockstep", **options)


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


# --- quantities ---------------------------------------------------------------------------------------------------
KNOWN = find_device("tmcm1636").new_dictionary()


@every_row(
    ("name", "text", "raw"),
    [
        (0x6081, "1000 rpm", 1_092_267),
        (0x6081, "1000rpm", 1_092_267),
        (0x6081, "65536", 65536),
        (0x6081, "0x10", 16),
        (0x6081, "1e3 pps", 1000),
        (0x6081, "2 rev/s", 131_072),
        (0x6081, "720 deg/s", 131_072),
        (0x6081, "6.283185307 rad/s", 65536),
        (0x607A, "-0.5 rev", -32768),
        (0x607A, "3.1415926536 rad", 32768),
        (0x607A, "90 deg", 16384),
        (0x6083, "500 rev/s^2", 32_768_000),
        (0x6083, "600 rpm/s", 655_360),
        (0x6083, "62.83185307 rad/s^2", 655_360),
        (0x2003, "7 A", 7000),
        (0x2003, "70 mA", 70),
        ((0x2006, 2), "24.5 V", 245),
        (0x6068, "0.02 s", 20),
    ],
)
def test_quantities_become_integers_and_are_shown_back(name, text, raw):
    found = KNOWN.find(name)
    assert quantities.parse(text, found, 65536.0) == raw
    again = quantities.show(raw, found, 65536.0).split("(")[0].strip()
    assert quantities.parse(again, found, 65536.0) == raw


def test_importing_the_package_imports_no_bus():
    code = "import sys, drive_env; sys.exit('can' in sys.modules or 'canopen' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


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
