"""What device files of other makers have in ways of their own, each in the manner of one (rigs/makers.py)."""

from __future__ import annotations

from contextlib import contextmanager

import numpy as np
import pytest
from rigs.canopen_wire import Wire
from rigs.makers import files
from rigs.pump import NODE
from rigs.small_eds import entry
from rigs.world_bus import bus_of
from typer.testing import CliRunner

from drive_env import CanDrives, EmulatedDrives, Limits, motion
from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.commands.cli import app
from drive_env.devices import find_device
from drive_env.devices.new_device import new_device
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.dictionary.eds_file import parse_eds
from drive_env.dictionary.roles import Role
from drive_env.fieldbus.description import describe
from drive_env.master.can.pdo import INTO_DRIVE, OUT_OF_DRIVE, slots, stands
from drive_env.motors import find_motor
from drive_env.safety.errors import SafetyError

FILES = files()
MOTOR = "qbl4208"
SAVE, LOAD = 0x65766173, 0x64616F6C


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Makes a device of a maker's file, once: its file, and what was told."""
    home, known = tmp_path_factory.mktemp("makers"), {}

    def make(name):
        if name not in known:
            path = home / f"{name}.eds"
            path.write_bytes(FILES[name])
            known[name] = path, new_device(path, home / name, find_motor(MOTOR))
        return known[name]

    return make


def told(device):
    return {note.what: note.why for note in (*device.fill_in, *device.repairs)}


def emulated(device, **options):
    return EmulatedDrives(str(device.folder), "inertia", MOTOR, num_threads=1, **options)


@contextmanager
def mastered(path, device, **options):
    """Our master, which knows the maker's file alone, and the drive at the other end of its bus in lockstep."""
    with (
        bus_of(emulated(device), (NODE,)) as bus,
        CanDrives(eds=path, bus=bus, nodes=(NODE,), pace="lockstep", **options) as drives,
    ):
        yield drives, bus


# --- limits within which an object cannot say "no limit" --------------------------------------------------------------
@pytest.mark.every(6)
@pytest.mark.parametrize(
    ("name", "key", "raw", "why"),
    [
        ("glarus_1", (0x607F, 0), 50000, "no limit lies outside its limits 1 to 50000"),  # no default: the highest
        ("glarus_2", (0x607F, 0), 3000, "no limit lies outside its limits 1 to 4294967295"),  # the file's default
        ("glarus_3", (0x607D, 1), -1000000, "no limit lies outside its limits -1000000 to 2147483647"),
        ("glarus_3", (0x607D, 2), 1000000, "no limit lies outside its limits -2147483648 to 1000000"),
        ("helvia_1", (0x607F, 0), 5000000, "no limit lies outside its limits 100 to 5000000"),
        ("helvia_1", (0x6073, 0), 1500, "2000 lies outside its limits 0 to 1500"),
        ("helvia_2", (0x6067, 0), 1000, "1573 lies outside its limits 1 to 1000"),
        ("helvia_3", (0x6072, 0), 1500, "2000 lies outside its limits 1 to 1500"),  # which limits the current there
        ("helvia_3", (0x6065, 0), 500000, "655360 lies outside its limits 0 to 500000"),
    ],
)
def test_no_limit_is_the_files_default_or_the_widest_and_told(made, name, key, raw, why):
    _, device = made(name)
    with emulated(device) as drives:
        assert drives.read(key)[0] == raw
    line = f"- {key[0]:04X}:{key[1]} of drive.eds: {why}: commissioned with {raw}"
    assert line in (device.folder / "to_fill_in.md").read_text(encoding="utf-8").splitlines()


def test_no_speed_that_is_commissioned_passes_the_limit_of_speed(made):
    """A master refuses every move of a drive with a profile velocity beyond its 607Fh."""
    _, device = made("helvia_2")
    with emulated(device) as drives:
        assert drives.read(0x6081)[0] == drives.read(0x607F)[0] == 5000000


def test_what_can_say_no_limit_says_it(made):
    _, device = made("iberis_1")
    with emulated(device) as drives:
        assert [drives.read(key)[0] for key in (0x607F, (0x607D, 1), (0x607D, 2))] == [0, -(2**31), 2**31 - 1]
    assert not any("outside its limits" in why for why in told(device).values())


