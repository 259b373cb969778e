"""Energy: nothing is made or lost between DC source and shaft, and the copper loss warms the winding.

Electrical input = torque times speed + loss in copper and stage + change of magnetic and kinetic energy; on the other
side of the bridge the source gives what the bridge, the chopper and the idle current take and the capacitor stores. The
harness runs whole axes and sums every term tick by tick from currents, voltages and speeds, by formulas of its own.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest

from drive_env import EmulatedDrives, motion
from drive_env.emulator.group import rates_of
from drive_env.firmware.cycle import mechanics_window
from drive_env.firmware.record import LANES, get_lanes, set_lanes
from drive_env.firmware.servo.stages import FIRMWARE
from drive_env.firmware.servo.thermal import warm
from drive_env.motors import MOTORS, motors_of
from mechanics.kernels.compiled import cached

start_window, supervise, tick = FIRMWARE.start_window, FIRMWARE.supervise, FIRMWARE.tick

FREE = {"load.coulomb": 0.0, "load.breakaway": 0.0, "load.viscous": 0.0}
COPPER = 0.00393  # 1/K at 25 degC
BRIDGE, COPPER_LOSS, STAGE_LOSS, SHAFT, SOURCE, CHOPPER, IDLE = range(7)


@cached()
def run_axes(records, plant, rates, scratch, num_axes, cycles, sums):
    """Run whole communication cycles; sums (7, axes) [J]: bridge, copper, stage, shaft, source, chopper, idle."""
    dt = rates.tick
    u_before = np.zeros(LANES)
    for _ in range(cycles):
        for block in range(records.shape[0]):
            supervise(records[block], rates)
        for _ in range(rates.windows):
            theta = np.empty(num_axes)
            torque = np.zeros(num_axes)
            for axis in range(num_axes):
                theta[axis] = records[axis // LANES].theta_m[axis % LANES]
            for block in range(records.shape[0]):
                drive = records[block]
                start_window(drive, rates)
                for k in range(rates.ticks):
                    for lane in range(LANES):
                        u_before[lane] = drive.u_dc[lane]
                    tick(drive, rates, k)
                    for lane in range(min(LANES, num_axes - block * LANES)):
                        axis = block * LANES + lane
                        square = 0.0
                        for start, mean, end in (
                            (drive.i_d_before[lane], drive.i_d_mean[lane], drive.i_d[lane]),
                            (drive.i_q_before[lane], drive.i_q_mean[lane], drive.i_q[lane]),
                        ):
                            # Mean square of the parabola through start and end with that mean, by Simpson's rule.
                            middle = 1.5 * mean - 0.25 * (start + end)
                            square += (start * start + 4.0 * middle * middle + end * end) / 6.0
                        u, u_end = u_before[lane], drive.u_dc[lane]
                        R = drive.supply_resistance[lane]
                        fed = max((drive.supply_voltage[lane] - u_end) / R, 0.0)
                        sums[BRIDGE, axis] += drive.bridge_power[lane] * dt
                        sums[COPPER_LOSS, axis] += drive.phase_factor[lane] * drive.R_s[lane] * square * dt
                        in_stage = (2.0 if drive.is_dc[lane] > 0.5 else 1.5) * drive.on_resistance[lane]
                        sums[STAGE_LOSS, axis] += in_stage * square * dt
                        sums[SOURCE, axis] += (drive.supply_voltage[lane] - R * fed) * fed * dt
                        mean_u = 0.5 * (u + u_end)
                        sums[CHOPPER, axis] += drive.chopper[lane] * u / drive.chopper_resistance[lane] * mean_u * dt
                        sums[IDLE, axis] += drive.idle_current[lane] * mean_u * dt
                        torque[axis] += drive.tau_m[lane] / rates.ticks
            mechanics_window(records, plant, rates, scratch)
            # Work by the mean velocity over the step.
            for axis in range(num_axes):
                sums[SHAFT, axis] += torque[axis] * (records[axis // LANES].theta_m[axis % LANES] - theta[axis])


class Balance(NamedTuple):
    """Energies [J] of each axis over a run: what the harness summed, and the changes between its ends."""

    bridge: np.ndarray
    copper: np.ndarray
    stage: np.ndarray
    shaft: np.ndarray
    source: np.ndarray
    chopper: np.ndarray
    idle: np.ndarray
    magnetic: np.ndarray
    kinetic: np.ndarray
    from_load: np.ndarray
    capacitor: np.ndarray


def balance(drives, duration):
    """Run for `duration` [s] and return the balance."""

    def lanes(name):
        return get_lanes(drives.inside.records, name, drives.num_axes).astype(float)

    def stored():
        factor = lanes("phase_factor")
        # Of the currents alone: the magnets' own energy does not change.
        magnetic = 0.5 * factor * (lanes("L_d") * lanes("i_d") ** 2 + lanes("L_q") * lanes("i_q") ** 2)
        kinetic = 0.5 * lanes("J_rotor") * lanes("omega_m") ** 2
        return np.array([magnetic, kinetic, lanes("theta_m"), 0.5 * lanes("dc_capacitance") * lanes("u_dc") ** 2])

    before = stored()
    sums = np.zeros((7, drives.num_axes))
    group = drives.inside.groups[0]
    rates = rates_of(drives.device, 1)
    scratch = np.zeros((7, 8 * len(drives.inside.records)))
    run_axes(
        drives.inside.records, group.load.plant, rates, scratch, drives.num_axes, round(duration / rates.period), sums
    )
    magnetic, kinetic, turned, capacitor = stored() - before
    return Balance(*sums, magnetic, kinetic, drives.machine.load_torque * turned, capacitor)


SPEEDS = np.array([0.02, 0.3, 0.6, -0.6])  # of the rated speed
KINDS = ("motoring", "braking", "speeding up", "slowing down")


@pytest.fixture(scope="module", params=["qbl4208", "re_40"])
def energies(request):
    """Balances of 16 axes, four speeds by four kinds, shape (4 kinds, 4 speeds); and the drives after them."""
    motor = MOTORS[request.param]
    speed = np.tile(SPEEDS, len(KINDS)) * motor.rated_speed
    parameters = {
        **FREE, "stage.supply_resistance": 0.05, "stage.idle_current": 0.1, "stage.dc_capacitance": 2e-3,
        "stage.supply_sinks": 0.0, "stage.chopper_resistance": 5.0, "stage.on_resistance": 0.1,
    }  # fmt: skip
    drives = EmulatedDrives(
        load="inertia", motor=motor.name, num_machines=16, ideal=True, num_threads=1, parameters=parameters
    )
    drives.write((0x2006, 1), 1)
    drives.write((0x2006, 2), round((motor.voltage + 4.0) * 10))
    drives.write((0x2006, 3), 10)
    motion.enable(drives, mode="pv")
    drives.write(0x6083, 2**31 - 1)
    drives.write(0x60FF, np.rint(speed / (2.0 * math.pi) * 65536).astype(int))
    drives.advance(0.4)
    # Motoring and braking: a torque on the load against or with the motion. Speed changes: a new target and its ramp.
    load = np.zeros(16)
    load[:4] = -0.8 * motor.rated_torque * np.sign(speed[:4])
    load[4:8] = 0.8 * motor.rated_torque * np.sign(speed[4:8])
    drives.machine.load_torque = load
    drives.advance(0.3)
    drives.write(
        0x6083, round(0.8 * motor.rated_torque / float(drives.inside.records["J_rotor"][0, 0]) / 6.2832 * 65536)
    )
    new = speed.copy()
    new[8:12] *= 1.4
    new[12:] *= 0.1
    drives.write(0x60FF, np.rint(new / (2.0 * math.pi) * 65536).astype(int))
    result = balance(drives, 0.1)
    assert drives.emergencies() == []
    yield motor, Balance(*(term.reshape(4, 4) for term in result))
    drives.close()


@pytest.mark.parametrize("kind", range(4), ids=KINDS)
def test_input_is_shaft_work_loss_in_copper_and_stage_and_magnetic_energy_within_0_1_percent(energies, kind):
    _, terms = energies
    names = ("bridge", "copper", "stage", "shaft", "magnetic")
    bridge, copper, stage, shaft, magnetic = (getattr(terms, name)[kind] for name in names)
    scale = np.maximum(np.abs(bridge), np.maximum(np.abs(shaft), copper))
    assert np.all(np.abs(bridge - shaft - copper - stage - magnetic) <= 1e-3 * scale), (bridge, shaft, copper, stage)
    assert np.all(stage >= 0.08 * copper)  # it would be missed


@pytest.mark.parametrize("kind", range(4), ids=KINDS)
def test_shaft_work_is_kinetic_energy_and_work_on_the_load_within_0_1_percent(energies, kind):
    _, terms = energies
    shaft, kinetic, from_load = (getattr(terms, name)[kind] for name in ("shaft", "kinetic", "from_load"))
    scale = np.maximum(np.abs(shaft), np.abs(kinetic))
    assert np.all(np.abs(shaft + from_load - kinetic) <= 1e-3 * scale), (shaft, from_load, kinetic)


def test_the_cases_are_what_they_are_called(energies):
    """Fast braking feeds the link, slow braking burns more in copper than the shaft gives back."""
    _, terms = energies
    assert np.all(terms.shaft[0] > 0.0)
    assert np.all(terms.bridge[0] > 0.0)
    assert np.all(terms.shaft[1] < 0.0)
    assert terms.bridge[1, 0] > 0.0
    assert np.all(terms.bridge[1, 1:] < 0.0)
    assert np.all(terms.kinetic[2] > 0.0)
    assert np.all(terms.kinetic[3] < 0.0)


def test_source_gives_what_bridge_chopper_idle_current_and_capacitor_take_within_0_1_percent(energies):
    _, terms = energies
    taken = terms.bridge + terms.chopper + terms.idle + terms.capacitor
    scale = np.maximum(np.abs(terms.bridge), terms.idle)
    assert np.all(np.abs(terms.source - taken) <= 1e-3 * scale), (terms.source - taken) / scale


def test_what_braking_feeds_back_goes_into_the_chopper(energies):
    """The source has a diode: it takes nothing, so chopper and capacitor get all of it."""
    _, terms = energies
    fast = terms.bridge[1, 1:]
    assert np.all(terms.chopper[1, 1:] > -0.5 * fast)
    assert np.all(terms.source >= 0.0)
    assert np.all(terms.chopper[0] == 0.0)


# --- temperature --------------------------------------------------------------------------------------------------
@cached()
def run_warm(drive, dt, steps):
    for _ in range(steps):
        warm(drive, dt)


def new_winding(motor, **fields):
    records = FIRMWARE.layout.new_records(LANES)
    values = {
        "is_dc": motor.kind == "dc", "phase_factor": 1.0 if motor.kind == "dc" else 1.5, "R_s": motor.R_s,
        "R_nominal": motor.R_s, "psi_m": motor.psi_m, "psi_nominal": motor.psi_m, "overload_time": 10.0,
        "flux_temperature": motor.flux_temperature, "thermal_resistance": motor.thermal_resistance,
        "thermal_time": motor.thermal_time, "nominal_current": 42.0, **fields,
    }  # fmt: skip
    for name, value in values.items():
        set_lanes(records, name, np.broadcast_to(np.asarray(value, float), LANES))
    return records


def test_resistance_and_flux_follow_the_windings_temperature():
    """Copper 0.39 %/K, neodymium -0.11 %/K, from their values at 25 degC."""
    motor = MOTORS["qbl4208"]
    T = np.linspace(-20.0, 140.0, LANES)
    records = new_winding(motor, T_winding=T, ambient=T)
    run_warm(records[0], 1e-3, 1)
    R, psi = (get_lanes(records, name, LANES) for name in ("R_s", "psi_m"))
    np.testing.assert_allclose(R, motor.R_s * (1.0 + COPPER * (T - 25.0)), rtol=1e-12)
    np.testing.assert_allclose(psi, motor.psi_m * (1.0 - 1.1e-3 * (T - 25.0)), rtol=1e-12)
    assert R[-1] / R[0] > 1.6


@pytest.mark.parametrize("name", ["qbl4208", "re_40"])
def test_winding_without_current_cools_with_its_time_constant(name):
    records = new_winding(MOTORS[name], thermal_time=2.0, T_winding=125.0, ambient=25.0)
    run_warm(records[0], 1e-3, 2000)
    assert get_lanes(records, "T_winding", 1)[0] - 25.0 == pytest.approx(100.0 / math.e, rel=1e-3)


def test_warming_is_slower_than_cooling_since_the_loss_grows_with_it():
    """C dx/dt = P (1 + a x) - x/R_th: time constant tau / (1 - a x_cold), x_cold the rise by the cold loss."""
    motor = MOTORS["qbl4208"]
    records = new_winding(motor, thermal_time=1.0, i_q=motor.rated_current)
    loss = 1.5 * motor.R_s * motor.rated_current**2
    x_cold = loss * motor.thermal_resistance
    tau = 1.0 / (1.0 - COPPER * x_cold)
    run_warm(records[0], 1e-3, round(tau * 1000))
    rise = get_lanes(records, "T_winding", 1)[0] - 25.0
    assert rise == pytest.approx(x_cold * tau * (1.0 - 1.0 / math.e), rel=2e-3)


def test_a_blocked_axis_warms_and_its_torque_per_ampere_falls():
    """In cst at the rated current with the shaft held: the torque falls with the flux, the voltage rises with R."""
    motor = MOTORS["qbl4208"]
    held = {"load.coulomb": 1.0, "load.breakaway": 1.0, "motor.thermal_time": 0.2}
    parameters = {**held, "motor.thermal_resistance": motor.thermal_resistance}
    with EmulatedDrives(load="inertia", ideal=True, parameters=parameters) as drives:
        motion.enable(drives, mode="cst")
        drives.write("Target torque", 3500)
        drives.advance(0.02)
        torque, duty = drives.machine.motor_torque[0], drives.read((0x2041, 4))[0]
        drives.advance(2.0)
        warm_torque, warm_duty = drives.machine.motor_torque[0], drives.read((0x2041, 4))[0]
        winding = drives.machine.temperatures[0][0]
    assert winding > 90.0
    assert warm_torque / torque == pytest.approx(1.0 - 1.1e-3 * (winding - 25.0), abs=0.015)
    assert warm_duty / duty == pytest.approx(1.0 + COPPER * (winding - 25.0), rel=0.05)


@pytest.mark.parametrize("name", sorted(motors_of(["pmsm", "dc"], voltage=24.0)))
def test_rated_current_warms_the_winding_by_80_k_in_the_end(name):
    """In the end: resistance and so the loss have grown with the temperature by then."""
    motor = MOTORS[name]
    records = new_winding(motor, thermal_time=0.2, i_q=motor.rated_current)
    run_warm(records[0], 1e-3, 5000)
    assert get_lanes(records, "T_winding", 1)[0] - 25.0 == pytest.approx(80.0, rel=1e-3)
