"""vl, the velocity mode of frequency inverters (CiA 402-2), by two EDS of ours: one without a position, one with pv.

Ramps are closed forms: a speed of 6048h:01 is gained in 6048h:02, and so on. All drives are new folders of the EDS.
"""

from __future__ import annotations

import json
from contextlib import ExitStack

import numpy as np
import pytest
from rigs.canopen_wire import Wire
from rigs.makers import files
from rigs.pump import NODE
from rigs.served_drives import node
from rigs.small_eds import FOLDER, put
from rigs.world_bus import bus_of, on_bus
from typer.testing import CliRunner

from drive_env import CanDrives, EmulatedDrives, Limits, cia402, motion
from drive_env.commands.cli import app
from drive_env.devices import find_device
from drive_env.devices.new_device import new_device
from drive_env.dictionary.aborts import NO_SUCH_OBJECT
from drive_env.dictionary.access import ObjectAccessError
from drive_env.fmu.drive import FmuDrive
from drive_env.motors import find_motor
from drive_env.safety.errors import SafetyError

EDS = {"vl": FOLDER / "inverters" / "granit_fu3.eds", "vl and pv": FOLDER / "inverters" / "granit_fu5.eds"}
MOTOR = "qbl4208"
REACHED, LIMITED, HALT = 0x0400, 0x0800, 0x0100
RUN, ENABLED = 0x7F, 0x0F


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    home = tmp_path_factory.mktemp("inverters")
    return {name: new_device(path, home / path.stem, find_motor(MOTOR)) for name, path in EDS.items()}


def emulated(made, **options):
    return EmulatedDrives(str(made.folder), "inertia", MOTOR, num_threads=1, seed=2, ideal=True, **options)


@pytest.fixture(scope="module")
def shared(folders):
    with emulated(folders["vl"]) as drives:
        yield drives


@pytest.fixture
def inverter(shared):
    """A drive of vl alone: 1,000 rpm are gained in 2 s, lost in 1 s, and in 0.25 s at a quick stop."""
    shared.machine.power_cycle()
    for index, speed, time in ((0x6048, 1000, 2), (0x6049, 1000, 1), (0x604A, 4000, 1)):
        shared.write((index, 1), speed)
        shared.write((index, 2), time)
    return shared


def demand(drives, seconds):
    """Return 6043h of each millisecond that passes."""
    return drives.record([0x6043], seconds)[0x6043][:, 0]


def one(drives, name):
    return int(drives.read(name)[0])


def turning(drives, speed=400):
    """Bring an axis to a speed [rpm]."""
    motion.enable(drives, mode="vl")
    motion.turn(drives, speed)
    motion.wait_for(drives, cia402.TARGET_REACHED, 3.0, "the speed")
    return drives


# --- the ramps --------------------------------------------------------------------------------------------------------
def test_a_speed_is_gained_in_the_time_of_6048h_and_lost_in_that_of_6049h(inverter):
    motion.enable(inverter, mode="vl")
    motion.turn(inverter, 400)
    t = np.arange(1000)
    np.testing.assert_allclose(demand(inverter, 1.0), np.minimum(0.5 * t, 400), atol=1)
    assert one(inverter, 0x6041) & REACHED
    np.testing.assert_allclose(inverter.record([0x6044], 0.2)[0x6044].mean(), 400, rtol=0.01)
    inverter.write(0x6042, 0)
    np.testing.assert_allclose(demand(inverter, 0.5), np.maximum(400 - 1.0 * t[:500], 0), atol=1)


def test_a_reversal_slows_down_by_6049h_and_speeds_up_by_6048h(inverter):
    turning(inverter, 200).write(0x6042, -200)
    t = np.arange(700)
    way = np.where(t < 200, 200 - t, -np.minimum(0.5 * (t - 200), 200))
    np.testing.assert_allclose(demand(inverter, 0.7), way, atol=1)


