"""Limits of each axis, as places of its rotor; what is lent to a drive, and that it has its own again afterwards."""

from __future__ import annotations

import math

import pytest
from rigs.foreign_eds import ABORT_CONNECTION, ENCODER_RESOLUTION, MAX_PROFILE_VELOCITY, foreign
from rigs.scripted_drive import ScriptedBus, ScriptedDrive
from rigs.world_bus import served

from drive_env import CanDrives, Limits, SafetyError, cia402, motion
from drive_env.devices import find_device
from drive_env.master.can.error_control import MASTERS

TURN = 65536
SLACK = 0.025  # rev: bounds.SLACK_TURNS, and some counts of a settled axis
SCALE, LOW, HIGH, CURRENT, WINDOW = (0x2058, 0), (0x607D, 1), (0x607D, 2), (0x2003, 0), (0x6065, 0)


@pytest.fixture
def drive():
    return ScriptedDrive(values={SCALE: (TURN, 4), (0x6085, 0): (1000 * TURN, 4), (0x605A, 0): (2, 2)})


@pytest.fixture
def bus(drive):
    with ScriptedBus(drive) as made:
        yield made


# --- what a user may state ----------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"silence": 0.0004}, r"silence = 0.0004 s is impossible: .* choose 0.02 to 65.535 s"),
        ({"silence": 66.0}, "silence = 66.0 s is impossible"),
        ({"silence": math.nan}, "silence = nan s is impossible"),
        ({"stall": math.inf}, "stall must be above 0 s, not inf"),
        ({"velocity": math.nan}, "velocity must be above 0, not nan"),
        ({"velocity": (100.0, -1.0)}, "velocity must be above 0"),
        ({"position": (1.0, math.nan)}, "position limits are lowest and highest"),
        ({"position": ((0, 0), (5, 0))}, "position limits are lowest and highest"),
    ],
)
def test_limits_that_cannot_be_are_told(given, text):
    with pytest.raises(ValueError, match=text):
        Limits(**given)


@pytest.mark.parametrize("safety", [None, 0, 1, "off", {}])
def test_nobody_is_left_unwatched_by_mistake(bus, drive, safety):
    with pytest.raises(TypeError, match=r"safety = .* must be Limits, True .*, or False for an emulator"):
        CanDrives(bus=bus, pace="lockstep", safety=safety)
    assert not drive.log


def test_a_limit_has_one_value_or_one_for_each_axis(bus):
    with pytest.raises(ValueError, match="position has 2 values for 1 axes; give one for all, or one each"):
        CanDrives(bus=bus, pace="lockstep", safety=Limits(position=((0, 0), (5, 5))))


# --- each axis has its own ----------------------------------------------------------------------------------------
def test_each_axis_has_its_own_travel_and_a_free_one_frees_no_other():
    nodes = [ScriptedDrive(node, {SCALE: (TURN, 4), (0x6085, 0): (1000 * TURN, 4)}) for node in (1, 2, 3)]
    nodes[1].set(0x6064, 50 * TURN)
    limits = Limits(position=((-TURN, 49 * TURN, -math.inf), (TURN, 51 * TURN, math.inf)))
    with ScriptedBus(*nodes) as bus, CanDrives(bus=bus, nodes=(1, 2, 3), pace="lockstep", safety=limits) as drives:
        motion.enable(drives, mode="csp")
        drives.write(0x607A, [0, 50 * TURN, 1000 * TURN])
        with pytest.raises(SafetyError, match=rf"axis 0: .* would lead to {50 * TURN}"):
            drives.write(0x607A, [50 * TURN, 50 * TURN, 0])
        with pytest.raises(SafetyError, match=r"axis 1: .* would lead to 0, beyond"):
            drives.write(0x607A, [0, 0, 0])
        assert [node.get(*HIGH) < 2**31 - 1 for node in nodes] == [True, True, False]
        assert nodes[0].get(*LOW) < -TURN < nodes[0].get(*HIGH)


def test_travel_stays_where_it_is_when_the_scale_changes(bus, drive):
    drive.set(0x6064, TURN)
    with CanDrives(bus=bus, pace="lockstep", safety=Limits(position=(0, 3 * TURN))) as drives:
        drive.set(0x6064, 1024)  # one turn, counted anew
        drives.write(SCALE, 1024)
        motion.enable(drives, mode="csp")
        drives.write(0x607A, 3 * 1024)
        with pytest.raises(SafetyError, match=f"would lead to {3 * 1024 + 1}, beyond the limits 0 to {3 * 1024}"):
            drives.write(0x607A, 3 * 1024 + 1)
        with pytest.raises(SafetyError, match="2058h:00 Position Scaler changes the scale of positions"):
            drives.write(SCALE, 4096)


