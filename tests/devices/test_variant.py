"""The TMCM-1636 as its maker's EDS of firmware 1.09 has it: a variant is a few rows, and each of its objects acts."""

from __future__ import annotations

import io
from dataclasses import replace

import canopen
import gymnasium
import numpy as np
import pytest
from rigs.canopen_wire import Wire
from rigs.tables import every_row
from rigs.world_bus import WorldBus, on_bus
from typer.testing import CliRunner

from drive_env import CanDrives, EmulatedDrives, motion
from drive_env.bus.world import World
from drive_env.canopen.frames import Frame
from drive_env.commands.cli import app
from drive_env.devices import find_device
from drive_env.devices.variants import merged
from drive_env.dictionary.aborts import CANNOT_BE_STORED, READ_ONLY, VALUE_RANGE
from drive_env.drives.limits import Limits
from drive_env.drives.speeds import per_increment
from drive_env.fieldbus.errors import BusError
from drive_env.firmware.record import set_lanes
from drive_env.motors import find_motor
from drive_env.safety.errors import SafetyError
from tuning.move_counter import POSITIONS, SPEEDS, MoveCounter
from tuning.runs.experiment import load_experiment, resolve

NAME = "tmcm1636_fw109"
BASE, VARIANT = find_device("tmcm1636"), find_device(NAME)
TURN = 65536
RPM = 2.0 * np.pi / 60.0
MAPPINGS = (*range(0x1600, 0x1604), *range(0x1A00, 0x1A04))

# What the maker's EDS and programs have beyond the manual: index, sub-index, type, access, default, unit; node 1.
ROWS = [
    (0x1000, 0, "u32", "ro", 0x0042_0192, ""),
    (0x1005, 0, "u32", "rw", 0x8000_0080, ""),
    (0x1014, 0, "u32", "ro", 0x81, ""),
    (0x1018, 0, "u8", "ro", 4, ""),
    (0x1018, 4, "u32", "ro", 1, ""),  # D: the node-ID
    *((0x1800 + k, 1, "u32", "rw", 0x181 + 0x100 * k, "") for k in range(4)),  # without bit 30
    *((0x1800 + k, 4, "u8", "rw", 0, "") for k in range(4)),
    (0x1803, 2, "u8", "rw", 0xFE, ""),
    (0x2005, 0, "u32", "rw", 3, ""),
    (0x2042, 0, "u8", "ro", 5, ""),
    (0x2042, 5, "u8", "rw", 0, ""),
    (0x2706, 0, "u8", "ro", 1, ""),
    (0x2706, 1, "u32", "rw", 0, ""),
    (0x270B, 0, "u32", "ro", 0, ""),
    (0x270C, 0, "u8", "ro", 6, ""),
    *((0x270C, sub, "u32", "ro", 0x693 if sub == 5 else 0, "") for sub in range(1, 7)),
    (0x270E, 0, "u8", "ro", 8, ""),
    *((0x270E, sub, "u32", "ro", 0, "") for sub in range(1, 9)),
    (0x605B, 0, "i16", "rw", 0, ""),
    (0x605C, 0, "i16", "rw", 1, ""),
    (0x605D, 0, "i16", "rw", 1, ""),
    (0x605E, 0, "i16", "rw", 2, ""),
    (0x606A, 0, "i16", "rw", 0, ""),
    (0x606B, 0, "i32", "ro", 0, "rpm"),
    (0x606C, 0, "i32", "ro", 0, "rpm"),
    (0x6072, 0, "u16", "rw", 0, "1/1000"),
    (0x6074, 0, "i16", "ro", 0, "1/1000"),
    (0x607F, 0, "u32", "rw", 0, "rpm"),
    (0x6081, 0, "u32", "rw", 0, "rpm"),
    (0x6083, 0, "u32", "rw", 0, "rpm/s"),
    (0x6084, 0, "u32", "rw", 0, "rpm/s"),
    (0x6085, 0, "u32", "rw", 51200, "rpm/s"),
    (0x6099, 1, "u32", "rw", 0, "rpm"),
    (0x6099, 2, "u32", "rw", 0, "rpm"),
    (0x609A, 0, "u32", "rw", 0, "rpm/s"),
    (0x60B1, 0, "i32", "rw", 0, "rpm"),
    (0x60FF, 0, "i32", "rw", 0, "rpm"),
    (0x67FF, 0, "u32", "ro", 0x0006_0192, ""),
]
KEYS = {row[:2] for row in ROWS}
ENTRIES = {(entry.index, entry.sub): entry for entry in VARIANT.new_dictionary()}
BY_RULE = {(0x1005, 0), (0x1014, 0), (0x2706, 1), *((0x1800 + k, 1) for k in range(4))}  # without limits in the EDS