@pytest.mark.parametrize(
    ("name", "key", "default"),
    [
        ("glarus_1", (0x6080, 0), 0xFFFFFFFF),  # a lowest speed alone, and no default: not 0, but no limit
        ("helvia_1", (0x6072, 0), 1500),
        ("helvia_3", (0x6065, 0), 500000),
        ("helvia_3", (0x6075, 0), 2000),  # no limit by itself: the nearest
    ],
)
def test_a_default_outside_its_objects_limits_is_put_right(made, name, key, default):
    _, device = made(name)
    assert find_device(str(device.folder)).new_dictionary().find(key).default == default
    assert told(device)[f"[{key[0]:04X}:{key[1]}]"].endswith(f": {default}")


def test_our_master_moves_a_drive_whose_speed_has_a_lowest_limit(made):
    with mastered(*made("glarus_1")) as (drives, _):
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, 300)
        drives.advance(0.4)
        assert drives.read(0x606C)[0] == pytest.approx(300, rel=0.05)


# --- limits that contradict a format ----------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("section", "limits", "left"),
    [
        ("1016sub1", {"HighLimit": "65535"}, ()),
        ("1016sub1", {"LowLimit": "1", "HighLimit": "0xFFFFFFFF"}, ()),
        ("1016sub1", {"LowLimit": "0", "HighLimit": "0x7FFFFF"}, ("LowLimit", "HighLimit")),
        ("1016sub0", {"HighLimit": "1"}, ("HighLimit",)),  # a count
        ("1005", {"HighLimit": "0x7FF"}, ()),
        ("1014", {"LowLimit": "0x81", "HighLimit": "0xFF"}, ()),
        ("1014", {"HighLimit": "$NODEID+0x80"}, ()),
        ("1400sub1", {"HighLimit": "0x7FF"}, ()),
        ("18FFsub1", {"HighLimit": "0x7FF"}, ()),
        ("1800sub1", {"LowLimit": "1", "HighLimit": "0xFFFFFFFF"}, ("LowLimit", "HighLimit")),
        ("1800sub2", {"HighLimit": "240"}, ("HighLimit",)),
    ],
)
def test_limits_that_a_format_does_not_fit_are_left_out_and_told(section, limits, left):
    file = parse_eds(entry(section, data_type="0x0007", **limits), 5)
    assert tuple(key for key in ("LowLimit", "HighLimit") if key in file.sections[section]) == left
    assert any("CiA 301's values of it" in one.what for one in file.repairs) == (not left)


def test_a_heartbeat_can_be_watched_whatever_1016h_says_of_itself(made):
    path, device = made("iberis_1")
    assert "HighLimit=65535 left out" in told(device)["[1016sub1]"]
    with emulated(device) as drives:
        wire = Wire(drives, NODE)
        assert wire.download(0x1016, 1, 0x0007_0032, 4) == 0
        assert wire.download(0x1400, 1, 0x80000205, 4) == 0
    assert describe(None, path).dictionary.find((0x1016, 1)).high == 2**32 - 1


# --- process data -----------------------------------------------------------------------------------------------------
def test_a_mapping_of_sub_index_0_alone_is_skipped(made):
    path, _ = made("iberis_1")
    known = describe(None, path)
    assert known.has((0x1604, 0)) and not known.has((0x1604, 1))
    assert slots(known, INTO_DRIVE, 0) == ((0, 1, 2, 3), 4)
    assert slots(known, OUT_OF_DRIVE, 0) == ((0, 1, 2, 3), 4)


def cob_ids(drives, directions=(0x1400, 0x1800)):
    """Identifiers and types of the first two PDOs of each direction, as the drive has them."""
    return [int(drives.read((first + k, sub))[0]) for first in directions for k in (0, 1) for sub in (1, 2)]