def test_the_direction_of_positions_is_not_turned_round_under_limits(bus):
    drives = CanDrives(bus=bus, pace="lockstep", safety=Limits(position=(0, TURN)))
    with drives, pytest.raises(SafetyError, match=r"2057h:00 .* turns positions round"):
        drives.write(0x2057, 1)


@pytest.mark.parametrize(("limits", "mode", "key"), [
    (Limits(velocity=10 * TURN), "csv", (0x60FF, 0)), (Limits(velocity=10 * TURN), "hm", (0x6099, 1)),
])  # fmt: skip
def test_a_limit_of_speed_is_the_rotors_when_the_scale_changes(bus, drive, limits, mode, key):
    drive.values[0x6099, 1] = (0, 4)
    with CanDrives(bus=bus, pace="lockstep", safety=limits) as drives:
        drives.write(SCALE, 256)
        motion.select_mode(drives, mode)
        drives.write(key, 10 * 256)
        with pytest.raises(SafetyError, match="= 2561 is beyond the limit 2560; nothing was sent"):
            drives.write(key, 10 * 256 + 1)


def test_a_limit_of_the_following_error_is_the_rotors_when_the_scale_changes(bus, drive):
    with CanDrives(bus=bus, pace="lockstep", safety=Limits(following_error=TURN // 2)) as drives:
        drives.write(SCALE, 256)
        motion.enable(drives, mode="csp")
        drive.set(0x6062, 129)
        with pytest.raises(SafetyError, match="the following error is 129, and its limit is 128"):
            drives.advance(0.01)


# --- homing: a new zero is no movement, and a movement no new zero ------------------------------------------------
def test_a_new_zero_does_not_move_the_limits(bus, drive):
    drive.set(0x6064, round(0.9 * TURN))
    drive.set(0x6061, 6)

    def find_zero(drive):
        drive.set(0x6064, 0)

    with CanDrives(bus=bus, pace="lockstep", safety=Limits(position=(-TURN, TURN))) as drives:
        motion.enable(drives, mode="hm")
        drive.motion = find_zero
        drives.advance(0.02)
        drive.set(0x6061, 8)
        drives.write(0x607A, round(-1.8 * TURN))
        with pytest.raises(SafetyError, match=r"607Ah:00 .* would lead to 13107, beyond the limits -124518 to 6554"):
            drives.write(0x607A, round(0.2 * TURN))


@pytest.mark.parametrize("scale", [TURN, 256])
@pytest.mark.parametrize("turns", [80.0, 400.0, 1000.0], ids="{:g} rev/s^2".format)
def test_an_axis_that_accelerates_in_homing_is_seen(bus, drive, scale, turns):
    """606Ch is late or does not come at all: a step of a millisecond that it does not explain is a movement still."""
    drive.set(0x2058, scale)
    drive.set(0x6061, 6)
    turned = []

    def accelerate(drive):
        turned.append(0.5 * turns * (0.001 * len(turned)) ** 2)
        drive.set(0x6064, round(turned[-1] * scale))

    with CanDrives(bus=bus, pace="lockstep", safety=Limits(position=(-scale, scale))) as drives:
        motion.enable(drives, mode="hm")
        drive.motion = accelerate
        with pytest.raises(SafetyError, match="beyond the limits"):
            drives.advance(1.0)
        speed = (2.0 * turns) ** 0.5  # at the end of its travel
        assert turned[-1] < 1.0 + SLACK + 0.002 * speed


# --- sums ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("limits", "mode", "first", "second"),
    [
        (Limits(position=(-1000, 1000)), "csp", (0x607A, 600), (0x60B0, 401)),
        (Limits(position=(-1000, 1000)), "csp", (0x60B0, 600), (0x607A, 401)),
        (Limits(velocity=1000), "csv", (0x60FF, 600), (0x60B1, 401)),
        (Limits(current=1000), "cst", (0x6071, 600), (0x60B2, 401)),
    ],
)
def test_set_points_are_checked_as_what_they_add_up_to(bus, drive, limits, mode, first, second):
    drive.values |= {(index, 0): (0, 4) for index in (0x60B0, 0x60B1)} | {(0x60B2, 0): (0, 2)}
    with CanDrives(bus=bus, pace="lockstep", safety=limits) as drives:
        motion.enable(drives, mode=mode)
        drives.write(*first)
        with pytest.raises(SafetyError, match="1001"):
            drives.write(*second)
        with pytest.raises(SafetyError, match="1001"):
            drives.record([0x6064], 0.002, play={first[0]: [600, 600], second[0]: [400, 401]})
        drives.write(second[0], second[1] - 1)


# --- speed --------------------------------------------------------------------------------------------------------
def test_a_drive_without_a_limit_of_speed_turns_no_faster_than_6000_rpm(bus):
    with CanDrives(bus=bus, pace="lockstep") as drives:
        drives.write(0x60FF, 100 * TURN)
        with pytest.raises(SafetyError, match=r"raise Limits\(velocity=\.\.\.\): this drive has no limit of its own"):
            drives.write(0x60FF, 100 * TURN + 1)


def test_no_axis_is_faster_than_its_quick_stop_brings_to_rest_within_a_second(bus, drive):
    drive.set(0x6085, 10 * TURN)
    with CanDrives(bus=bus, pace="lockstep", safety=Limits(velocity=50 * TURN)) as drives:
        drives.write(0x60FF, 10 * TURN)
        with pytest.raises(SafetyError, match="raise the quick stop's ramp, 6085h"):
            drives.write(0x60FF, 10 * TURN + 1)


# --- what is lent -------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("key", [(0x6081, 0), (0x6099, 1), (0x6099, 2), (0x60FF, 0), (0x60B1, 0)])
def test_every_object_that_commands_a_speed_is_held_against_its_limit(bus, drive, key):
    drive.values[key] = (0, 4)
    with CanDrives(bus=bus, pace="lockstep", safety=Limits(velocity=10 * TURN)) as drives:
        drives.write(key, 10 * TURN)
        with pytest.raises(SafetyError, match=f"= {10 * TURN + 1} is beyond the limit {10 * TURN}; nothing was sent"):
            drives.write(key, 10 * TURN + 1)


RUNNING = [("pv", (0x60FF, 0)), ("csv", (0x60FF, 0)), ("csv", (0x60B1, 0))]
STARTED = [("pp", (0x6081, 0)), ("hm", (0x6099, 1)), ("hm", (0x6099, 2))]


@pytest.mark.parametrize(("mode", "key"), RUNNING)
def test_a_speed_that_a_drive_has_from_before_is_held_against_the_limit_when_it_is_enabled(bus, drive, mode, key):
    drive.values |= {(0x60FF, 0): (0, 4), (0x60B1, 0): (0, 4), key: (10 * TURN + 1, 4)}
    with CanDrives(bus=bus, pace="lockstep", safety=Limits(velocity=10 * TURN)) as drives:
        drives.write(0x6060, cia402.MODES[mode])  # `motion.enable` would write over it
        with pytest.raises(SafetyError, match=f"= {10 * TURN + 1}, beyond the limit {10 * TURN}; nothing was sent"):
            for word in cia402.ENABLING:
                drives.write(0x6040, word)
        assert drive.get(0x6041) & 0x6F != 0x27
        words = [6, 6, 6, 7, 7, 7, 15, 15, 15]
        with pytest.raises(SafetyError, match="Write less there first"):
            drives.record([0x6064], 0.009, play={0x6040: words})
        drives.write(key, 10 * TURN)
        motion.enable(drives, mode=mode)


@pytest.mark.parametrize(("mode", "key"), RUNNING)
def test_it_is_so_at_a_change_of_mode_and_of_the_ramp(bus, drive, mode, key):
    drive.values |= {(0x60FF, 0): (0, 4), (0x60B1, 0): (0, 4)}
    with CanDrives(bus=bus, pace="lockstep", safety=Limits(velocity=10 * TURN)) as drives:
        motion.enable(drives, mode="pp")
        drive.values[key] = (10 * TURN + 1, 4)
        with pytest.raises(SafetyError, match=r"its drive has .*Write less there first"):
            drives.write(0x6060, cia402.MODES[mode])
        drive.values[key] = (5 * TURN, 4)
        drives.write(0x6060, cia402.MODES[mode])
        with pytest.raises(SafetyError, match=f"its drive has .* = {5 * TURN}, beyond the limit {4 * TURN}"):
            drives.write(0x6085, 4 * TURN)
        drives.write(0x6085, 5 * TURN)


@pytest.mark.parametrize(("mode", "key"), STARTED)
def test_it_is_so_when_a_move_is_started(bus, drive, mode, key):
    drive.values |= {(0x6081, 0): (TURN, 4), (0x6099, 1): (TURN, 4), (0x6099, 2): (TURN, 4), key: (10 * TURN + 1, 4)}
    with CanDrives(bus=bus, pace="lockstep", safety=Limits(velocity=10 * TURN)) as drives:
        motion.enable(drives, mode=mode)
        with pytest.raises(SafetyError, match=f"= {10 * TURN + 1}, beyond the limit {10 * TURN}; nothing was sent"):
            drives.write(0x6040, 0x1F)
        with pytest.raises(SafetyError, match="Write less there first"):
            drives.record([0x6064], 0.002, play={0x6040: [0x0F, 0x1F]})
        assert drive.get(0x6040) == 0x0F
        drives.write(key, 10 * TURN)
        drives.write(0x6040, 0x1F)


# --- a torque has no speed, nor has a set-point that may jump -------------------------------------------------------
SLOW, FAST_ENOUGH = 100 * TURN - 1, 100 * TURN  # increments/s^2: 6,000 rpm within a second


@pytest.mark.parametrize("mode", ["cst", "csp", "pv"])
@pytest.mark.parametrize("ramp", [0, 51200, SLOW, FAST_ENOUGH])
def test_a_mode_without_a_speed_wants_a_ramp_that_stops_what_a_torque_makes_fast(bus, drive, mode, ramp):
    drive.set(0x6085, ramp)
    with CanDrives(bus=bus, pace="lockstep") as drives:
        if mode != "pv" and ramp < FAST_ENOUGH:
            with pytest.raises(
                SafetyError, match=f"6085h = {ramp} is too slow for it; nothing was sent. Have 6085h at"
            ):
                motion.enable(drives, mode=mode)
            assert drive.get(0x6041) & 0x6F != 0x27
        else:
            motion.enable(drives, mode=mode)


def test_neither_the_mode_nor_the_ramp_changes_under_an_axis_so_that_a_torque_has_no_ramp(bus, drive):
    with CanDrives(bus=bus, pace="lockstep") as drives:
        motion.enable(drives, mode="cst")
        with pytest.raises(SafetyError, match=f"6085h = {SLOW} is too slow"):
            drives.write(0x6085, SLOW)
        drives.write(0x6060, 9)
        drives.write(0x6085, SLOW)
        with pytest.raises(SafetyError, match=f"6085h = {SLOW} is too slow"):
            drives.write(0x6060, 10)
        with pytest.raises(SafetyError, match=f"6085h = {SLOW} is too slow"):
            drives.record([0x6064], 0.002, play={0x6060: [9, 10]})


def test_a_tighter_limit_is_lent_to_the_drive_which_has_its_own_again(bus, drive):
    own = {key: drive.get(*key) for key in (LOW, HIGH, CURRENT, WINDOW)}
    limits = Limits(position=(-TURN, TURN), current=500, following_error=300)
    with CanDrives(bus=bus, pace="lockstep", safety=limits) as drives:
        motion.enable(drives, mode="csp")
        assert (drive.get(*CURRENT), drive.get(*WINDOW)) == (500, 300)
        assert -2 * TURN < drive.get(*LOW) < -TURN and TURN < drive.get(*HIGH) < 2 * TURN
        assert drives.read(CURRENT)[0] == 7000 and drives.read(HIGH)[0] == 2**31 - 1  # the program's own
        drives.write(CURRENT, 400)  # tighter still
        assert drive.get(*CURRENT) == 400
        motion.disable(drives)
    assert {key: drive.get(*key) for key in own} == own | {CURRENT: 400}


def test_nothing_is_lent_without_limits(bus, drive):
    with CanDrives(bus=bus, pace="lockstep") as drives:
        motion.enable(drives, mode="csv")
        assert not any(data[0] & 0xE0 == 0x20 and data[1:3] in (b"\x7d\x60", b"\x03\x20") for data in bus.sent(0x601))


@pytest.mark.parametrize("pace", ["lockstep", "real-time"])
def test_what_a_drive_stores_is_its_own_and_has_neither_our_pdos_nor_our_watchdog(bus, drive, pace):
    drive.values |= {(0x1010, 1): (0, 4), (0x1029, 1): (1, 1)}
    lasting = [key for key in drive.values if 0x1016 <= key[0] < 0x1C00 or key in (HIGH, CURRENT)]
    before, stored = {key: drive.get(*key) for key in lasting}, {}
    truly = drive.set

    def store(index, value, sub=0):
        if index == 0x1010:
            stored.update({key: drive.get(*key) for key in lasting})
        truly(index, value, sub)

    drive.set = store
    with CanDrives(bus=bus, pace=pace, safety=Limits(position=(-TURN, TURN), current=500)) as drives:
        motion.enable(drives, mode="csp")
        drives.record([0x606C, 0x6077], 0.005, play={0x607A: [0] * 5})
        motion.disable(drives)
        assert {key for key in lasting if drive.get(*key) != before[key]} > {CURRENT, (0x1600, 1), (0x1A00, 1)}
        drives.write((0x1010, 1), 0x65766173)
        assert stored == before
        motion.enable(drives, mode="csp")
        assert drive.get(*CURRENT) == 500
        drives.record([0x606C, 0x6077], 0.005, play={0x607A: [0] * 5})


def test_the_drive_itself_holds_the_travel_when_nobody_watches():
    """The emulator, its master gone silent in the middle of a run that would leave the travel."""
    with served("calls", load="inertia", safety=Limits(position=(-TURN, TURN))) as drives:
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, 5 * TURN)
        world = drives._port._bus._world
        for _ in range(1000):
            world.cycle()
        (emulated,) = world.drives if hasattr(world, "drives") else world._drives
        turns = emulated.read(0x6064)[0] / TURN
        assert 0.9 < turns < 1.2 and abs(emulated.read(0x606C)[0]) < 0.3 * TURN