@pytest.mark.parametrize(
    ("changes", "way"),
    [
        ({(0x6048, 2): 0}, lambda t: np.where(t > 0, 400, 0)),  # no time: at once
        ({(0x6048, 1): 0}, lambda t: 0 * t),  # no speed: never
    ],
)
def test_a_ramp_without_a_time_jumps_and_one_without_a_speed_does_not_rise(inverter, changes, way):
    for name, value in changes.items():
        inverter.write(name, value)
    motion.enable(inverter, mode="vl")
    motion.turn(inverter, 400)
    np.testing.assert_allclose(demand(inverter, 0.1), way(np.arange(100)), atol=1)


def test_without_6049h_it_slows_down_as_it_speeds_up(inverter):
    inverter.write((0x6049, 1), 0)
    turning(inverter, 200).write(0x6042, 0)
    np.testing.assert_allclose(demand(inverter, 0.5), np.maximum(200 - 0.5 * np.arange(500), 0), atol=1)


# --- the controlword --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("word", "what", "rate"),
    [
        (RUN & ~0x10, "bit 4: the ramp is not used", 1.0),
        (RUN & ~0x20, "bit 5: its output is held", 0.0),
        (RUN & ~0x40, "bit 6: its input is 0", 1.0),
        (RUN & ~0x50, "bits 4 and 6", 1.0),
        (RUN & ~0x30, "bits 4 and 5: at rest rather than held", 1.0),
        (RUN | HALT, "bit 8: halt", 1.0),
        (ENABLED, "none of them", 1.0),
    ],
)
def test_bits_of_the_controlword_take_the_axis_from_its_target(inverter, word, what, rate):
    turning(inverter, 300).write(0x6040, word)
    np.testing.assert_allclose(demand(inverter, 0.4), np.maximum(300 - rate * np.arange(400), 0), atol=1, err_msg=what)
    assert one(inverter, 0x6041) & 0x6F == 0x27
    inverter.write(0x6040, RUN)
    begin = 300 if rate == 0.0 else 0
    np.testing.assert_allclose(demand(inverter, 0.2), np.minimum(begin + 0.5 * np.arange(200), 300), atol=1)


def test_an_output_that_is_held_stays_whatever_the_target_is(inverter):
    turning(inverter, 300).write(0x6040, RUN & ~0x20)
    inverter.write(0x6042, -300)
    assert (demand(inverter, 0.1) == 300).all()
    assert not one(inverter, 0x6041) & REACHED


def test_enabling_moves_nothing_whatever_a_program_left_in_6042h(inverter):
    inverter.write(0x6042, 500)
    motion.enable(inverter, mode="vl")
    assert one(inverter, 0x6042) == 0
    inverter.write(0x6042, 500)  # without bits 4 to 6
    assert (demand(inverter, 0.2) == 0).all()


# --- 6046h ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("target", "turns", "limited"),
    [(250, 250, False), (301, 300, True), (-500, -300, True), (50, 100, True), (-1, -100, True), (0, 0, False)],
)
def test_6046h_limits_the_target_and_bit_11_tells_it(inverter, target, turns, limited):
    inverter.write((0x6046, 1), 100)
    inverter.write((0x6046, 2), 300)
    inverter.write((0x6048, 2), 0)
    motion.enable(inverter, mode="vl")
    motion.turn(inverter, target)
    assert demand(inverter, 0.05)[-1] == turns
    assert bool(one(inverter, 0x6041) & LIMITED) is limited
    assert bool(one(inverter, 0x6041) & REACHED) is not limited


def test_a_highest_speed_of_0_is_none(inverter):
    inverter.write((0x6046, 2), 0)
    motion.enable(inverter, mode="vl")
    motion.turn(inverter, 200)
    assert (demand(inverter, 0.1) == 0).all() and one(inverter, 0x6041) & LIMITED


