"""How a motor's cable is wired: what each wiring does with each setting, and that identify and auto find it.

The truth, which way the rotor turns, is looked up inside the emulator; what the drive shows is no proof.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from rigs.thinning import part
from rigs.world_bus import served

from drive_env import EmulatedDrives, motion
from drive_env.devices import find_device
from drive_env.emulator.parameters import WIRING
from drive_env.motors import MOTORS
from drive_env.safety.envelope import SafetyError
from tuning.auto.one_button import Method, auto
from tuning.compare.suite import load_suite, open_group
from tuning.identify.identification import identify
from tuning.identify.quick_identification import identify_briefly
from tuning.identify.wiring import Setting, changes, corrected, finding, judge_halls
from tuning.target import Target, emulated

MOTOR = MOTORS["qbl4208"]
HALL, ENCODER = 2, 3  # 2055h
SPEED = 20.0  # rad/s
ENCODER_DIRECTION, HALL_POLARITY, HALL_DIRECTION = (0x2080, 1), (0x2070, 1), (0x2070, 2)
OBJECTS = (ENCODER_DIRECTION, HALL_POLARITY, HALL_DIRECTION)
EVERY = np.array(list(itertools.product((0, 1), repeat=3)))  # encoder direction, hall polarity, hall direction


def to_pps(omega):
    return np.rint(np.asarray(omega) / (2.0 * math.pi) * 65536).astype(int)


def wired(rows):
    """Return machine parameters of wirings, (n, 3)."""
    return dict(zip(WIRING, np.asarray(rows, float).T, strict=True))


def settings(drives):
    return np.stack([drives.read(key) for key in OBJECTS], axis=1)


def turn(drives, commutation):
    """Ask all axes for a speed, and return how far their rotors go in the last half second [turns of that speed]."""
    drives.write(0x2055, commutation)
    drives.write(0x6065, 0)  # nothing trips: what the motor does is looked at
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, to_pps(SPEED))
    drives.advance(0.5)
    before = drives.machine.rotor_angle
    drives.advance(0.5)
    return (drives.machine.rotor_angle - before) / (0.5 * SPEED)


# --- physics ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("commutation", "counts"), [(ENCODER, [True, False, False]), (HALL, [False, True, True])], ids=["encoder", "halls"]
)
def test_a_motor_turns_the_right_way_if_its_drive_is_set_as_it_is_wired(commutation, counts):
    """Eight wirings with eight settings each; of halls only those count that commutate, of the encoder likewise."""
    wiring, setting = np.repeat(EVERY, 8, axis=0), np.tile(EVERY, (8, 1))
    with EmulatedDrives(load="inertia", num_machines=64, parameters=wired(wiring), num_threads=1) as drives:
        for key, values in zip(OBJECTS, setting.T, strict=True):
            drives.write(key, values)
        share = turn(drives, commutation)
    right = np.all((wiring == setting) | ~np.array(counts), axis=1)
    np.testing.assert_allclose(share[right], 1.0, atol=0.05)
    assert np.all(np.abs(share[~right] - 1.0) > 0.3)


@pytest.mark.parametrize("wiring", EVERY.tolist())
def test_a_drive_that_is_set_right_shows_the_same_to_the_bit_however_the_motor_is_wired(wiring):
    names = [0x6064, 0x606C, 0x6077, 0x2103, 0x2104]
    traces = []
    for wires in (MOTOR.encoder_direction, MOTOR.hall_polarity, MOTOR.hall_direction), wiring:
        with EmulatedDrives(load="two_mass", seed=5, parameters=wired(wires), num_threads=1) as drives:
            for key, value in zip(OBJECTS, wires, strict=True):
                drives.write(key, value)
                motion.enable(drives, mode="pv")
            drives.write(0x60FF, 300_000)
            traces.append(drives.record(names, 0.1))
    assert np.ptp(traces[0][0x6064]) > 1000
    for name in names[:4]:
        np.testing.assert_array_equal(traces[0][name], traces[1][name])


def test_a_cable_is_changed_at_work_and_what_was_counted_stays():
    with EmulatedDrives(load="inertia", num_machines=2, num_threads=1) as drives:
        motion.enable(drives, mode="pp")
        motion.move_to(drives, 100_000)
        motion.disable(drives)
        drives.advance(0.5)
        before = drives.read(0x6064)
        drives.machine.set("motor.encoder_direction", 1 - MOTOR.encoder_direction, np.array([True, False]))
        drives.advance(0.01)
        assert abs(before[0]) > 50_000
        np.testing.assert_allclose(drives.read(0x6064), before, atol=16)
        drives.machine.load_torque = 0.02
        angle = drives.machine.rotor_angle
        drives.advance(0.1)
        turned = (drives.machine.rotor_angle - angle) / (2.0 * math.pi) * 65536
        np.testing.assert_allclose(drives.read(0x6064) - before, turned * [-1.0, 1.0], rtol=0.05)


def test_a_wiring_is_0_or_1():
    with EmulatedDrives(load="inertia", num_threads=1) as drives, pytest.raises(ValueError, match=r"0 or 1.*not 0\.5"):
        drives.machine.set("motor.hall_direction", 0.5)


@pytest.mark.parametrize(
    ("commissioned", "randomise", "drawn"),
    [
        (False, True, True),  # factory values: whoever commissions it looks
        (False, False, False),
        (True, True, False),  # the preset is taken for granted
        (True, ["motor"], False),
        (True, ["motor.encoder_direction"], True),
    ],
)
def test_wiring_is_drawn_with_the_rest_where_nobody_takes_it_for_granted(commissioned, randomise, drawn):
    options = {"commissioned": commissioned, "randomise": randomise}
    with EmulatedDrives(load="inertia", num_machines=40, seed=1, **options) as drives:
        found = drives.machine.parameters["motor.encoder_direction"]
    assert set(found) == ({0.0, 1.0} if drawn else {float(MOTOR.encoder_direction)})
    if drawn:
        assert 0.25 < found.mean() < 0.75


# --- the maker's programs ---------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_the_settings_of_the_maker_s_demonstration_programs_turn_the_default_served_drive():
    """They write 2080h:01 = 1 and 2070h:01 = 1, then turn by the encoder, and by the halls."""
    with served("calls", load="inertia") as drives:
        assert drives.read(ENCODER_DIRECTION)[0] == 1  # a commissioned drive has it so
        assert drives.read(HALL_POLARITY)[0] == 1
        for commutation in (ENCODER, HALL):
            drives.write(ENCODER_DIRECTION, 1)
            drives.write(HALL_POLARITY, 1)
            drives.write(0x2055, commutation)
            motion.enable(drives, mode="pv")
            drives.write(0x60FF, to_pps(SPEED))
            drives.advance(0.5)
            trace = drives.record([0x606C], 0.3)
            assert trace[0x606C].mean() == pytest.approx(to_pps(SPEED), rel=0.05)
            motion.quick_stop(drives)
            drives.advance(0.2)
            motion.disable(drives)


def test_a_drive_that_is_set_wrong_is_stopped_by_itself_or_by_the_envelope():
    """It runs away or is locked: the envelope, or the drive's own following error, ends that within a second."""
    with served("calls", load="inertia") as drives:
        drives.write(ENCODER_DIRECTION, 0)
        motion.enable(drives, mode="pv")
        try:
            drives.write(0x60FF, to_pps(10.0 * SPEED))
            drives.advance(1.0)
        except SafetyError as error:
            assert "axis 0" in str(error)
        assert drives.read(0x6041)[0] & 0x6F != 0x27