@pytest.mark.every(2)
@pytest.mark.parametrize("safety", [Limits(), Limits(silence=None)], ids=["watched", "silence=None"])
def test_pdos_that_can_only_be_read_are_taken_as_they_stand(made, safety):
    """RPDOs with 6040h, with 607Ah, with 60FFh; TPDOs with 6041h and 6064h, with 606Ch and 6077h."""
    path, device = made("jura_1")
    assert all(stands(describe(None, path), direction, 0) for direction in (INTO_DRIVE, OUT_OF_DRIVE))
    with mastered(path, device, safety=safety) as (drives, bus):
        before = cob_ids(drives)
        motion.enable(drives, mode="csp")
        here = drives.read(0x6064)
        way = np.arange(1, 301)[:, None]
        seen = drives.record([0x6064, 0x606C], 0.3, play={0x607A: here + way})
        assert len(seen[0x6064]) == 300 and seen[0x6064][-1, 0] - here[0] > 100
        with pytest.raises(ObjectAccessError, match="of 2 that can only be read those are used of which all is wanted"):
            drives.record([0x6061], 0.01)
        drives.advance(0.3)
        assert abs(drives.read(0x6064)[0] - here[0] - 300) < 82
        drives.close()
        with CanDrives(eds=path, bus=bus, nodes=(NODE,), pace="lockstep", safety=False) as again:
            assert cob_ids(again) == before  # a TPDO's type, which can be written, too


def test_an_rpdo_that_stands_is_used_where_all_that_it_carries_is_played(made):
    """One with 6040h and 607Ah would else bring an old controlword."""
    path, device = made("jura_2")
    with mastered(path, device) as (drives, _):
        motion.enable(drives, mode="csp")
        here = int(drives.read(0x6064)[0])
        with pytest.raises(ObjectAccessError, match="of 4 that can only be read those are used of which all is played"):
            drives.record([0x6064], 0.01, play={0x607A: np.full(10, here)})
        words, way = np.full(200, 0x0F), here + np.arange(200)
        drives.record([0x6064], 0.2, play={0x6040: words, 0x607A: way})
        drives.advance(0.3)
        assert abs(drives.read(0x6064)[0] - way[-1]) < 82


def test_a_drive_that_sends_nothing_at_sync_is_watched_by_sdo(made):
    with mastered(*made("jura_3")) as (drives, _):
        motion.enable(drives, mode="pp")
        assert drives.sampled_entries() == ()
        motion.move_to(drives, 4096)
        assert abs(drives.read(0x6064)[0] - 4096) < 82
        with pytest.raises(ObjectAccessError, match="do not fit"):
            drives.record([0x6064], 0.01)


# --- values of a DCF --------------------------------------------------------------------------------------------------
def test_values_of_a_dcf_are_what_the_drive_has_stored(made):
    _, device = made("kymi_1")
    kept = {(0x6081, 0): (700, 1000), (0x6083, 0): (22000, 10000), (0x1017, 0): (250, 0), (0x2010, 0): (12, 7),
            (0x1801, 2): (10, 255), (0x1800, 1): (0x188, 0x180 + NODE)}  # fmt: skip
    with emulated(device) as drives:
        assert drives.read(0x6081)[0] == 700
        wire = Wire(drives, NODE)
        assert {key: wire.value(*key) for key in kept} == {key: was for key, (was, _) in kept.items()}
        assert wire.download(0x1011, 1, LOAD, 4) == 0
        wire.receive(0, f"81 {NODE:02X}")
        wire.wait(2)
        assert {key: wire.value(*key) for key in kept} == {key: factory for key, (_, factory) in kept.items()}
    with emulated(device, commissioned=False) as drives:
        assert drives.read(0x6081)[0] == 1000
        assert Wire(drives, NODE).value(0x1017, 0) == 0


def test_units_follow_what_a_dcf_has_written(made):
    """A resolution of 8000 counts, where the factory's is 2000; a limit of speed."""
    _, device = made("kymi_2")
    with emulated(device) as drives:
        assert drives.read(Role.POSITION_SCALE)[0] == 8000
        assert (drives.read(0x607F)[0], drives.read(0x6081)[0]) == (2000, 333)
        motion.enable(drives, mode="pp")
        motion.move_to(drives, 8000)
        assert drives.inside.records["theta_m"][0][0] == pytest.approx(2.0 * np.pi, rel=0.02)