# --- stops ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("option", "rate", "held"), [(1, 1.0, False), (2, 4.0, False), (5, 1.0, True), (6, 4.0, True)])
def test_a_quick_stop_ramps_by_604ah_or_by_6049h_as_605ah_says(inverter, option, rate, held):
    inverter.write(0x605A, option)
    turning(inverter, 300).write(0x6040, cia402.QUICK_STOP)
    np.testing.assert_allclose(demand(inverter, 0.4), np.maximum(300 - rate * np.arange(400), 0), atol=1)
    assert one(inverter, 0x6041) & 0x6F == 0x07 if held else one(inverter, 0x6041) & 0x4F == 0x40


def test_disable_operation_ramps_by_6049h(inverter):
    turning(inverter, 300).write(0x6040, 7)
    np.testing.assert_allclose(demand(inverter, 0.4), np.maximum(300 - np.arange(400), 0), atol=1)
    assert one(inverter, 0x6041) & 0x6F == 0x23


def test_without_604ah_a_quick_stop_has_the_ramp_of_the_other_modes(folders):
    with emulated(folders["vl and pv"]) as drives:
        drives.write((0x604A, 1), 0)
        drives.write(0x6085, 600)
        turning(drives, 300).write(0x6040, cia402.QUICK_STOP)
        np.testing.assert_allclose(demand(drives, 0.3), np.maximum(300 - 0.6 * np.arange(300), 0), atol=1)


def test_a_silent_master_is_answered_by_the_ramp_of_a_quick_stop(inverter):
    """1016h: node 7, 50 ms; in operation enabled the drive goes into fault, by 604Ah."""
    wire = Wire(inverter, NODE)  # restarts the drive
    inverter.write((0x604A, 1), 4000)
    assert wire.download(0x1016, 1, 0x0007_0032, 4) == 0
    assert wire.download(0x1029, 1, 2, 1) == 0  # to stopped
    turning(inverter, 300)
    wire.start()
    wire.receive(0x707, "05")
    wire.wait(40)
    assert one(inverter, 0x6043) == 300
    wire.wait(40)
    assert 0 < one(inverter, 0x6043) < 300 and one(inverter, 0x6041) & 0x4F == 0x0F
    wire.wait(100)
    assert one(inverter, 0x6043) == 0 and one(inverter, 0x6041) & 0x4F == 0x08


# --- units, and what is there -----------------------------------------------------------------------------------------
def test_velocities_are_rpm_times_604ch_and_targets_times_604bh_too(inverter):
    """60/1: revolutions per second; 1/10: tenths of them."""
    inverter.write((0x604C, 1), 60)
    inverter.write((0x604B, 2), 10)
    inverter.write((0x6046, 2), 20)
    inverter.write((0x6048, 2), 0)
    motion.enable(inverter, mode="vl")
    motion.turn(inverter, 50)
    inverter.advance(0.3)
    assert one(inverter, 0x6043) == 50 and one(inverter, 0x6044) == 5
    before = inverter.inside.records["theta_m"][0][0]
    inverter.advance(0.2)
    assert (inverter.inside.records["theta_m"][0][0] - before) / (2 * np.pi) / 0.2 == pytest.approx(5.0, rel=0.01)
    motion.turn(inverter, 300)
    inverter.advance(0.3)
    assert one(inverter, 0x6043) == 200 and one(inverter, 0x6044) == 20, "20 revolutions per second at most"
    with pytest.raises(ObjectAccessError, match="its lowest is 1"):
        inverter.write((0x604C, 2), 0)


@pytest.mark.parametrize(("name", "modes"), [("vl", 0x2), ("vl and pv", 0x6)])
def test_the_folder_has_the_modes_of_its_eds(folders, name, modes):
    made = folders[name]
    told = {note.what: note.why for note in made.modes}
    assert told["taken"] == ("vl" if name == "vl" else "vl, pv")
    assert not {"6042h", "6046h", "604Ah", "604Bh", "604Ch"} & {note.what for note in made.without_effect}
    with emulated(made) as drives:
        assert one(drives, 0x6502) == modes
        with pytest.raises(ObjectAccessError, match=r"6060h.* cannot be 1"):
            drives.write(0x6060, 1)