# --- what halls say ---------------------------------------------------------------------------------------------------
FIELD = np.linspace(0.3, 0.3 + 2.0 * math.pi, 11)


def sectors(angle):
    """Return what halls tell of an angle: the middle of its sector."""
    return (np.floor(angle / (math.pi / 3.0)) + 0.5) * (math.pi / 3.0)


@pytest.mark.parametrize(
    ("field", "halls", "expected"),
    [
        (FIELD, sectors(FIELD), (False, False)),
        (FIELD, sectors(FIELD) + math.pi, (False, True)),
        (FIELD, -sectors(FIELD), (True, False)),
        (FIELD, math.pi - sectors(FIELD), (True, True)),
        (-FIELD, sectors(-FIELD), (False, False)),
        (FIELD, sectors(FIELD - 0.4), (False, False)),  # what friction holds back
        (FIELD, sectors(FIELD) + math.pi / 2.0, (False, None)),  # 2070h:04
        (FIELD, np.full(11, 0.5), (None, None)),  # no halls
        (FIELD[:4], sectors(FIELD[:4]), (None, None)),  # too little of a turn
    ],
)
def test_halls_are_judged_by_the_field(field, halls, expected):
    def as_read(angle):
        return (angle + math.pi) % (2.0 * math.pi) - math.pi

    found = judge_halls(as_read(field), as_read(halls))
    assert found[:2] == expected
    assert bool(found.reason) == (None in expected)