def test_of_a_dcf_commands_and_what_cannot_be_are_not_taken(made):
    _, device = made("kymi_3")
    assert told(device)["[605A:0]"] == "ParameterValue=77 is not possible here: not taken"
    with emulated(device) as drives:
        assert [int(drives.read(index)[0]) for index in (0x6098, 0x605A, 0x6060, 0x607A)] == [37, 2, 0, 0]
        assert Wire(drives, NODE).value(0x1A01, 0) == 1


def test_values_of_a_dcf_that_describes_an_array_once(tmp_path):
    array = entry("2100", "Gains", kind="0x8", CompactSubObj="3", DefaultValue="4")
    dcf = array + "[2100Value]\nNrOfEntries=1\n3=9\n[DeviceComissioning]\nNodeID=5\n"
    rows = [parse_eds(dcf, 5).sections[f"2100sub{sub}"] for sub in (2, 3)]
    assert [(row["DefaultValue"], row.get("ParameterValue")) for row in rows] == [("4", None), ("4", "9")]


# --- widths, and no watchdog ------------------------------------------------------------------------------------------
def test_objects_of_another_width_are_taken_as_the_file_has_them(made):
    path, device = made("lotus_1")
    assert told(device)["6077h"] == "has 32 bits in the EDS and 16 in CiA 402: taken as the EDS has it"
    assert told(device)["[1A01sub2]"].startswith("0x60770010 is read as 0x60770020")
    with mastered(path, device) as (drives, _):
        motion.enable(drives, mode="csp")
        seen = drives.record([0x6077, 0x6064], 0.05, play={0x607A: np.full(50, int(drives.read(0x6064)[0]))})
        assert seen[0x6077].shape == (50, 1)
        assert drives.read(0x6061)[0] == 8
        mapped = [drives.description.dictionary.find((0x1A00 + k, sub)) for k in range(2) for sub in (1, 2)]
        assert 0x60770020 in [drives.read_raw(one, 0) for one in mapped]


def test_a_drive_without_a_watchdog_is_refused_with_the_remedy_and_moves_with_it(made, caplog):
    path, device = made("lotus_1")
    why = told(device)["1016h and 100Ch"]
    assert "the drive does not notice when its master dies" in why and "Limits(silence=None)" in why
    world = World(lockstep=False)
    inside = emulated(device)
    world.add(inside, [NODE])
    hub = Hub()
    where = {"interface": "slcan", "channel": hub.channel, "nodes": (NODE,), "eds": path}
    try:
        with Server(world, hub):
            with CanDrives(**where) as drives, pytest.raises(SafetyError, match=r"1016h.*Limits\(silence=None\)"):
                motion.enable(drives, mode="pp")
            with CanDrives(safety=Limits(silence=None, stall=60.0), **where) as drives:
                motion.enable(drives, mode="pp")
                motion.move_to(drives, 2048, timeout=60.0)
                assert abs(drives.read(0x6064)[0] - 2048) < 82
            assert "no drive stops by itself when this process dies" in caplog.text
            named = ("--interface", "slcan", "--channel", hub.channel, "--node", str(NODE), "--timeout", "20")
            asked = ["jog", "2048", "--for", "0.1", *named]
            found = CliRunner().invoke(app, [*asked, "--eds", str(path)])
            assert found.exit_code == 1 and "give --no-watchdog to jog, move or home" in found.stderr
            unwatched = (*named, "--eds", str(path), "--no-watchdog")
            for words in (asked[:4], ["home", "--method", "35", "--yes"], ["move", "2048", "--yes"]):
                found = CliRunner().invoke(app, [*words, *unwatched])
                assert found.exit_code == 0, found.output
            assert abs(inside.read(0x6064)[0] - 2048) < 82 and inside.read(0x6041)[0] & 0x6F != 0x27
            found = CliRunner().invoke(app, [*asked, "--no-watchdog"])
            assert found.exit_code == 2 and "a tmcm1636 has a watchdog over its master (1016h)" in found.stderr
    finally:
        world.close()