def test_vl_and_pv_have_targets_and_ramps_of_their_own(folders):
    with emulated(folders["vl and pv"]) as drives:
        turning(drives, 300)
        assert one(drives, 0x60FF) == 0
        motion.select_mode(drives, "pv")
        motion.turn(drives, 120)
        drives.advance(0.5)
        assert one(drives, 0x6043) == 120 and one(drives, 0x6042) == 300
        motion.select_mode(drives, "vl")
        assert one(drives, 0x6042) == 0, "the axis stays"
        with pytest.raises(RuntimeError, match="axis 0 is not in pp and cannot move"):
            motion.move_to(drives, 4096)


def test_a_turn_needs_a_mode_of_a_velocity(folders):
    with emulated(folders["vl"]) as drives, pytest.raises(RuntimeError, match=r'enable\(drives, mode="vl"\) first'):
        motion.turn(drives, 100)


def test_targets_that_are_played_to_an_axis_that_is_not_enabled_are_told(folders):
    told = r"^6042h is played, but no axis is enabled"
    with emulated(folders["vl"]) as drives, pytest.warns(UserWarning, match=told):
        drives.record([0x6043], 0.001, play={"vl target velocity": [300]})


def test_as_an_fmu_it_has_its_target_and_its_speed(folders):
    drive = FmuDrive(str(folders["vl"].folder), "inertia", MOTOR)
    by_name = {one.name: one for one in drive.variables}
    assert "target_velocity" not in by_name
    for word in (6, 7, ENABLED, RUN):
        for name, value in {"mode_of_operation": cia402.VL, "controlword": word, "vl_target_velocity": 300}.items():
            drive.set(by_name[name], value)
        drive.step(0.001)
    drive.step(0.5)
    assert drive.get(by_name["vl_velocity_demand"]) == 300
    assert drive.get(by_name["vl_velocity_actual_value"]) == pytest.approx(300, rel=0.05)


def test_a_drive_without_6048h_gets_a_ramp_of_the_emulators_own(tmp_path):
    text = EDS["vl"].read_text(encoding="utf-8")
    path = tmp_path / "bare.eds"
    head, rest = text.split("[6048]", 1)
    path.write_text(head + "[6049]" + rest.split("[6049]", 1)[1], encoding="utf-8")
    made = new_device(path, tmp_path / "bare", find_motor(MOTOR))
    assert any("no 6048h" in note.why for note in made.fill_in)
    with emulated(made) as drives:
        turning(drives, 300)


# --- 6047h, and ramps by times ----------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def of_times(tmp_path_factory):
    home = tmp_path_factory.mktemp("of_times")
    path = home / "granit_fu1.eds"
    path.write_bytes(files()["granit_fu1"])
    return path, new_device(path, home / "made", find_motor(MOTOR))


@pytest.fixture
def timed(of_times):
    """A drive without 6048h to 604Ah: 1,000 rpm are gained in 2 s, lost in 1 s, and in 0.25 s at a quick stop."""
    with emulated(of_times[1]) as drives:
        set_times(drives)
        yield drives


def set_times(drives):
    for index, value in {0x604E: 1000, 0x604F: 2000, 0x6050: 1000, 0x6051: 250}.items():
        drives.write(index, value)


def test_604eh_is_gained_in_604fh_and_lost_in_6050h_and_at_a_quick_stop_in_6051h(timed):
    t = np.arange(400)
    motion.enable(timed, mode="vl")
    motion.turn(timed, 200)
    np.testing.assert_allclose(demand(timed, 0.4), np.minimum(0.5 * t, 200), atol=1)
    assert one(timed, 0x6045) == one(timed, 0x6043) == 200
    timed.write(0x6042, 0)
    np.testing.assert_allclose(demand(timed, 0.4), np.maximum(200 - t, 0), atol=1)
    motion.turn(timed, 200)
    timed.advance(0.5)
    timed.write(0x6040, cia402.QUICK_STOP)
    np.testing.assert_allclose(demand(timed, 0.4), np.maximum(200 - 4.0 * t, 0), atol=1)