def test_a_finding_is_one_line_with_its_remedy():
    has = {ENCODER_DIRECTION: Setting(0, 1), HALL_POLARITY: Setting(1, 1), HALL_DIRECTION: Setting(1, 0)}
    assert changes(has) == {ENCODER_DIRECTION: 1, HALL_DIRECTION: 0}
    assert finding(find_device("tmcm1636"), has) == [
        "encoder reversed: write 2080h:01 = 1",
        "halls in reverse order: write 2070h:02 = 0",
    ]
    assert corrected(find_device("tmcm1636"), has)[0] == "encoder reversed: 2080h:01 is 1 now, and was 0"


# --- identify ---------------------------------------------------------------------------------------------------------
def needs(found):
    """Return what an identification says that the wiring needs, as a row of EVERY."""
    return [found.wiring[key].needs for key in OBJECTS]


@pytest.mark.parametrize("rows", [EVERY[3:4], pytest.param(EVERY, marks=pytest.mark.slow)], ids=["one", "every"])
def test_identify_tells_the_wiring_and_commands_no_torque_where_the_encoder_counts_against_the_motor(rows):
    with emulated(load="inertia", num_machines=len(rows), num_threads=1, parameters=wired(rows)) as target:
        has = settings(target.drives)
        found = identify(target)
        assert [needs(one) for one in found] == rows.tolist()
        np.testing.assert_array_equal(settings(target.drives), has)  # it reports, and leaves the drive as it is
        for one, (encoder, *_) in zip(found, rows, strict=True):
            right = encoder == MOTOR.encoder_direction
            assert one.estimates["inertia"].is_known == right
            assert ("encoder reversed: write 2080h:01 = 0" in one.estimates["inertia"].reason) != right
        assert np.abs(target.drives.machine.rotor_angle).max() < 100.0


def test_halls_that_commutate_are_checked_before_torque_is_commanded():
    parameters = wired([[1, 0, 0], [1, 1, 1]])
    with emulated(load="inertia", num_machines=2, num_threads=1, parameters=parameters) as target:
        target.drives.write(0x2055, HALL)
        found = identify(target)
        reasons = [one.estimates["inertia"].reason for one in found]
        assert "hall levels inverted: write 2070h:01 = 0" in reasons[0]
        assert "halls in reverse order: write 2070h:02 = 1" in reasons[1]
        assert np.abs(target.drives.machine.rotor_angle).max() < 1.0


def test_an_encoder_that_its_halls_align_is_not_set_right_under_way():
    """It was aligned when the drive was first enabled, with the settings of then."""
    with emulated(load="inertia", num_threads=1) as target:
        target.drives.write((0x2080, 3), 2)
        target.drives.write(HALL_POLARITY, 0)
        (found,) = identify_briefly(target)
        reason = found.estimates["inertia"].reason
    assert "hall levels inverted: write 2070h:01 = 1, then switch the drive off and on" in reason


