"""Commissioning of an open-loop stepper: the threshold by closed form, what is proved and refused, and undoing it."""

from __future__ import annotations

import json
import math
import shutil

import numpy as np
import pytest
from rigs.closed_loop_rig import target_of
from rigs.commands import drive_tune
from rigs.stepper_rig import BARE, lane
from rigs.world_bus import on_bus

from drive_env import EmulatedDrives, cia402
from drive_env.devices import find_device
from drive_env.dictionary.roles import Role
from drive_env.drives.raw_gains import write_gains
from drive_env.motors import MOTORS
from drive_env.phase_current import RESERVE, amplitude, holding_torque, run_and_standby
from drive_env.trials.load_reading import STALL_ANGLE
from drive_env.trials.open_loop import encoder_age
from drive_env.trials.working_moves import WorkingMoves
from tuning.search.optimise import Settings, optimise
from tuning.search.trial_bench import TrialBench, leave_oscillations_to_trials
from tuning.stepper import commissioning
from tuning.stepper.commissioning import WORKING_SHARE, commission
from tuning.stepper.load_detection import LoadDetection
from tuning.stepper.obstacle import prove_with_load
from tuning.target import emulated

NAME = "qsh4218_51"
MOTOR = MOTORS[NAME]
SPEED = WORKING_SHARE * MOTOR.rated_speed
LOADED = {"load.inertia": 5 * MOTOR.inertia}


@pytest.fixture(scope="module")
def stepper(tmp_path_factory):
    """The bare drive with a stage of 2 A, so that the rated current of a NEMA 17 motor is most of what it gives."""
    folder = tmp_path_factory.mktemp("device") / "small_stepper"
    shutil.copytree(BARE, folder)
    data = folder / "device.toml"
    text = data.read_text(encoding="utf-8").replace("full_scale = 10.0", "full_scale = 2.0")
    data.write_text(text.replace('name = "bare_stepper"', 'name = "small_stepper"'), encoding="utf-8")
    return str(folder)


def target(stepper, **options):
    return emulated(stepper, "inertia", NAME, num_threads=1, **({"parameters": LOADED} | options))


def test_what_the_search_needs_is_loaded_before_an_axis_is_enabled(stepper, monkeypatch):
    """It takes a second or more, after which an envelope in real time stops an enabled axis."""
    was_live = []
    with target(stepper) as found:
        monkeypatch.setattr(commissioning, "load", lambda sampler: was_live.append((sampler, live(found).any())))
        commissioning.check_stepper(found)
    assert was_live == [(Settings().sampler, False)]


def live(found):
    return cia402.is_live(found.drives.read(cia402.STATUSWORD))


def detection_of(found):
    """Return load detection and moves of a target that was identified, at the rule's currents."""
    bench = TrialBench(found)
    bench.identify()
    write_gains(found.drives, bench.rule)
    torque = 0.3 * holding_torque(MOTOR, run_and_standby(found.device, bench.rule)[0])
    moves = WorkingMoves(
        found.drives, MOTOR, bench.trials, bench.began, np.full(found.num_axes, 30.0),
        np.minimum(torque / bench.identified.inertia, 2000.0), found.increments(), encoder_age(found.device),
    )  # fmt: skip
    return LoadDetection(found.drives, MOTOR, moves, bench.rule, SPEED), moves


# --- the threshold ----------------------------------------------------------------------------------------------------
def test_counts_of_a_volt_and_the_wanted_reading_are_those_of_the_closed_form(stepper):
    """The emulated reading is 1023 (2 / pi) u / supply, u the voltage given back (test_stepper_stall_guard)."""
    with target(stepper) as found:
        detection, _ = detection_of(found)
        detection.find_threshold()
        got = detection.found
        per_volt = 1023.0 * 2.0 / math.pi / MOTOR.voltage
        assert got.per_volt == pytest.approx(per_volt, rel=0.05)
        i = amplitude(found.device, detection.gains[:, 0])
        emf = holding_torque(MOTOR, i) / i * SPEED

        def falls(angle):
            return np.cos(angle) - np.sin(angle)

        assert got.wanted == pytest.approx(per_volt * emf * (falls(got.angle) - falls(STALL_ANGLE)), rel=0.07)
        assert got.wanted <= got.margin < got.wanted + 17  # one step of the threshold is 16 counts
        assert not got.reasons[0]


