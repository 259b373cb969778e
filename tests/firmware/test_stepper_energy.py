"""Energy of a stepper: what the bridges take is shaft work, loss in copper and stage and magnetic energy; the shaft's
work is kinetic energy, friction and load. Sums tick by tick from currents and speeds, by formulas of its own."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rigs.stepper_rig import FREE, MICROSTEPS, build, lane

from drive_env import motion
from drive_env.emulator.group import rates_of
from drive_env.firmware.cycle import mechanics_window
from drive_env.firmware.record import LANES
from drive_env.firmware.stepper.stages import FIRMWARE
from drive_env.motors import MOTORS
from mechanics.kernels.compiled import cached

pytestmark = pytest.mark.slow  # its kernel takes half a minute to compile

start_window, supervise, tick = FIRMWARE.start_window, FIRMWARE.supervise, FIRMWARE.tick
BRIDGE, COPPER, SHAFT, STAGE = range(4)
SPEEDS = np.array([0.05, 0.5, 1.0, 1.3])  # of the rated speed
KINDS = ("motoring", "braking", "speeding up", "slowing down")
PPS = MICROSTEPS / (2.0 * math.pi)


@cached()
def run_axes(records, plant, rates, scratch, num_axes, cycles, sums):
    """Run whole communication cycles; sums (4, axes) [J]: bridge, copper, shaft, stage."""
    dt = rates.tick
    i_a, i_b = np.zeros(LANES), np.zeros(LANES)
    for _ in range(cycles):
        for block in range(records.shape[0]):
            supervise(records[block], rates)
        for _ in range(rates.windows):
            theta, torque = np.empty(num_axes), np.zeros(num_axes)
            for axis in range(num_axes):
                theta[axis] = records[axis // LANES].theta_m[axis % LANES]
            for block in range(records.shape[0]):
                drive = records[block]
                start_window(drive, rates)
                for k in range(rates.ticks):
                    for lane_ in range(LANES):
                        i_a[lane_] = drive.i_a[lane_]
                        i_b[lane_] = drive.i_b[lane_]
                    tick(drive, rates, k)
                    for lane_ in range(min(LANES, num_axes - block * LANES)):
                        axis = block * LANES + lane_
                        square = drive.ripple[lane_] * drive.ripple[lane_] / 6.0
                        for start, mean, end in (
                            (i_a[lane_], drive.i_a_mean[lane_], drive.i_a[lane_]),
                            (i_b[lane_], drive.i_b_mean[lane_], drive.i_b[lane_]),
                        ):
                            # Mean square of the parabola through start and end with that mean, by Simpson's rule.
                            middle = 1.5 * mean - 0.25 * (start + end)
                            square += (start * start + 4.0 * middle * middle + end * end) / 6.0
                        sums[BRIDGE, axis] += drive.bridge_power[lane_] * dt
                        sums[COPPER, axis] += drive.R_s[lane_] * square * dt
                        sums[STAGE, axis] += drive.on_resistance[lane_] * square * dt
                        torque[axis] += (drive.tau_m[lane_] + drive.tau_detent[lane_]) / rates.ticks
            mechanics_window(records, plant, rates, scratch)
            for axis in range(num_axes):
                sums[SHAFT, axis] += torque[axis] * (records[axis // LANES].theta_m[axis % LANES] - theta[axis])


@pytest.fixture(scope="module", params=["qsh4218_51", "qsh5718_76"])
def energies(request):
    """Bridge, copper, shaft, magnetic, kinetic, detent and load energies [J], each of shape (4 kinds, 4 speeds)."""
    motor = MOTORS[request.param]
    speed = np.tile(SPEEDS, 4) * motor.rated_speed
    # Without friction nothing but the load takes energy; a heavy disc keeps the speed.
    parameters = FREE | {"motor.coulomb": 0.0, "load.inertia": 20.0 * motor.inertia, "load.viscous": motor.viscous}
    parameters["stage.on_resistance"] = 0.5
    with build(request.param, num_machines=16, parameters=parameters | {"motor.viscous": 0.0}) as drives:
        motion.enable(drives, mode="pv")
        drives.write(0x6083, round(speed.max() * PPS / 2.0))
        drives.write(0x60FF, np.rint(speed * PPS).astype(int))
        drives.advance(2.5)
        load = np.zeros(16)
        load[:4], load[4:8] = -0.3 * motor.rated_torque, 0.3 * motor.rated_torque
        for share in (0.25, 0.5, 0.75, 1.0):
            drives.machine.load_torque = share * load
            drives.advance(0.1)
        new = speed.copy()
        new[8:12] *= 1.3
        new[12:] *= 0.5
        drives.write(0x60FF, np.rint(new * PPS).astype(int))

        def stored():
            currents = lane(drives, "i_a") ** 2 + lane(drives, "i_b") ** 2
            kinetic = 0.5 * lane(drives, "J_rotor") * lane(drives, "omega_m") ** 2
            return np.array([0.5 * lane(drives, "L_s") * currents, kinetic, lane(drives, "theta_m")])

        before, sums = stored(), np.zeros((4, 16))
        rates, blocks = rates_of(drives.device, 1), len(drives.inside.records)
        run_axes(
            drives.inside.records, drives.inside.groups[0].load.plant, rates, np.zeros((7, 8 * blocks)), 16, 200, sums
        )
        magnetic, kinetic, turned = stored() - before
        assert drives.emergencies() == []
        assert np.all(np.abs(50.0 * (lane(drives, "step_position") - lane(drives, "theta_m"))) < math.pi)  # in step
        drag = motor.viscous * speed * turned  # of a speed that hardly changes
        terms = (*sums[:STAGE], magnetic, kinetic, drives.machine.load_torque * turned, drag, sums[STAGE])
        yield tuple(term.reshape(4, 4) for term in terms)


@pytest.mark.parametrize("kind", range(4), ids=KINDS)
def test_the_bridges_energy_is_shaft_work_losses_and_magnetic_energy_within_0_1_percent(energies, kind):
    bridge, copper, shaft, magnetic = (term[kind] for term in energies[:4])
    stage = energies[7][kind]
    assert np.all(stage >= 0.08 * copper)
    scale = np.maximum(np.abs(bridge), np.maximum(np.abs(shaft), copper))
    assert np.all(np.abs(bridge - shaft - copper - stage - magnetic) <= 1e-3 * scale), (bridge, shaft, copper, stage)


@pytest.mark.parametrize("kind", [0, 1], ids=KINDS[:2])
def test_the_shafts_work_goes_into_the_load(energies, kind):
    shaft, kinetic, from_load, drag = (energies[k][kind] for k in (2, 4, 5, 6))
    scale = np.maximum(np.abs(shaft), np.abs(from_load))
    assert np.all(np.abs(shaft + from_load - kinetic - drag) <= 0.02 * scale), (shaft, from_load, kinetic, drag)


def test_the_cases_are_what_they_are_called(energies):
    bridge, copper, shaft, _, kinetic = energies[:5]
    assert np.all(shaft[0] > 0.0) and np.all(shaft[1, 1:] < 0.0)
    assert np.all(kinetic[2, 1:] > 0.0) and np.all(kinetic[3, 1:] < 0.0)  # the slowest swing
    assert np.all(copper > 0.0) and np.all(bridge[1, 1:] < bridge[0, 1:])