@pytest.mark.slow
def test_a_factory_fresh_drive_is_identified_however_its_motor_is_wired():
    parameters = wired([[0, 0, 1], [1, 1, 0]])
    with emulated(load="inertia", num_machines=2, factory_fresh=True, parameters=parameters, num_threads=1) as target:
        found = identify(target)
        assert [needs(one) for one in found] == [[0, 0, 1], [1, 1, 0]]
        assert all(one.value("inertia") == pytest.approx(1.48e-5, rel=0.05) for one in found)
        assert not settings(target.drives).any()


@pytest.mark.parametrize("direction", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_a_brushed_motor_s_encoder_is_told_by_a_push_of_milliseconds(direction):
    parameters = {"motor.encoder_direction": direction}
    with emulated(load="inertia", motor="re_35", parameters=parameters, num_threads=1) as target:
        (found,) = identify(target)
        assert found.wiring == {ENCODER_DIRECTION: Setting(0, direction)}
        assert found.estimates["inertia"].is_known == (direction == 0)
        if direction:
            assert "encoder reversed: write 2080h:01 = 1" in found.estimates["inertia"].reason
            assert np.abs(target.drives.machine.rotor_angle).max() < 0.5


# --- auto -------------------------------------------------------------------------------------------------------------
def tuned(tmp_path, rows, **options):
    with emulated(load="inertia", num_machines=len(rows), parameters=wired(rows), num_threads=2, **options) as target:
        result = auto(target, tmp_path / "before.toml", method=Method(budget=12.0))
        assert result.accepted.all(), [axis.reason for axis in result.axes]
        return settings(target.drives), [[note for note in axis.notes if "is 0 now" in note or "is 1 now" in note]
                                         for axis in result.axes], turn(target.drives, ENCODER)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"factory_fresh": True}], ids=["commissioned", "fresh"])
def test_auto_sets_a_drive_as_its_motor_is_wired(tmp_path, options):
    rows = EVERY[:: len(EVERY) // part(len(EVERY), 2)]
    left, notes, share = tuned(tmp_path, rows, **options)
    np.testing.assert_array_equal(left, rows)
    np.testing.assert_allclose(share, 1.0, atol=0.05)
    preset = (MOTOR.encoder_direction, MOTOR.hall_polarity, MOTOR.hall_direction)
    if not options:
        assert [len(said) for said in notes] == np.sum(preset != rows, axis=1).tolist()


@pytest.mark.slow
@pytest.mark.parametrize("moved", [0, 40])
def test_auto_finds_a_reversed_encoder_on_a_bus_inside_the_envelope(tmp_path, moved):
    """Also where the drive has counted some turns before: the same place has another number afterwards."""
    with served("calls", load="inertia") as drives:
        if moved:
            motion.enable(drives, mode="pp")
            motion.move_to(drives, moved * 65536, timeout=20.0)
            motion.disable(drives)
        drives.write(ENCODER_DIRECTION, 0)
        drives.advance(0.01)
        way = np.array([30.0])
        target = Target(
            drives, drives.device, MOTOR, np.array([24.0]), -way, way, MOTOR.rated_speed, MOTOR.rated_current,
            bus={"channel": "here", "nodes": [1]},
        )  # fmt: skip
        result = auto(target, tmp_path / "before.toml", method=Method(budget=12.0))
        assert result.accepted.all(), result.axes[0].reason
        assert drives.read(ENCODER_DIRECTION)[0] == 1


@pytest.mark.slow
def test_the_fields_of_a_gantry_turn_the_same_way_so_that_its_ends_do_not_block_each_other():
    # Drawn once: its ends stood so that one had more room forwards and the other backwards, and neither followed.
    (machine,) = (row for row in load_suite("public", 822) if row.name == "seed822-24-gantry-qbl4208")
    with open_group([machine], 1) as target:
        found = identify(target)
    assert [one.value("pole_pairs") for one in found] == [MOTOR.n_p] * 2