def test_the_load_angle_is_that_of_friction_and_drag(stepper):
    with target(stepper, parameters=LOADED | {"load.viscous": 0.0}) as found:
        detection, _ = detection_of(found)
        detection.find_threshold()
        values = found.drives.machine.parameters
        torque = values["motor.coulomb"] + values["load.coulomb"] + values["motor.viscous"] * SPEED
        held = holding_torque(MOTOR, amplitude(found.device, detection.gains[:, 0]))
        assert detection.found.angle == pytest.approx(np.arcsin(torque / held), abs=math.radians(1.5))


def test_a_load_that_is_acceptable_does_not_stop_it_and_an_obstacle_does(stepper):
    with target(stepper) as found:
        detection, moves = detection_of(found)
        detection.find_threshold()
        run, _ = run_and_standby(found.device, detection.gains)
        proof = prove_with_load(found, moves, SPEED, run, np.ones(1, bool))
        assert proof.withstood.all() and proof.stopped.all() and proof.lost <= 5
        assert np.all(found.drives.machine.load_torque == 0.0)
        # With the stop switched off the same obstacle is not seen: steps are lost and nothing stops the axis.
        found.drives.write(Role.STALL_SPEED, 0)
        assert not prove_with_load(found, moves, SPEED, run, np.ones(1, bool)).stopped.any()


@pytest.mark.every(2)
@pytest.mark.parametrize("at", [0.05, 0.6])
def test_an_emergency_in_the_moves_is_named(stepper, at):
    """It said "it lost steps at 14.4 rad/s with its run current"."""
    with target(stepper) as found:
        detection, _ = detection_of(found)
        found.drives.machine.fault("supply_surge", at=at, duration=0.1)
        detection.find_threshold()
        (reason,) = detection.found.reasons
    assert reason.startswith("it went into fault at ") and reason.endswith(" rad/s: overvoltage (3210h)"), reason


@pytest.mark.slow
def test_an_emergency_with_a_load_on_the_axis_is_named(stepper, tmp_path, monkeypatch):
    def surges(found, moves, *rest):
        found.drives.machine.fault("supply_surge", at=0.05, duration=0.1)
        return prove_with_load(found, moves, *rest)

    monkeypatch.setattr(commissioning, "prove_with_load", surges)
    with target(stepper) as found:
        (axis,) = commission(found, tmp_path / "before.toml").axes
    assert axis.reason.endswith("of the holding torque; the drive reported overvoltage (3210h)"), axis.reason


# --- CoolStep ---------------------------------------------------------------------------------------------------------
def test_coolstep_lowers_the_current_by_what_the_load_angle_says_and_no_step_is_lost(stepper):
    """The truth is the amplitude in the drive's record, which no bus shows."""
    with target(stepper) as found:
        detection, moves = detection_of(found)
        detection.find_threshold()
        detection.find_coolstep()
        got = detection.found
        assert not got.reasons[0] and not got.reservations[0]
        full = amplitude(found.device, detection.gains[:, 0])[0]
        amplitudes = []
        moves.run(SPEED, np.ones(1, bool), lambda leg, t: amplitudes.append(lane(found.drives, "amplitude")[0]))
        least = min(amplitudes)
        assert 0.5 * full - 1e-9 <= least < 0.8 * full  # a half is the least that 2098h = 0 allows
        assert got.saved == pytest.approx(1.0 - least / full, abs=0.1)
        assert got.cooled_angle < STALL_ANGLE


