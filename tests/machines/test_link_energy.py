"""What a motion feeds back into the DC link, against closed forms and the emulator's capacitor; falling weights."""

from __future__ import annotations

import numpy as np
import pytest
from rigs.known_machines import proving, truth
from rigs.thinning import part

from drive_env import EmulatedDrives, cia402, motion
from drive_env.devices import find_device
from drive_env.dictionary.roles import Role
from drive_env.drives.raw_gains import write_gains
from drive_env.firmware.record import get_lanes
from drive_env.motors import find_motor
from tuning.auto.one_button import auto
from tuning.identify.identification import identify
from tuning.identify.quick_identification import identify_briefly
from tuning.link_energy import LINK_SHARE, fed_back, link_energy, trial_reach
from tuning.response.frequency_response import measure
from tuning.target import emulated

MOTOR = find_motor("qbl4208")
CYCLE, TURN = 0.001, 2.0 * np.pi
GUARD_SEED = 20261126
OVERVOLTAGE = 0x3210
LEAST = find_device("tmcm1636").stage["dc_capacitance"].low
MOST_TURNS = 1.0  # how far an axis that did not fall is from where it began: its trials end where a move did


def test_a_stop_feeds_back_its_kinetic_energy():
    speed = 200.0 * np.concatenate([np.linspace(0.0, 1.0, 2000), np.linspace(1.0, 0.0, 2000)])[:, None]
    found = fed_back(MOTOR._replace(R_s=1e-9), speed, CYCLE, 3e-5, 0.0)
    assert found == pytest.approx(0.5 * 3e-5 * 200.0**2, rel=1e-3)


def test_a_weight_feeds_back_as_long_as_it_goes_down_less_friction_and_winding():
    speed = np.full((1000, 2), 50.0)
    torque, friction, R = 0.03, 0.01, MOTOR.copper_resistance
    K = MOTOR.torque_constant
    found = fed_back(MOTOR, speed, CYCLE, 0.0, np.array([torque / K, -torque / K]), friction / K)
    falling = torque - friction
    assert found == pytest.approx(falling * 50.0 - R * (falling / K) ** 2, rel=2e-3), "of one second, either way"


def test_what_the_motor_draws_empties_the_link_first():
    down = np.full((200, 1), -100.0)
    once = fed_back(MOTOR, down, CYCLE, 0.0, 1.0)
    again = fed_back(MOTOR, np.concatenate([down, -down, down, -down]), CYCLE, 0.0, 1.0)
    assert again == pytest.approx(once, rel=0.01)


def test_the_capacitor_of_a_falling_weight_has_what_was_foreseen():
    """A screw goes down at 120 rad/s for 0.2 s: the energy in its DC link, by its voltage."""
    capacitance = 2e-3
    with EmulatedDrives(load="vertical_screw", num_threads=1, ideal=True) as drives:
        # Nothing but the bridge takes from the link, and nothing but gravity and the nut's losses from the motor.
        for name in ("stage.supply_sinks", "load.coulomb", "load.viscous", "motor.coulomb"):
            drives.machine.set(name, 0.0)
        drives.machine.set("stage.idle_current", 1e-9)
        drives.machine.set("stage.dc_capacitance", capacitance)
        motion.enable(drives, mode="csv")
        holding = drives.record([cia402.TORQUE_ACTUAL], 0.2)[cia402.TORQUE_ACTUAL][-50:].mean() * 1e-3
        volts = [float(get_lanes(drives.inside.records, "u_dc", 1)[0])]
        rise = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, 41) / 40)
        speed = -120.0 * np.concatenate([rise, np.ones(200), rise[::-1]])
        per_radian = float(drives.read(Role.POSITION_SCALE)[0]) / TURN
        for row in speed:
            drives.record([cia402.TORQUE_ACTUAL], CYCLE, {cia402.TARGET_VELOCITY: [[round(row * per_radian)]]})
            volts.append(float(get_lanes(drives.inside.records, "u_dc", 1)[0]))
        inertia = truth(drives, 0, 0.0)["inertia"]
        foreseen = float(fed_back(drives.motor, speed[:, None], CYCLE, inertia, holding)[0])
    stored = 0.5 * capacitance * (max(volts) ** 2 - volts[0] ** 2)
    assert foreseen > 0.5, "J: it is worth foreseeing"
    assert LINK_SHARE * stored <= foreseen, "a loop lags and overshoots: the share of the link leaves room for it"
    assert stored >= 0.8 * foreseen


def identified(num_machines, seed, how=identify):
    """Identify vertical screws; return the target, still open, and what was found."""
    target = emulated(load="vertical_screw", randomise=True, seed=seed, num_machines=num_machines, num_threads=1)
    before = np.asarray(target.drives.machine.rotor_angle).copy()
    found = how(target)
    turns = np.abs(np.asarray(target.drives.machine.rotor_angle) - before) / TURN
    status = target.drives.read(cia402.STATUSWORD)
    assert not cia402.matches(status, cia402.FAULT_BIT).any(), "its DC link was overcharged, and its stage cut"
    assert (turns < MOST_TURNS).all(), "it fell onto its stop, 50 turns below"
    return target, found


@pytest.mark.slow
def test_a_vertical_axis_does_not_fall_while_it_is_identified():
    """It fell by 50 turns: the quick way to where its moves begin, downwards, fed back more than the link holds."""
    target, (found,) = identified(1, GUARD_SEED)
    with target:
        assert found.estimates["inertia"].value == pytest.approx(truth(target.drives, 0, 0.0)["inertia"], rel=0.1)
        assert found.estimates["coulomb"].is_known