def test_a_drive_as_commissioned_turns_by_its_times_and_needs_no_ramp_of_the_emulators_own(of_times):
    made = of_times[1]
    assert not any("6048h" in note.why for note in made.fill_in)
    ours = {f"{index:X}h" for index in (0x6045, 0x6047, 0x604E, 0x604F, 0x6050, 0x6051)}
    assert not ours & {note.what for note in made.without_effect}
    with emulated(made) as drives:
        turning(drives, 300)


@pytest.mark.parametrize(
    ("target", "turns", "limited"),
    [(250, 250, False), (300, 280, True), (50, 100, True), (-250, -150, True), (-30, -40, True), (-120, -120, False)],
)
def test_6047h_limits_each_direction_within_6046h(timed, target, turns, limited):
    for sub, value in enumerate((100, 400, 0, 150), 1):
        timed.write((0x6047, sub), value)
    timed.write((0x6046, 1), 40)
    timed.write((0x6046, 2), 280)
    timed.write(0x604F, 0)
    motion.enable(timed, mode="vl")
    motion.turn(timed, target)
    assert demand(timed, 0.05)[-1] == turns
    assert bool(one(timed, 0x6041) & LIMITED) is limited


def test_our_master_reads_the_ramp_of_a_quick_stop_from_604eh_and_6051h(of_times, timed):
    """250 ms for 1,000 rpm allow 4,000 rpm, a second; 2,000 ms allow 500."""
    with on_bus(timed, (NODE,), eds=of_times[0]) as drives:
        set_times(timed)  # a drive that is found anew has its stored ones
        motion.enable(drives, mode="vl")
        motion.turn(drives, 600)
        drives.advance(1.4)
        assert rpm(timed) == pytest.approx(600, rel=0.02)
        for name, value in ((0x6051, 2000), (0x604E, 100)):
            with pytest.raises(SafetyError, match="would not stop it within 1 s"):
                drives.write(name, value)
        motion.turn(drives, 0)
        drives.advance(1.0)
        drives.write(0x6051, 2000)
        with pytest.raises(SafetyError, match=r"is beyond the limit 500.* it \(in vl 604Eh\) stops"):
            motion.turn(drives, 600)


# --- over a bus, by our master, with its limits -----------------------------------------------------------------------
@pytest.fixture
def on_a_bus(folders):
    """Return a function that gives a drive, and our master of it, which knows the vendor's EDS alone."""
    with ExitStack() as opened:

        def connect(name, values=None, **options):
            drive = emulated(folders[name])
            bus = opened.enter_context(bus_of(drive, (NODE,)))
            for object_, value in (values or {}).items():
                drive.write(object_, value)
            return drive, CanDrives(eds=EDS[name], bus=bus, nodes=(NODE,), pace="lockstep", **options)

        yield connect


def rpm(drive):
    """Return how fast the rotor turns."""
    return float(drive.inside.records["omega_m"][0][0]) * 30.0 / np.pi


@pytest.mark.every(2)
@pytest.mark.parametrize("name", EDS)
def test_our_master_turns_it_by_the_vendors_eds_and_brings_it_to_rest_before_it_is_off(on_a_bus, name):
    drive, master = on_a_bus(name)
    with master as drives:
        motion.enable(drives, mode="vl")
        motion.turn(drives, 600)
        drives.advance(0.4)
        assert rpm(drive) == pytest.approx(600, rel=0.02)
        trace = drives.record([0x6044], 0.3, play={0x6042: np.linspace(600, 300, 300).astype(int)})
        assert trace[0x6044][-1, 0] == pytest.approx(300, abs=30)
        motion.disable(drives)
        assert abs(rpm(drive)) < 10, "braked: without its voltage it would coast"
        motion.enable(drives, mode="vl")
        motion.turn(drives, -600)
        drives.advance(0.4)
        assert rpm(drive) == pytest.approx(-600, rel=0.02)
    assert abs(rpm(drive)) < 10 and one(drive, 0x6041) & 0x4F == 0x40, "closed while it turned"