def values(entry):
    names = ("name", "bits", "access", "low", "high", "default", "unit", "pdo_mappable", "signed")
    return tuple(getattr(entry, name) for name in names)


def drives_of(device=NAME, load="inertia", motor="qbl4208", machines=1, **options):
    return EmulatedDrives(device, load, motor, machines, seed=3, ideal=True, num_threads=1, **options)


def rpm_of(drives):
    return float(drives.machine.rotor_speed[0] / RPM)


@pytest.fixture
def drives():
    with drives_of() as made:
        yield made


# --- the dictionary ---------------------------------------------------------------------------------------------------
@every_row("row", ROWS)
def test_an_object_is_as_the_makers_eds_has_it(row):
    index, sub, kind, access, default, unit = row
    entry = ENTRIES[index, sub]
    assert (entry.bits, entry.signed) == (int(kind[1:]), kind[0] == "i")
    assert (entry.access, entry.default, entry.unit) == (access, default, unit)
    assert entry.low <= default <= entry.high


def test_everything_else_is_the_devices():
    base = {(entry.index, entry.sub): entry for entry in BASE.new_dictionary()}
    assert set(ENTRIES) - set(base) == KEYS - set(base)
    assert set(base) <= set(ENTRIES)
    differing = {key for key in base if values(base[key]) != values(ENTRIES[key])}
    assert differing == KEYS & set(base)
    assert {key for key in BASE.bindings if BASE.bindings[key] != VARIANT.bindings[key]} == {
        (index, sub) for index, sub, *_, unit in ROWS if "rpm" in unit and (index, sub) in base
    }
    same = set(BASE._fields) - {
        "name",
        "title",
        "eds",
        "bindings",
        "allowed_values",
        "unsupported",
        "canopen",
        "variant_of",
    }
    for field in same:
        assert getattr(BASE, field) == getattr(VARIANT, field), field


def test_its_eds_is_whole():
    source = io.StringIO(VARIANT.eds.read_text())
    source.name = VARIANT.eds.name
    od = canopen.import_od(source, node_id=1)
    text = VARIANT.eds.read_text()
    counts = [int(line.split("=")[1]) for line in text.splitlines() if line.startswith("SupportedObjects=")]
    assert sum(counts) == len(od) == len({index for index, _ in ENTRIES})
    assert text.isascii()
    for index, group in od.items():
        if not isinstance(group, canopen.objectdictionary.ODVariable):
            assert f"[{index:04X}]" in text
            if index not in MAPPINGS:  # there it counts the mapped entries
                assert group[0].default == max(group.subindices), f"{index:04X}h"
    without = {key for key in ENTRIES if key in KEYS and od_entry(od, *key).min is None}
    assert without == BY_RULE


def od_entry(od, index, sub):
    found = od[index]
    return found if isinstance(found, canopen.objectdictionary.ODVariable) else found[sub]


def test_data_of_a_variant_replace_values_and_not_tables():
    base = {"a": 1, "table": {"b": 2, "c": [1, 2]}, "other": {"d": 3}}
    assert merged(base, {"a": 5, "table": {"c": [7]}}) == {"a": 5, "table": {"b": 2, "c": [7]}, "other": {"d": 3}}


@every_row("motor", BASE.motors)
def test_a_preset_is_the_devices_in_other_units(motor):
    base, own = BASE.preset(find_motor(motor)), VARIANT.preset(find_motor(motor))
    assert list(own) == list(base)
    for name, raw in base.items():
        entry = next(entry for entry in ENTRIES.values() if entry.name.casefold() == name.casefold())
        factor = 60.0 / TURN if "rpm" in entry.unit else 1.0
        assert own[name] == round(raw * factor), name