def test_coolstep_is_left_off_where_it_loses_steps(stepper, monkeypatch):
    """Steps are lost whenever CoolStep works: it is switched off again, and the axis keeps the rest."""
    run = WorkingMoves.run

    def losing(self, speed, where, *rest, **more):
        steady = run(self, speed, where, *rest, **more)
        on = self.drives.read((0x209C, 0)) > 0
        return steady._replace(lost=steady.lost | on)

    monkeypatch.setattr(WorkingMoves, "run", losing)
    with target(stepper) as found:
        detection, _ = detection_of(found)
        detection.find_threshold()
        detection.find_coolstep()
        assert found.drives.read((0x209C, 0)) == 0 and not detection.found.reasons[0]
        assert "CoolStep is left off" in detection.found.reservations[0][0]


# --- the run ----------------------------------------------------------------------------------------------------------
def test_a_stepper_is_commissioned_by_its_load(stepper, tmp_path):
    with target(stepper) as found:
        before = {key: int(found.drives.read(key)[0]) for key in (cia402.SENSOR_SELECTION, cia402.PROFILE_VELOCITY)}
        result = commission(found, tmp_path / "before.toml")
        (axis,) = result.axes
        assert axis.verdict == "accepted" and not axis.reservations and result.proved_with_load
        assert found.device.gains.read(found.drives).tolist() == [list(axis.after.values())]
        current = amplitude(found.device, axis.after["run_current"])
        assert holding_torque(MOTOR, current) * RESERVE >= 0.3 * MOTOR.rated_torque  # the rule: 30 % with a reserve
        per_rad = found.increments()[0]
        assert found.drives.read(Role.STALL_SPEED)[0] / per_rad == pytest.approx(
            axis.figures["stop on stall above [rad/s]"], rel=1e-3
        )
        assert {key: int(found.drives.read(key)[0]) for key in before} == before
        assert cia402.matches(found.drives.read(cia402.STATUSWORD), cia402.SWITCH_ON_DISABLED).all()
        assert result.drive_seconds < 15.0


@pytest.mark.slow
def test_an_axis_that_fails_gets_everything_back(stepper, tmp_path, monkeypatch):
    """The obstacle is not seen: the stop on stall is above any speed."""
    monkeypatch.setattr(commissioning, "prove_with_load", lambda *a: _unseen(*a))
    with target(stepper) as found:
        found.drives.write((0x209E, 0), 11)
        gains, speed = found.device.gains.read(found.drives), found.drives.read(Role.STALL_SPEED)
        result = commission(found, tmp_path / "before.toml")
        assert result.axes[0].verdict == "rejected" and "obstacle does not stop it" in result.axes[0].reason
        np.testing.assert_array_equal(found.device.gains.read(found.drives), gains)
        np.testing.assert_array_equal(found.drives.read(Role.STALL_SPEED), speed)


def _unseen(found, moves, speed, run, where):
    found.drives.write(Role.STALL_SPEED, 0)
    return prove_with_load(found, moves, speed, run, where)


def test_a_travel_too_short_for_the_working_speed_is_told(stepper, tmp_path):
    with target(stepper, travel=(-0.4, 0.4)) as found:
        result = commission(found, tmp_path / "before.toml")
        assert "the travel is too short: 0.36 rad" in result.axes[0].reason


@pytest.mark.slow
def test_a_motor_that_is_too_weak_for_its_load_is_rejected_with_the_reason(stepper, tmp_path):
    """A constant load of 90 % of the holding torque."""
    with target(stepper) as found:
        found.drives.machine.load_torque = 0.9 * MOTOR.rated_torque
        result = commission(found, tmp_path / "before.toml")
        assert result.axes[0].verdict == "rejected" and "loses steps" in result.axes[0].reason


# --- over a bus -------------------------------------------------------------------------------------------------------
MACHINES = {"load": "inertia", "motor": NAME, "num_machines": 6, "num_threads": 1}


def over_a_bus(device, act):
    """Return what acting on a node with its six motors returns, inside the safety envelope, in lockstep."""
    with on_bus(EmulatedDrives(device, **MACHINES)) as drives:
        leave_oscillations_to_trials(drives)
        return act(drives)