@pytest.mark.parametrize("name", EDS)
def test_a_target_beyond_the_limit_of_speed_is_refused_in_counts_of_6042h(on_a_bus, name):
    _, master = on_a_bus(name, safety=Limits(velocity=500))  # of 6044h, and of 606Ch
    with master as drives:
        motion.enable(drives, mode="vl")
        for act in (
            lambda: motion.turn(drives, 510),
            lambda: drives.record([0x6041], 0.01, play={0x6042: np.full(10, -510)}),
        ):
            with pytest.raises(SafetyError, match=r"6042h:00 vl target velocity = -?510 is beyond the limit 500"):
                act()
        motion.turn(drives, 400)
        drives.advance(0.4)
        assert drives.read(0x6044)[0] == pytest.approx(400, abs=12)


def test_a_factor_counts_in_the_limit_of_a_target(on_a_bus):
    """A target of tenths of revolutions per second; the limit is one of revolutions per second, as 6044h."""
    factors = {(0x604C, 1): 60, (0x604B, 2): 10, (0x6046, 2): 20}
    _, master = on_a_bus("vl", factors, safety=Limits(velocity=8))
    with master as drives:
        motion.enable(drives, mode="vl")
        with pytest.raises(SafetyError, match="= 81 is beyond the limit 80"):
            motion.turn(drives, 81)
        motion.turn(drives, 50)
        with pytest.raises(SafetyError, match="changes the scale"):
            drives.write((0x604C, 1), 1)


def test_a_target_from_before_is_refused_as_the_axis_is_enabled(on_a_bus):
    drive, master = on_a_bus("vl", safety=Limits(velocity=500))
    with master as drives:
        drive.write(0x6042, 600)
        drives.write(0x6060, 2)
        with pytest.raises(SafetyError, match=r"its drive has 6042h.* = 600, beyond the limit 500"):
            for word in cia402.ENABLING:
                drives.write(0x6040, word)
        assert one(drive, 0x6041) & 0x6F != 0x27


def test_a_speed_beyond_the_limit_stops_the_axis(on_a_bus):
    """Another master raises its target, and the limit that was lent."""
    drive, master = on_a_bus("vl", safety=Limits(velocity=500))
    with master as drives:
        motion.enable(drives, mode="vl")
        motion.turn(drives, 400)
        drives.advance(0.3)
        drive.write((0x6046, 2), 4000)
        drive.write(0x6042, 1000)
        with pytest.raises(SafetyError, match=r"6044h.* is 5\d\d, and its limit is 500"):
            drives.advance(0.5)
        drives.advance(0.2)
        assert abs(rpm(drive)) < 10


def test_a_tighter_limit_is_lent_to_6046h_and_given_back(on_a_bus):
    drive, master = on_a_bus("vl", safety=Limits(velocity=500))
    own = one(drive, (0x6046, 2))
    with master as drives:
        motion.enable(drives, mode="vl")
        assert one(drive, (0x6046, 2)) == 500 and drives.read((0x6046, 2))[0] == own > 500
    assert one(drive, (0x6046, 2)) == own


def test_no_axis_is_faster_than_604ah_brings_to_rest_within_a_second(on_a_bus):
    drive, master = on_a_bus("vl")
    drive.write((0x604A, 1), 300)
    with master as drives:
        motion.enable(drives, mode="vl")
        with pytest.raises(SafetyError, match=r"= 301 is beyond the limit 300.*6085h: .* it \(in vl 604Ah\) stops"):
            motion.turn(drives, 301)
        motion.turn(drives, 250)
        drives.advance(0.4)
        for name, value in (((0x604A, 1), 200), ((0x604A, 2), 2)):
            with pytest.raises(SafetyError, match=f"= {value} would not stop it within 1 s"):
                drives.write(name, value)
        drives.write((0x604A, 1), 2000)
        motion.turn(drives, 400)


