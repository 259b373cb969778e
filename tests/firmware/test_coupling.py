"""Drive and mechanics meet in windows of five current ticks: what the coupling costs, against independent solutions.

The gate (design, section 4): the largest velocity error at window ends, in % of the peak velocity, is 0.1 % up to a
resonance of 150 Hz and 0.3 % up to 450 Hz.
"""

import numpy as np
import pytest
from rigs.stepped_load import stepped

from drive_env import EmulatedDrives, motion
from drive_env.firmware import cycle
from drive_env.firmware.record import LANES, get_lanes
from drive_env.firmware.servo.stages import FIRMWARE
from drive_env.trials import response
from mechanics.kernels.compiled import cached
from mechanics.loads import LOADS
from mechanics.packed import PackedLoad

TICK = 40e-6  # current loop [s]
WINDOW = 200e-6  # velocity loop and physics step [s]
TICKS = 5
J_M = 4.8e-6  # rotor [kg m^2]
J_HUB = 1e-9  # the motor-side body of the MJCF
J_L = 1e-5
DAMPING_RATIO = 0.015
DURATION = 0.4
ORACLE_SUBSTEPS = 4  # 10 us: 100 steps per ms


def step_load(plant, torque, moment, h):
    """Step one copy through mean torques and first moments (n,); return angle and speed of the rotor, every qvel."""
    found = stepped(plant, torque, h, moment)
    return np.hstack([found.theta, found.omega, found.qvel])


@cached()
def rk4_oracle(torque, dt, substeps, J_m, J_l, k, d):
    """Return theta_m, theta_l, omega_m, omega_l after each torque, held for dt [s]: classical Runge-Kutta."""
    h = dt / substeps
    x = np.zeros(4)
    slopes = np.zeros((4, 4))
    out = np.zeros((torque.shape[0], 4))
    for n in range(torque.shape[0]):
        for _ in range(substeps):
            for j in range(4):
                y = x.copy()
                if j > 0:
                    y += slopes[j - 1] * (h if j == 3 else 0.5 * h)
                shaft = k * (y[0] - y[1]) + d * (y[2] - y[3])
                slopes[j, 0] = y[2]
                slopes[j, 1] = y[3]
                slopes[j, 2] = (torque[n] - shaft) / J_m
                slopes[j, 3] = shaft / J_l
            x = x + h / 6.0 * (slopes[0] + 2.0 * slopes[1] + 2.0 * slopes[2] + slopes[3])
        out[n] = x
    return out


def shaft(resonance):
    """Return stiffness [N*m/rad] and damping [N*m*s/rad] of a shaft with this resonance [Hz]."""
    omega_r = 2 * np.pi * resonance
    k = omega_r**2 / (1 / (J_M + J_HUB) + 1 / J_L)
    return k, 2 * DAMPING_RATIO * k / omega_r


def frictionless(name, h, integrator="leapfrog", **parameters):
    values = {"coulomb": 0.0, "breakaway": 0.0, "viscous": 0.0, **parameters}
    return PackedLoad(
        LOADS[name],
        np.full((1, 1), J_M),
        np.zeros((1, 1, 4)),
        {key: np.array([value]) for key, value in values.items()},
        h,
        integrator=integrator,
    )