@pytest.mark.slow
def test_a_search_of_currents_finds_the_same_in_process_and_over_the_bus():
    def act(drives):
        return [
            (row.gains.tolist(), row.cost) for row in optimise(target_of(drives), Settings(trials=2, safe=True)).rows
        ]

    with EmulatedDrives("tmcm6212", **MACHINES) as drives:
        inside = act(drives)
    assert over_a_bus("tmcm6212", act) == inside and len(inside) == 12


@pytest.mark.slow
def test_commissioning_finds_the_same_in_process_and_over_the_bus(tmp_path):
    """What is a number in both; only the machine in this process can be loaded, which the node's verdict says.

    A bus is asked first whether its axes have motors: their rotors begin within a thousandth of another place.
    """

    def act(drives):
        result = commission(target_of(drives), tmp_path / f"{id(drives)}.toml", keep=False)
        return [(axis.after, axis.figures, axis.verdict, axis.reservations) for axis in result.axes]

    with EmulatedDrives("tmcm6212", **MACHINES) as drives:
        inside = act(drives)
    outside = over_a_bus("tmcm6212", act)
    loaded = ("teeth lost at an obstacle", "load of 30 % that does not stop it came within [s]",
              "obstacle that stops it came within [s]")  # fmt: skip
    for (after, figures, verdict, own), (far, seen, told, reservations) in zip(inside, outside, strict=True):
        assert after == far and verdict != "rejected" and told == "accepted with reservations"
        assert all("teeth before the stall" in text for text in own)
        assert figures.keys() == seen.keys()
        numbers = [name for name, value in figures.items() if value is not None and name not in loaded]
        place = 4e-3 * figures["dry friction [N m]"]  # what the teeth hold of a rotor that begins elsewhere
        for name in numbers:
            torque = place if name.endswith("[N m]") else 0.0
            assert seen[name] == pytest.approx(figures[name], rel=1e-3, abs=torque), name
        assert [figures[name] for name in loaded[1:]] == [0.15, 0.03]
        assert (
            all(seen[name] is None for name in loaded)
            and len(reservations) == 1
            and "not proved with a load" in reservations[0]
        )
        assert after["stall_threshold"] != 0 or after["coolstep_lower"] > 0


# --- the command ------------------------------------------------------------------------------------------------------
def test_auto_finds_by_the_gain_set_what_a_device_is(stepper, tmp_path):
    out = tmp_path / "found"
    result = drive_tune("auto", "--device", stepper, "--load", "inertia", "--out", out)
    assert result.exit_code == 0, result.output
    assert "axis 0: accepted" in result.output and "not measured: current and load step" in result.output
    written = json.loads((out / "stepper-certificate.json").read_text(encoding="utf-8"))
    assert written["axes"][0]["verdict"] == "accepted" and written["load and obstacle tried"]
    assert written["motor"] == NAME, "the device's usual one"
    assert (out / "before.toml").is_file()
    assert drive_tune("verify", out / "stepper-certificate.json").exit_code == 0
    written["axes"][0]["figures"]["run current [A]"] += 0.1
    (out / "stepper-certificate.json").write_text(json.dumps(written), encoding="utf-8")
    changed = drive_tune("verify", out / "stepper-certificate.json")
    assert changed.exit_code == 1 and "was changed since it was written" in changed.output


def test_a_stepper_of_more_volts_than_its_device_is_tuned_at_those_of_the_device():
    with emulated("tmcm6212", "arm", "qsh8618_96") as target:
        assert target.motor.voltage == 48.0 and target.supply.tolist() == [35.0]


def test_auto_says_what_a_drive_lacks_before_anything_moves(tmp_path):
    text = drive_tune("auto", "--device", BARE, "--motor", "qbl4208").output
    assert "turns two-phase hybrid stepper motors" in text
    out = tmp_path / "found"
    device = find_device(BARE)
    assert device.gains.is_open_loop and not find_device("tmcm1636").gains.is_open_loop
    result = drive_tune("auto", "--device", BARE, "--motor", NAME, "--load", "nothing", "--out", out)
    assert result.exit_code == 2 and not out.exists()