def test_the_command_line_prints_the_eds_of_a_device():
    for device in (BASE, VARIANT):
        found = CliRunner().invoke(app, ["export", "eds", "-", "--device", device.name])
        assert (found.exit_code, found.stdout) == (0, device.eds.read_text(encoding="utf-8"))
    shared = find_device("tgz_d").eds.read_text(encoding="utf-8")  # TGZ manual: "both versions use the same"
    for name in ("tgz_s", "tgz_d_2026"):  # the newer firmware has objects that the older one has not
        found = CliRunner().invoke(app, ["export", "eds", "-", "--device", name])
        assert (found.stdout == shared) == (name == "tgz_s"), name
    found = CliRunner().invoke(app, ["export", "eds", "-", "--device", "tmcm1637"])
    assert (found.exit_code, found.stdout) == (2, "")
    assert "no device is named 'tmcm1637'; there are tgz_d, tgz_d_2026, tgz_s, tmcm1636, tmcm1636_fw109" in found.stderr


# --- each object acts -------------------------------------------------------------------------------------------------
def test_velocities_are_rpm_of_the_rotor(drives):
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, 500)
    trace = drives.record([0x606B, 0x606C], 0.5)
    assert rpm_of(drives) == pytest.approx(500.0, rel=1e-4)
    assert trace[0x606C][-1] == 500
    # 6083h: 30,000 rpm/s, so that 606Bh climbs by 30 rpm each millisecond.
    drives.write(0x60FF, 800)
    demand = drives.record(0x606B, 0.02)[0x606B][:, 0]
    assert demand[:12].tolist() == [500, *range(530, 801, 30), 800]
    # Quantities are the same on both devices.
    drives.write("Target velocity", "10 rev/s")
    assert drives.read(0x60FF) == 600


@pytest.mark.parametrize("mode", ["pp", "pv", "csv", "hm"])
def test_the_same_move_is_the_same_rotor_on_both_devices(mode):
    def run(device):
        with drives_of(device, "belt" if mode == "hm" else "two_mass") as drives:
            counts = per_increment(drives, 0x606C)
            rpm = lambda value: np.rint(value * TURN / 60.0 * counts).astype(int)  # noqa: E731
            drives.write(0x6085, rpm(60_000))
            motion.enable(drives, mode=mode)
            if mode == "pp":
                drives.write(0x6081, rpm(1500))
                motion.start_move(drives, 2 * TURN)
            elif mode == "pv":
                drives.write(0x60FF, rpm(900))
            elif mode == "hm":
                drives.write(0x6098, 17)
                drives.write((0x6099, 1), rpm(300))
                drives.write((0x6099, 2), rpm(60))
                drives.write(0x6040, 0x1F)
            rows = rpm(np.rint(600 * np.sin(np.arange(250) / 20)))[:, None] if mode == "csv" else None
            play = {0x60FF: rows, 0x60B1: np.tile(rpm(60), (250, 1))} if mode == "csv" else None
            trace = drives.record([0x6064, 0x6062, 0x606C, 0x6077, 0x6041], 0.25, play)
            if mode != "hm":
                motion.quick_stop(drives)
            after = drives.record([0x6064], 0.1)
            position = np.concatenate([trace[0x6064], after[0x6064]])
            return position, trace[0x6062], trace[0x606C] / counts, trace[0x6077], trace[0x6041]

    base, variant = run("tmcm1636"), run(NAME)
    # Numbers that are the same to rounding: an encoder's count, 16 increments, may come a window sooner or later.
    for k, tolerance in enumerate((32, 1, TURN / 60.0, 60, 0)):
        np.testing.assert_allclose(variant[k], base[k], atol=tolerance, err_msg=str(k))
    assert np.ptp(base[0]) > TURN / 8


def test_max_profile_velocity_bounds_the_moves_of_pp(drives):
    motion.enable(drives, mode="pp")
    peaks = {}
    for limit in (0, 900, 5000):  # 6081h is 2,000 rpm by the preset
        drives.write(0x607F, limit)
        motion.start_move(drives, 30 * TURN, relative=True)
        peaks[limit] = int(drives.record(0x606B, 1.0)[0x606B].max())
        motion.move_to(drives, 0)
    assert peaks == {0: 2000, 900: 900, 5000: 2000}