HEAVY = {"load.mass": 10.0, "stage.dc_capacitance": LEAST}  # twice what the class has, on the smallest link of it


@pytest.mark.slow
def test_a_heavy_axis_on_a_small_link_does_not_fall_while_it_is_identified():
    """It falls by 50 turns if its moves are planned without its weight, or for more than the link holds."""
    with emulated(load="vertical_screw", parameters=HEAVY, num_threads=1) as target:
        found = identify(target)[0]
        assert target.drives.emergencies() == [] and found.estimates["inertia"].is_known
        assert abs(target.drives.machine.rotor_angle[0]) < MOST_TURNS * TURN


@pytest.mark.parametrize("motor", ["class_750w", "class_1kw"])
def test_trial_moves_of_large_motors_do_not_overcharge_the_link(motor):
    """They did on 7 of 20 drawn machines with 1 kW: every gains failed by an overvoltage, the best ones first."""
    smallest = {"stage.dc_capacitance": LEAST}
    with emulated(load="vertical_screw", motor=motor, parameters=smallest, num_threads=1) as target:
        ground, rule = proving(target)
        assert ground.run(rule, np.ones(1, bool)).reason == ("",)
        assert target.drives.emergencies() == []


def test_a_weight_that_goes_back_down_a_long_way_to_its_trials_does_not_fall():
    """Back from 30 turns above as fast as the motor can it filled the link; cut off, it fell by 69 turns."""
    with emulated(load="vertical_screw", parameters=HEAVY, num_threads=1) as target:
        drives = target.drives
        write_gains(drives, proving(target)[1])
        motion.enable(drives, "pp")
        holding = drives.record([cia402.TORQUE_ACTUAL], 0.2)[cia402.TORQUE_ACTUAL][-50:].mean() * 1e-3
        ground, rule = proving(target, (holding, 0.0))
        turn = int(drives.read(Role.POSITION_SCALE)[0])
        drives.write(cia402.PROFILE_VELOCITY, 20 * turn)
        motion.move_to(drives, drives.read(cia402.POSITION_ACTUAL) + 30 * turn)
        assert ground.run(rule, np.ones(1, bool)).reason == ("",)
        assert drives.emergencies() == []
        assert drives.machine.rotor_angle[0] < MOST_TURNS * TURN


def test_the_reach_of_trials_is_less_by_a_weight_and_as_it_was_where_the_link_holds_it():
    smallest = {"load": "inertia", "num_threads": 1}
    with emulated(motor="class_750w", **smallest) as target:
        far = np.array([-500.0])
        plain, heavy = (float(trial_reach(target, 3e-4, weight, far)[0]) for weight in (0.0, 5.0))
        assert -500.0 < plain < heavy < 0.0
    with emulated(**smallest) as target:
        assert trial_reach(target, 5e-5, 0.5, far) == far


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "motor"), [(GUARD_SEED, "class_1kw"), (1, "class_750w")])
def test_of_twenty_vertical_axes_that_auto_tunes_none_overcharges_its_link(monkeypatch, tmp_path, seed, motor):
    """7 and 2 of 20 did, up to nine times each."""
    count = part(20, 5)
    options = {"randomise": True, "num_machines": count, "num_threads": 1}
    with emulated(load="vertical_screw", motor=motor, seed=seed, **options) as target:
        told = []
        read = target.drives.emergencies
        monkeypatch.setattr(target.drives, "emergencies", lambda: told.extend(new := read()) or new)
        result = auto(target, tmp_path / "before.toml", keep=False)
        assert not [one for one in told if one.code == OVERVOLTAGE]
        assert result.accepted.sum() >= count - 2
        assert np.abs(target.drives.machine.rotor_angle).max() < 10.0 * TURN


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "how"), [(GUARD_SEED, identify), (1, identify), (2, identify_briefly)])
def test_of_twenty_vertical_axes_none_falls_and_what_they_are_is_found(seed, how):
    """4 of 20 fell with the first seed. Inertia was within 5 % on 13 of the 16 others, viscous friction told of 13."""
    target, found = identified(20, seed, how)
    with target:
        true = [truth(target.drives, k, np.nan_to_num(one.value("offset"))) for k, one in enumerate(found)]
        pairs = list(zip(found, true, strict=True))
        if how is identify:
            near = [abs(one.value("inertia") / each["inertia"] - 1.0) <= 0.05 for one, each in pairs]
            assert sum(near) >= 17
            assert sum(one.estimates["viscous"].is_known for one in found) >= 12
            friction = [one.value("coulomb") / each["coulomb"] for one, each in pairs]
            assert np.nanmax(np.abs(np.array(friction) - 1.0)) <= 0.1


@pytest.mark.slow
@pytest.mark.parametrize("loop", ["velocity", "position"])
def test_a_response_of_vertical_axes_lets_none_of_them_fall(loop):
    target = emulated(load="vertical_screw", randomise=True, seed=GUARD_SEED, num_machines=20, num_threads=1)
    with target:
        measure(target, loop)
        assert target.drives.emergencies() == []


def test_axes_of_one_drive_share_its_link():
    one = emulated("tgz_s", load="inertia", num_threads=1)
    two = emulated("tgz_d", load="inertia", num_machines=2, num_threads=1)
    with one, two:
        assert 2.0 * link_energy(two) == pytest.approx(link_energy(one)[[0, 0]])