def test_604ah_limits_no_speed_of_other_modes(on_a_bus):
    drive, master = on_a_bus("vl and pv", {(0x604A, 1): 300})
    with master as drives:
        motion.enable(drives, mode="pv")
        motion.turn(drives, 600)
        drives.advance(0.4)
        assert rpm(drive) == pytest.approx(600, rel=0.02)
        motion.turn(drives, 0)
        drives.advance(0.4)
        motion.select_mode(drives, "vl")
        with pytest.raises(SafetyError, match="= 301 is beyond the limit 300"):
            motion.turn(drives, 301)


def test_a_slow_6049h_disables_no_axis_that_turns(on_a_bus):
    """By 6049h the axis would turn for 3 s; while "disable operation" ramps a drive obeys no quick stop."""
    drive, master = on_a_bus("vl")
    drive.write((0x6049, 1), 100)
    with master as drives:
        motion.enable(drives, mode="vl")
        motion.turn(drives, 300)
        drives.advance(0.4)
        drives.write(0x6040, 7)
        assert abs(rpm(drive)) < 10


def test_a_drive_without_a_position_takes_no_limits_of_one(on_a_bus):
    for limits in (Limits(position=(-1000, 1000)), Limits(following_error=100)):
        with pytest.raises(ValueError, match=r"the drive shows no position \(it has no 6064h\)"):
            on_a_bus("vl", safety=limits)


# --- what `drive-env new` makes of it ---------------------------------------------------------------------------------
def test_on_ethercat_it_gets_images_with_its_target_and_its_speed(tmp_path):
    made = new_device(EDS["vl"], tmp_path / "on_ethercat", find_motor(MOTOR), on_ethercat=True)
    known = find_device(str(made.folder)).new_dictionary()
    mapped = {known.find((index, sub)).default >> 16 for index in (0x1600, 0x1A00) for sub in (1, 2)}
    assert {0x6040, 0x6042, 0x6041, 0x6044} <= mapped


@pytest.mark.parametrize(
    ("changes", "taken", "told"),
    [
        ({"6060": {"LowLimit": 3, "HighLimit": 9}}, "pv", ("mode 2, vl", "6060h takes 3 to 9 alone by its limits")),
        ({"6060": {"LowLimit": 2, "HighLimit": 2}}, "vl", ("mode 3, pv", "6060h takes 2 to 2 alone by its limits")),
        ({"6502": {"DefaultValue": 0x4}}, "pv", None),
        ({"6502": {"DefaultValue": 0}, "6060": {"HighLimit": 2}}, "vl", ("mode 9, csv", "6060h takes -128 to 2")),
    ],
)
def test_modes_are_those_of_6502h_within_the_limits_of_6060h(tmp_path, changes, taken, told):
    text = EDS["vl and pv"].read_text(encoding="utf-8")
    for section, values in changes.items():
        text = put(text, section, **values)
    path = tmp_path / "some.eds"
    path.write_text(text, encoding="utf-8")
    made = new_device(path, tmp_path / "some", find_motor(MOTOR))
    notes = {note.what: note.why for note in made.modes}
    assert notes["taken"] == taken
    if told is not None:
        assert notes[told[0]].startswith(told[1])
    with emulated(made) as drives:
        assert one(drives, 0x6502) == sum(1 << cia402.MODES[name] - 1 for name in taken.split(", "))


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"6502": {"DefaultValue": 0x10}}, "mode 5: 6502h has it, and the emulator does not"),
        ({"6060": {"LowLimit": 3}}, "mode 2, vl: 6060h takes 3 to 127 alone by its limits"),
        ({"6502": {"DefaultValue": 0x1}}, "mode 1, pp: 6502h has it, and the EDS no 607Ah:00"),
    ],
)
def test_a_drive_of_which_no_mode_works_is_told_with_exit_code_1(tmp_path, changes, why):
    text = EDS["vl"].read_text(encoding="utf-8")
    for section, values in changes.items():
        text = put(text, section, **values)
    path = tmp_path / "some.eds"
    path.write_text(text.replace("HighLimit=2\n", ""), encoding="utf-8")
    done = CliRunner().invoke(app, ["new", "--eds", str(path), "--out", str(tmp_path / "some")])
    assert done.exit_code == 1
    assert "no mode of operation that works here" in done.stderr and why in done.stderr
    assert "6042h for vl, 60FFh for pv, 607Ah for pp" in done.stderr
    assert not (tmp_path / "some").exists()