def test_max_profile_velocity_bounds_pv_both_ways_and_tells(drives):
    motion.enable(drives, mode="pv")
    drives.write(0x607F, 300)
    for target, reached in ((1000, 300), (-1000, -300), (250, 250)):
        drives.write(0x60FF, target)
        drives.advance(0.3)
        assert rpm_of(drives) == pytest.approx(reached, rel=1e-3)
        status = int(drives.read(0x6041)[0])
        # Bit 11 internal limit active, bit 10 target reached.
        assert status & 0x0C00 == (0x0400 if target == reached else 0x0800)
    drives.write(0x60FF, 1000)
    drives.write(0x607F, 0)
    drives.advance(0.3)
    assert rpm_of(drives) == pytest.approx(1000.0, rel=1e-3)


@pytest.mark.parametrize("mode", ["cst", "pv"])
def test_max_torque_bounds_the_current_of_an_axis_that_stands_against_something(drives, mode):
    drives.machine.brake = "closed"
    drives.write(0x2003, 2000)
    found = {}
    for limit in (0, 500, 250, 1000, 3000):  # 1/1000 of 2003h; 0 and above 1000: 2003h alone
        drives.write(0x6072, limit)
        motion.enable(drives, mode=mode)
        drives.write(0x6071 if mode == "cst" else 0x60FF, 2500)
        drives.advance(0.1)
        found[limit] = int(drives.read(0x6077)[0]), int(drives.read(0x6074)[0])
        drives.write(0x6071 if mode == "cst" else 0x60FF, 0)
        motion.disable(drives)
        drives.advance(0.02)
    for limit, (current, demand) in found.items():
        share = min(limit, 1000) or 1000
        assert demand == share
        assert current == pytest.approx(2 * share, abs=5)


def test_torque_demand_tells_the_current_loops_set_point(drives):
    drives.machine.brake = "closed"
    motion.enable(drives, mode="cst")
    drives.write(0x6071, -1400)  # a fifth of 2003h, 7 A
    drives.advance(0.01)
    assert drives.read(0x6074) == -200
    assert drives.read(0x6077) == pytest.approx(-1400, abs=5)


# Velocity by the halls, which are wired as they are, or by an encoder of which the drive believes the double of steps.
@pytest.mark.parametrize(
    ("selection", "commutation", "turns"),
    [(0, 2, 300), (1, 2, 300), (2, 2, 600), (1, 3, 300)],  # 0: that of the commutation, here the halls
)
def test_the_velocity_sensor_is_the_one_that_is_selected(selection, commutation, turns):
    with drives_of() as drives:
        if commutation == 2:
            drives.write((0x2080, 2), 8192)
        drives.write(0x2055, commutation)
        drives.write((0x2042, 5), selection)
        assert drives.read(0x606A) == selection
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, 300)
        drives.advance(0.8)
        speeds = []
        for _ in range(100):
            drives.advance(0.002)
            speeds.append(rpm_of(drives))
        assert np.mean(speeds) == pytest.approx(turns, rel=0.03)


def test_both_names_of_the_sensor_selection_are_one_setting(drives):
    drives.write(0x606A, 2)
    assert drives.read((0x2042, 5)) == 2


def test_halls_that_tell_the_velocity_are_watched(drives):
    drives.write((0x2042, 5), 1)
    motion.enable(drives, mode="pv")
    set_lanes(drives.inside.records, "hall_broken", np.ones(1))
    drives.advance(0.01)
    assert [message.name for message in drives.emergencies()] == ["hall_error"]


def test_a_brushed_motor_has_no_halls_to_tell_its_velocity():
    with drives_of(motor="re_35") as drives:
        drives.write((0x2042, 5), 1)
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, 300)
        drives.advance(0.1)
        assert [message.name for message in drives.emergencies()] == ["hall_error"]
        assert abs(rpm_of(drives)) < 1.0


def test_every_drive_has_a_serial_number_of_its_own():
    with drives_of(machines=3) as drives:
        assert drives.read((0x1018, 4)).tolist() == [1, 2, 3]
        drives.reset_node()
        assert drives.read((0x1018, 4)).tolist() == [1, 2, 3]
        # On a bus it is told by the number that its node was given.
        wire = Wire(drives, 9, first_axis=1)
        assert wire.value(0x1018, 4) == 9
        assert drives.read((0x1018, 4)).tolist() == [1, 9, 3]