def excitation(kind, resonance):
    """Return the torque of each current tick [N*m]."""
    n = round(DURATION / TICK)
    t = (np.arange(n) + 0.5) * TICK
    levels = np.repeat(np.random.default_rng(3).uniform(-0.05, 0.05, 1 + n // 250), 250)
    if kind == "steps at window starts":
        return levels[:n]
    if kind == "steps within windows":
        return np.concatenate([np.zeros(7), levels])[:n]
    f_start, f_end = 5.0, 1.2 * resonance  # passes through the resonance
    return 0.02 * np.sin(2 * np.pi * (f_start * t + (f_end - f_start) * t * t / (2 * DURATION)))


def window_means(torque):
    return torque.reshape(-1, TICKS).mean(axis=1)


def window_moments(torque):
    """Return the mean of torque times the time from the window's middle [N*m*s]."""
    late = (np.arange(TICKS) - 0.5 * (TICKS - 1)) * TICK
    return (torque.reshape(-1, TICKS) * late).mean(axis=1)


def largest_error(values, oracle):
    """Return the largest error in % of the oracle's peak."""
    return 100 * np.abs(values - oracle).max() / np.abs(oracle).max()


EXCITATIONS = ("steps at window starts", "steps within windows", "chirp")


@pytest.mark.every(4)
@pytest.mark.parametrize("kind", EXCITATIONS)
@pytest.mark.parametrize(("resonance", "gate"), [(130, 0.1), (150, 0.1), (368, 0.3), (450, 0.3)])
def test_two_mass_follows_rk4(kind, resonance, gate):
    torque = excitation(kind, resonance)
    k, d = shaft(resonance)
    load = frictionless("two_mass", WINDOW, inertia=J_L, stiffness=k, damping=d)
    found = step_load(load.plant, window_means(torque), window_moments(torque), WINDOW)
    oracle = rk4_oracle(torque, TICK, ORACLE_SUBSTEPS, J_M + J_HUB, J_L, k, d)[TICKS - 1 :: TICKS]
    errors = {
        "motor speed": largest_error(found[:, 1], oracle[:, 2]),
        "load speed": largest_error(found[:, 2] + found[:, 3], oracle[:, 3]),
        "motor angle": largest_error(found[:, 0], oracle[:, 0]),
    }
    print(f"{resonance} Hz, {kind}: " + ", ".join(f"{name} {value:.4f} %" for name, value in errors.items()))
    assert max(errors.values()) <= gate, errors


@pytest.mark.parametrize("kind", EXCITATIONS)
@pytest.mark.parametrize(("viscous", "gate"), [(0.0, 0.012), (2e-5, 0.012), (2e-4, 0.1)])
def test_hinge_follows_the_exact_solution(kind, viscous, gate):
    """The hinge's row of the design's table says 0.011 %; a hundred times the default viscous friction, the gate."""
    torque = excitation(kind, 450)
    load = frictionless("inertia", WINDOW, inertia=J_L, viscous=viscous)
    found = step_load(load.plant, window_means(torque), window_moments(torque), WINDOW)
    J = J_M + J_L
    omega, theta, exact = 0.0, 0.0, []
    for tau in torque:
        if viscous:
            # J dw/dt = tau - b w under a constant torque
            end, decay = tau / viscous, np.exp(-viscous * TICK / J)
            theta += end * TICK + (omega - end) * (1 - decay) * J / viscous
            omega = end + (omega - end) * decay
        else:
            theta += omega * TICK + 0.5 * tau / J * TICK**2
            omega += tau / J * TICK
        exact.append((theta, omega))
    exact = np.array(exact)[TICKS - 1 :: TICKS]
    error = largest_error(found[:, 1], exact[:, 1])
    angle = largest_error(found[:, 0], exact[:, 0])
    print(f"hinge, b = {viscous:g}, {kind}: speed {error:.5f} %, angle {angle:.5f} %")
    assert error <= gate
    assert angle <= gate


@pytest.mark.parametrize("resonance", [130, 368, 450])
def test_the_two_oracles_agree(resonance):
    """MuJoCo's own Runge-Kutta at one step per tick, and ours."""
    torque = excitation("chirp", resonance)
    k, d = shaft(resonance)
    load = frictionless("two_mass", TICK, "rk4", inertia=J_L, stiffness=k, damping=d)
    found = step_load(load.plant, torque, np.zeros_like(torque), TICK)
    oracle = rk4_oracle(torque, TICK, ORACLE_SUBSTEPS, J_M + J_HUB, J_L, k, d)
    assert largest_error(found[:, 1], oracle[:, 2]) < 0.01
    assert largest_error(found[:, 0], oracle[:, 0]) < 0.01


@pytest.mark.parametrize(("load", "bound"), [("inertia", 0.15), ("two_mass", 0.7)])
def test_default_loads_with_friction_follow_rk4(load, bound):
    """Loads as they ship against MuJoCo's Runge-Kutta at one step per tick.

    Dry friction is no part of the gate: where it reverses within a step, the step takes one sign for all of it, so
    every reversal of a body leaves an error of up to 2 F_c h / J; with ringing there are many.
    """
    torque = excitation("steps within windows", 140)

    def build(h, integrator):
        bearing = np.array([[[1.5e-3, 1.5e-3, 1.0, 1.5e-6]]])
        return PackedLoad(LOADS[load], np.full((1, 1), J_M), bearing, {}, h, integrator=integrator)

    default, fine = build(WINDOW, "leapfrog"), build(TICK, "rk4")
    found = step_load(default.plant, window_means(torque), window_moments(torque), WINDOW)
    oracle = step_load(fine.plant, torque, np.zeros_like(torque), TICK)[TICKS - 1 :: TICKS]
    error = largest_error(found[:, 1], oracle[:, 1])
    print(f"{load} with friction: {error:.4f} %")
    assert error <= bound


@pytest.mark.parametrize("resonance", [130, 450])
def test_the_step_of_an_elastic_axis_is_exact_at_every_size(resonance):
    k, d = shaft(resonance)
    # Steps on a grid that all step sizes share, so that every one sees the same torque.
    torque = excitation("steps at window starts", resonance)
    oracle = rk4_oracle(torque, TICK, ORACLE_SUBSTEPS, J_M + J_HUB, J_L, k, d)[TICKS - 1 :: TICKS, 2]
    errors = []
    for halvings in range(3):
        parts = 2**halvings
        load = frictionless("two_mass", WINDOW / parts, inertia=J_L, stiffness=k, damping=d)
        found = step_load(
            load.plant, np.repeat(window_means(torque), parts), np.zeros(len(torque) // TICKS * parts), WINDOW / parts
        )
        errors.append(largest_error(found[parts - 1 :: parts, 1], oracle))
    assert max(errors) < 1e-4, errors  # per cent: what the oracle's own steps leave


# --- closed loop ------------------------------------------------------------------------------------------------------
# Raw 2042h:01 and :02: the preset, softer, stiffer, and one with a faster integrator.
GAIN_PAIRS = np.array([(445, 329), (250, 200), (600, 329), (445, 700)])
SPEED = 1_000_000  # pps, 96 rad/s
T_STEP, T_LOAD, T_END = 0.010, 0.300, 0.600


def closed_loop(physics_steps, load):
    with EmulatedDrives(
        load=load, num_machines=len(GAIN_PAIRS), distinct=1, ideal=True, physics_steps=physics_steps
    ) as drives:
        drives.write((0x2042, 1), GAIN_PAIRS[:, 0])
        drives.write((0x2042, 2), GAIN_PAIRS[:, 1])
        drives.write("Profile acceleration", 1_000_000_000)
        motion.enable(drives, mode="pv")
        before = drives.record([0x606C], T_STEP)
        drives.write("Target velocity", SPEED)
        step = drives.record([0x606C], T_LOAD - T_STEP)
        drives.machine.load_torque = -0.03
        load_step = drives.record([0x606C], T_END - T_LOAD)
    y = np.concatenate([trace[0x606C] for trace in (before, step, load_step)])
    t = np.arange(len(y)) * 1e-3
    reference = np.where(t < T_STEP, 0, SPEED)[:, None] * np.ones(len(GAIN_PAIRS))
    return (
        response.step_metrics(t, y, reference, t_step=T_STEP, t_end=T_LOAD, initial=0.0),
        response.disturbance_metrics(t, y, reference, t_load=T_LOAD),
    )


@pytest.mark.parametrize("load", ["two_mass", "inertia"])
def test_halving_the_physics_step_changes_no_verdict(load):
    (step, load_step), (step_half, load_step_half) = closed_loop(1, load), closed_loop(2, load)
    assert not step.oscillating.any(), "the gain pairs must be stable"
    assert np.isfinite(step.settling_time).all()
    relative = lambda a, b: np.abs(a / b - 1).max()  # noqa: E731
    changes = {
        "IAE": relative(step.iae, step_half.iae),
        "overshoot": relative(step.overshoot, step_half.overshoot),
        "load step IAE": relative(load_step.iae, load_step_half.iae),
        "load step dip": relative(load_step.dip, load_step_half.dip),
    }
    settling = np.abs(step.settling_time - step_half.settling_time).max()
    recovery = np.abs(load_step.recovery_time - load_step_half.recovery_time).max()
    print(load, {name: f"{100 * value:.3f} %" for name, value in changes.items()}, settling, recovery)
    print("overshoot", step.overshoot, step_half.overshoot)
    assert max(changes.values()) < 0.005, changes
    assert settling <= 1e-3
    assert recovery <= 1e-3


window = FIRMWARE.window


# --- prediction within a window ---------------------------------------------------------------------------------------
@cached()
def windows(records, plant, rates, scratch, count):
    """Run windows; return rotor angle and speed of axis 0 as its ticks predict them and as the mechanics has them."""
    out = np.zeros((count, 4))
    for n in range(count):
        for block in range(records.shape[0]):
            window(records[block], rates)
        out[n, 0] = records[0].theta_m[0]
        out[n, 1] = records[0].omega_m[0]
        cycle.mechanics_window(records, plant, rates, scratch)
        out[n, 2] = records[0].theta_m[0]
        out[n, 3] = records[0].omega_m[0]
    return out


def predicted_and_true(load, **parameters):
    drives = EmulatedDrives(load=load, ideal=True, parameters=parameters)
    motion.enable(drives, mode="cst")
    drives.write("Target torque", 3000)
    drives.advance(0.001)
    group = drives.inside.groups[0]
    out = windows(drives.inside.records, group.load.plant, group.rates, np.zeros((7, LANES)), 250)
    assert get_lanes(drives.inside.records, "omega_m", 1)[0] > 50  # it did turn
    return out


@pytest.mark.slow
def test_prediction_is_exact_with_a_rigid_inertia():
    theta, omega, theta_true, omega_true = predicted_and_true(
        "inertia", **{"load.coulomb": 0.0, "load.breakaway": 0.0, "load.viscous": 0.0}
    ).T
    assert np.abs(omega - omega_true).max() < 1e-11 * omega_true.max()
    # Within a window the rotor gains up to h^2 a / 8, which the staggered scheme leaves out at a jump of the torque.
    acceleration = np.abs(np.diff(omega_true)).max() / WINDOW
    assert np.abs(theta - theta_true).max() < WINDOW**2 * acceleration / 4


@pytest.mark.slow
def test_prediction_with_viscous_friction_is_second_order():
    """The reaction is extrapolated, so what is left is its second difference."""
    viscous = 1e-4
    out = predicted_and_true("inertia", **{"load.coulomb": 0.0, "load.breakaway": 0.0, "load.viscous": viscous})
    omega, omega_true = out[2:, 1], out[2:, 3]
    J = J_M + J_L
    acceleration = np.diff(out[:, 3]) / WINDOW
    second = np.abs(np.diff(acceleration)).max() * WINDOW * viscous * WINDOW / J
    assert np.abs(omega - omega_true).max() < 2 * second + 1e-12


@pytest.mark.slow
def test_prediction_follows_the_elastic_shaft():
    omega, omega_true = predicted_and_true("two_mass")[:, [1, 3]].T
    error = np.abs(omega - omega_true).max() / np.abs(omega_true).max()
    print(f"in-window prediction, two_mass: {100 * error:.4f} % of the peak speed")
    assert error < 0.01