# --- what people turn it with -----------------------------------------------------------------------------------------
def jog(drive, eds, *words, ramp=None):
    """Run `drive-env jog` on a drive of a ramp (6048h:01), which its master knows by the vendor's EDS alone."""
    with node(lockstep=False, machine=drive) as (_, bus):
        on = ["--eds", str(eds), *bus]
        if ramp is not None:
            assert not CliRunner().invoke(app, ["set", "6048:1", str(ramp), "--yes", *on]).exit_code
        found = CliRunner().invoke(app, ["jog", *words, "--json", *on])
    return found.exit_code, json.loads(found.stdout or "null"), found.stderr


@pytest.mark.parametrize(("speed", "out"), [(-300, ()), pytest.param(300, ("--out", "turn"), marks=pytest.mark.slow)])
def test_jog_turns_it_in_vl_and_brings_it_to_rest(tmp_path, monkeypatch, folders, speed, out):
    monkeypatch.chdir(tmp_path)
    with emulated(folders["vl"]) as drive:
        told = jog(drive, EDS["vl"], str(speed), "--for", "0.4", *out)
        assert told == (0, {"speed": pytest.approx(speed, abs=6), "emergencies": [], "stopped": ""}, "")
        assert abs(rpm(drive)) < 10 and one(drive, 0x6041) & 0x4F == 0x40 and one(drive, 0x6060) == cia402.VL
    if not out:
        return
    rows = np.loadtxt(tmp_path / "turn.csv", delimiter=",", skiprows=1)
    assert (tmp_path / "turn.csv").read_text().splitlines()[0].split(",")[2] == "6042h:00 vl target velocity"
    assert (rows[:, 2] == speed).sum() == 400 and np.abs(rows[-1, 3]) < 10 < 0.9 * 300 < np.abs(rows[:, 3]).max()


def test_jog_says_what_keeps_a_drive_of_vl_from_turning(folders):
    """Refused before it is enabled: a way without a position; a ramp that never rises. Else its speed tells it."""
    with emulated(folders["vl"]) as drive:  # of its own: one that still turns would be held at its speed
        code, _, why = jog(drive, EDS["vl"], "300", "--by", "100")
        assert code == 2 and "--by 100: granit_fu3 has no position to move to; use --for" in why
        code, _, why = jog(drive, EDS["vl"], "300", ramp=0)
        assert code == 2 and "the drive's acceleration 6048h:01 is 0, so nothing would move" in why
        code, told, why = jog(drive, EDS["vl"], "300", "--for", "0.2", ramp=1)
        assert code == 1 and abs(told["speed"]) < 3 and "the axis hardly moved" in why


@pytest.mark.slow
def test_jog_turns_a_drive_that_has_pv_too_in_pv(folders):
    with emulated(folders["vl and pv"]) as drive:
        code, told, _ = jog(drive, EDS["vl and pv"], "300", "--for", "0.4")
        assert code == 0 and told["moved"] > 0 and one(drive, 0x6060) == cia402.PV


@pytest.mark.parametrize(
    ("values", "mode"),
    [({0x6502: 0x2}, "vl"), ({0x6502: 0x6}, "pv"), ({0x6502: 0}, "pv"), ({0x6502: 0x1}, "pv"), ({}, "vl")],
)
def test_the_mode_that_turns_is_pv_where_6502h_or_without_it_60ffh_tells_of_it(values, mode):
    """With 6502h the drive has 60FFh, and without neither."""

    class Told:
        def read(self, name):
            if not values:
                raise ObjectAccessError(NO_SUCH_OBJECT, "none")
            return np.array([values.get(name, 0)])

    assert motion.turning_mode(Told()) == mode