# --- who watches over whom ----------------------------------------------------------------------------------------
def test_a_watchdog_that_a_dead_master_left_is_replaced_and_not_put_back(bus, drive):
    drive.set(0x1016, MASTERS[3] << 16 | 20, 1)
    with CanDrives(bus=bus) as drives:
        motion.enable(drives, mode="csv")
        motion.disable(drives)
    assert drive.get(0x1016, 1) == 0


@pytest.mark.slow
def test_a_drive_that_watches_a_living_master_is_refused(bus, drive):
    drive.set(0x1016, 5 << 16 | 1000, 1)
    truly = bus._recv_internal

    def beating(timeout):
        bus.push(0x705, b"\x05")
        return truly(timeout)

    bus._recv_internal = beating
    with CanDrives(bus=bus) as drives:
        with pytest.raises(SafetyError, match=r"another master, whose heartbeats still come \(node-ID 5, 1016h\)"):
            motion.enable(drives, mode="csv")
        assert drive.get(0x1016, 1) == 5 << 16 | 1000
        assert drive.get(0x6040) != 0x0F


def test_a_second_heartbeat_under_our_number_stops_the_drives(bus, drive):
    with CanDrives(bus=bus) as drives:
        motion.enable(drives, mode="csv")
        bus.push(0x700 + (drive.get(0x1016, 1) >> 16), b"\x05")
        with pytest.raises(SafetyError, match="another program sends heartbeats as node-ID"):
            for _ in range(1000):
                drives.read(0x6041)
                drives.advance(0.002)
    assert drive.get(0x6041) & 0x6F != 0x27