def test_eight_analog_inputs_show_what_is_applied_to_them(drives):
    drives.machine.analog_inputs = np.arange(8)[:, None] * 100
    assert [int(drives.read((0x270E, sub))[0]) for sub in range(1, 9)] == list(range(0, 800, 100))
    with drives_of("tmcm1636") as base:
        assert base.machine.analog_inputs.shape == (2, 1)


# --- on a bus ---------------------------------------------------------------------------------------------------------
def test_store_bus_parameters_is_its_first_sub_index(tmp_path, drives):
    file = tmp_path / "node.json"
    wire = Wire(drives, 5, store=file)
    assert wire.download(0x2705, 0, 9, 1) == 0
    assert wire.download(0x2706, 0, 0x6576_6173, 4) == READ_ONLY
    assert wire.download(0x2706, 1, 0x6F61_6465, 4) == CANNOT_BE_STORED
    assert wire.download(0x2706, 1, 0x6576_6173, 4) == 0
    assert Wire(drives, 5, store=file).node.node_id == 9


def test_the_cob_ids_of_its_factory_are_taken_and_work(drives):
    wire = Wire(drives)
    assert wire.value(0x1005) == 0x8000_0080
    assert wire.download(0x1005, 0, 0x8000_0081, 4) == 0
    assert wire.download(0x1005, 0, 0x4000_0080, 4) == VALUE_RANGE
    assert wire.download(0x1005, 0, 0x8000_0001, 4) == VALUE_RANGE
    assert wire.download(0x1014, 0, 0x8000_0085, 4) == READ_ONLY
    # Bit 30 is as it is written.
    for raw in (0x8000_0185, 0xC000_0185, 0x0000_0186):
        assert wire.download(0x1800, 1, raw, 4) == 0
        assert wire.value(0x1800, 1) == raw
    # RPDOs have it always, as on the other device.
    assert wire.download(0x1400, 1, 0x8000_0205, 4) == 0
    assert wire.value(0x1400, 1) == 0xC000_0205


def test_its_sync_is_obeyed(drives):
    wire = Wire(drives)
    assert wire.download(0x1800, 2, 1, 1) == 0
    wire.start()
    wire.node.receive(Frame(0x80, b""), wire.now)
    wire.wait(1)
    assert 0x185 in [frame.can_id for frame in wire.take()]


def programme(drives):
    objects = [0x6041, 0x6062, 0x6064, 0x606C, 0x6077]
    unmapped = [0x606B, 0x6074, (0x1018, 4), 0x67FF, (0x270C, 5), (0x2042, 5), 0x6072]

    def watch(seconds, play=None):
        trace = drives.record(objects, seconds, play=play)
        return np.stack([trace[name] for name in objects])

    motion.enable(drives, mode="pp")
    drives.write("Profile velocity", "800 rpm")
    drives.write("Max profile velocity", "1000 rpm")
    motion.start_move(drives, 2 * TURN)
    yield watch(0.25)
    motion.select_mode(drives, "csv")
    yield watch(0.15, {0x60FF: np.rint(400 * np.sin(np.arange(150) / 25)).astype(int)})
    yield watch(0.05, {0x60FF: np.zeros(50, int)})
    yield np.array([drives.read(name) for name in unmapped])
    motion.disable(drives)


@pytest.mark.parametrize("safety", [True, False])
def test_on_a_bus_it_is_the_same_to_the_integer(safety):
    with on_bus(drives_of(NAME), safety=safety) as far, drives_of() as near:
        assert far.device.name == NAME
        for told, known in zip(programme(far), programme(near), strict=True):
            np.testing.assert_array_equal(told, known)


@pytest.mark.every(2)
@pytest.mark.parametrize("device", [BASE.name, NAME])
def test_the_envelope_holds_speeds_and_ramps_in_whatever_they_count(device):
    with on_bus(drives_of(device)) as drives:
        for refused, taken in (("6001 rpm", "5999 rpm"), ("-6001 rpm", "-5999 rpm")):
            drives.write("Target velocity", taken)
            with pytest.raises(SafetyError, match=r"60FFh:00 Target velocity = .* is beyond the limit (6000|6553600);"):
                drives.write("Target velocity", refused)
        drives.write("Target velocity", 0)
        # A quick stop within a second is what torques want of 6,000 rpm.
        drives.write("Quick stop deceleration", "99 rev/s^2")
        with pytest.raises(SafetyError, match=r"6085h = (5940|6488064) is too slow .* 6085h at (6000|6553600) or more"):
            motion.enable(drives, mode="cst")
        # In pv it is the limit of speed, then: 300 rpm.
        motion.disable(drives)
        drives.write("Quick stop deceleration", "5 rev/s^2")
        drives.write("Target velocity", "299 rpm")
        with pytest.raises(SafetyError, match=r"limit (300|327680); .* the quick stop's ramp, 6085h: no axis may be"):
            drives.write("Target velocity", "301 rpm")
        motion.enable(drives, mode="pv")
        drives.write("Target velocity", "250 rpm")
        drives.advance(0.2)
        with pytest.raises(SafetyError, match=r"6085h:00 .* would not stop it within 1 s from its 2[0-9]{5} pps"):
            drives.write("Quick stop deceleration", "4 rev/s^2")


@pytest.mark.parametrize("device", [BASE.name, NAME])
def test_the_envelope_stops_an_axis_that_is_faster_than_its_limit(device):
    turn = {BASE.name: TURN / 60.0, NAME: 1.0}[device]
    with on_bus(drives_of(device), safety=Limits(velocity=400 * turn)) as drives:
        motion.enable(drives, mode="cst")
        with pytest.raises(SafetyError, match="606Ch:00 Velocity actual value"):
            drives.record([0x606C], 0.5, {0x6071: np.full(500, 800)})


# --- who reads speeds -------------------------------------------------------------------------------------------------
def test_a_set_of_drives_says_how_it_counts_speeds(drives):
    for name in (0x606C, 0x60FF, 0x6081, 0x6083, (0x6099, 1)):
        assert per_increment(drives, name) == pytest.approx(60.0 / TURN)
    assert per_increment(drives, 0x6064) == 1.0
    drives.write(0x2058, 1000)
    assert per_increment(drives, 0x606C) == pytest.approx(0.06)
    assert drives.read(0x6081) == 2000  # rpm do not follow the scale of positions
    with drives_of("tmcm1636") as base:
        assert per_increment(base, 0x606C) == 1.0


def test_moves_are_counted_in_whatever_speeds_are():
    counter = MoveCounter(np.array([1_000_000.0]), 5000.0, np.array([0.0009]))
    # What is slow: of positions in increments a millisecond, of speeds in counts.
    np.testing.assert_allclose(counter._slow[SPEEDS[0]], 0.9 * counter._slow[POSITIONS[0]])


def test_the_wrong_one_of_both_devices_is_told(drives):
    world = World(lockstep=True)
    world.add(drives, [1])
    bus = WorldBus(world)
    with pytest.raises(BusError, match=r"node 1 is a tmcm1636_fw109, not a tmcm1636: .* 00420192h; .* --device t"):
        CanDrives("tmcm1636", bus=bus, nodes=[1], pace="lockstep")
    bus.shutdown()


@pytest.mark.parametrize("mode", ["csp", "csv", "cst"])
def test_an_environment_shows_the_same_whatever_speeds_count(mode):
    seen = []
    for device in (BASE.name, NAME):
        env = gymnasium.make("ServoDrive/Tracking-v0", device=device, mode=mode)
        rows = [env.reset(seed=1)[0]]
        rows += [env.step(np.full(1, 0.05, np.float32))[0] for _ in range(200)]
        env.close()
        seen.append(np.array(rows))
    # Speeds are whole rpm there, where the trajectory's is hundreds.
    np.testing.assert_allclose(seen[1], seen[0], atol=0.03)
    assert np.ptp(seen[0], axis=0).max() > 0.1


def test_a_sweep_asks_both_devices_for_the_same_step():
    experiments = [replace(load_experiment(), device=device) for device in (BASE.name, NAME)]
    steps = [(found.velocity, found.acceleration) for found in map(resolve, experiments)]
    # 1,500 rpm and 100,000 rpm/s.
    assert steps == [(1_638_400, 109_226_667), (1500, 100_000)]