# --- drives of other makers -----------------------------------------------------------------------------------------


def test_a_drive_that_would_do_nothing_without_its_master_is_told_to_stop(tmp_path, bus, drive):
    drive.values[0x6007, 0] = (0, 2)
    with CanDrives(eds=foreign(tmp_path, ABORT_CONNECTION), bus=bus) as drives:
        motion.enable(drives, mode="csv")
        assert drive.get(0x6007) == 3
        motion.disable(drives)
    assert drive.get(0x6007) == 0


def test_a_quick_stop_that_coasts_is_made_a_ramp(bus, drive):
    drive.set(0x605A, 0)
    with CanDrives(bus=bus, pace="lockstep") as drives:
        motion.enable(drives, mode="csv")
        assert drive.get(0x605A) == 2
        motion.disable(drives)
    assert drive.get(0x605A) == 0
    drive.refusals[0x605A, 0] = 0x06090030
    with CanDrives(bus=bus, pace="lockstep") as drives, pytest.raises(SafetyError, match="lets it coast"):
        motion.enable(drives, mode="csv")


def test_a_drive_of_unknown_units_is_watched_by_its_positions(tmp_path, bus, drive):
    """606Ch may count anything: 100 revolutions a second are told by 6064h."""
    drive.values[0x608F, 1], drive.values[0x608F, 2] = (TURN, 4), (1, 4)
    with CanDrives(eds=foreign(tmp_path, ENCODER_RESOLUTION), bus=bus, pace="lockstep") as drives:
        motion.enable(drives, mode="csv")
        drive.motion = lambda d: d.set(0x6064, d.get(0x6064) + TURN // 5)  # 200 rev/s
        with pytest.raises(SafetyError, match=r"turns by \d+ increments a second, and its limit is 6553600"):
            drives.advance(0.1)


@pytest.mark.parametrize(("speed", "stops"), [(60 * TURN, True), (-60 * TURN, False), (20 * TURN, False)])
def test_the_end_of_the_travel_is_kept_by_the_way_that_a_stop_takes(bus, drive, speed, stops):
    """60 rev/s take 1.8 turns of ramp and 0.6 of latency: from 1 turn they lead beyond 3, backwards they do not."""
    with CanDrives(bus=bus, pace="lockstep", safety=Limits(position=(-3 * TURN, 3 * TURN))) as drives:
        motion.enable(drives, mode="csv")
        drive.set(0x6064, TURN)
        drive.set(0x606C, speed)
        if stops:
            with pytest.raises(SafetyError, match="its stop would end"):
                drives.advance(0.005)
        else:
            drives.advance(0.005)
        drive.set(0x606C, 0)


@pytest.mark.parametrize("scale", [256, 1024, TURN])
@pytest.mark.parametrize(("turns", "stops"), [(0.002, False), (0.03, True), (0.5, True)])
def test_a_coarse_scale_of_positions_gives_an_axis_no_more_room_beyond_its_end(bus, drive, scale, turns, stops):
    """Overshoot and noise of an axis at its limit are within 0.02 turns, whatever an increment is."""
    drive.set(0x2058, scale)
    with CanDrives(bus=bus, pace="lockstep", safety=Limits(position=(-3 * scale, 3 * scale))) as drives:
        motion.enable(drives, mode="csv")
        drives.advance(0.005)
        drive.set(0x6064, round((3.0 + turns) * scale))
        if stops:
            with pytest.raises(SafetyError, match="beyond the limits"):
                drives.advance(0.005)
        else:
            drives.advance(0.005)


@pytest.mark.parametrize(("scale", "refused"), [(1, True), (49, True), (50, False)])
def test_positions_too_coarse_for_a_travel_to_be_watched_are_refused(bus, drive, scale, refused):
    drive.set(0x2058, scale)
    with CanDrives(bus=bus, pace="lockstep", safety=Limits(position=(-3 * scale, 3 * scale))) as drives:
        if refused:
            with pytest.raises(SafetyError, match=rf"a revolution has {scale} increments \(2058h\), too few .* Set 50"):
                motion.enable(drives, mode="csv")
            assert drive.get(0x6041) & 0x6F != 0x27
        else:
            motion.enable(drives, mode="csv")
    with CanDrives(bus=bus, pace="lockstep", safety=Limits(velocity=3 * scale)) as drives:
        motion.enable(drives, mode="csv")  # no travel to watch


# --- zero and "off" --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("window", "stops"), [(0, False), (2**31 - 1, False), (5000, True), (20_000, False)])
def test_a_following_error_window_of_0_is_no_limit(bus, drive, window, stops):
    """As every drive has it from its factory that checks none (6065h, CiA 402)."""
    drive.set(0x6065, window)
    with CanDrives(bus=bus, pace="lockstep") as drives:
        motion.enable(drives, mode="csp")
        drives.advance(0.005)
        drive.set(0x6062, 10_000)
        if stops:
            with pytest.raises(SafetyError, match="the following error is 10000, and its limit is 5000"):
                drives.advance(0.005)
        else:
            drives.advance(0.005)


@pytest.mark.parametrize(("own", "limit"), [(0, 100 * TURN), (2**31 - 1, 100 * TURN), (2000, 2000)])
def test_a_maximum_profile_velocity_of_0_is_no_limit(tmp_path, bus, drive, own, limit):
    """607Fh at its factory value; 6,000 rpm are taken then."""
    path = tmp_path / "with 607Fh.eds"
    text = find_device("tmcm1636").eds.read_text(encoding="utf-8")
    path.write_text(text + MAX_PROFILE_VELOCITY + ENCODER_RESOLUTION, encoding="utf-8")
    drive.values |= {(0x607F, 0): (own, 4), (0x608F, 1): (TURN, 4), (0x608F, 2): (1, 4)}
    with CanDrives(eds=path, bus=bus, pace="lockstep") as drives:
        drives.write(0x60FF, limit)
        with pytest.raises(SafetyError, match=f"60FFh.* = {limit + 1} is beyond the limit {limit}"):
            drives.write(0x60FF, limit + 1)
