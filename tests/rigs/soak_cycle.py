"""One communication cycle of machines with its energies summed tick by tick: what tests/bus/test_soak.py runs.

It composes the stages as firmware/cycle.py does; a file of its own, so that it is compiled once.
"""

from __future__ import annotations

import numpy as np

from drive_env.firmware.cycle import mechanics_window, update_brakes_and_inertia
from drive_env.firmware.record import LANES
from drive_env.firmware.servo.stages import FIRMWARE
from mechanics.kernels.compiled import cached

start_window, supervise, tick = FIRMWARE.start_window, FIRMWARE.supervise, FIRMWARE.tick

BRIDGE, COPPER, SHAFT, SOURCE, CHOPPER, IDLE, OFF_CURRENT, LEAP, SPEED = range(9)


@cached()
def run_cycle(records, plant, rates, scratch, num_axes, sums, change):
    """Run one communication cycle; sums, (9, axes): six energies [J], current while off [A], leap [rad], speed [rad/s].

    The leap is how far the rotor was, at the end of a window, from where its speeds at both ends bring it, beyond
    what the change of speed in this window and the one before explains; `change`, (axes,), keeps the latter [rad/s].
    """
    dt, h = rates.tick, rates.window
    before = np.zeros(LANES)
    theta, omega = np.empty(num_axes), np.empty(num_axes)
    torque = np.zeros(num_axes)
    sums[:] = 0.0
    for block in range(records.shape[0]):
        supervise(records[block], rates)
    update_brakes_and_inertia(records, plant)
    for _ in range(rates.windows):
        for axis in range(num_axes):
            theta[axis] = records[axis // LANES].theta_m[axis % LANES]
            omega[axis] = records[axis // LANES].omega_m[axis % LANES]
            torque[axis] = 0.0
        for block in range(records.shape[0]):
            drive = records[block]
            start_window(drive, rates)
            for k in range(rates.ticks):
                for lane in range(LANES):
                    before[lane] = drive.u_dc[lane]
                tick(drive, rates, k)
                for lane in range(min(LANES, num_axes - block * LANES)):
                    axis = block * LANES + lane
                    square = 0.0
                    for start, mean, end in (
                        (drive.i_d_before[lane], drive.i_d_mean[lane], drive.i_d[lane]),
                        (drive.i_q_before[lane], drive.i_q_mean[lane], drive.i_q[lane]),
                    ):
                        middle = 1.5 * mean - 0.25 * (start + end)  # Simpson, of the parabola with that mean
                        square += (start * start + 4.0 * middle * middle + end * end) / 6.0
                    u_end, R = drive.u_dc[lane], drive.supply_resistance[lane]
                    fed = max((drive.supply_voltage[lane] - u_end) / R, 0.0)
                    mean_u = 0.5 * (before[lane] + u_end)
                    sums[BRIDGE, axis] += drive.bridge_power[lane] * dt
                    sums[COPPER, axis] += drive.phase_factor[lane] * drive.R_s[lane] * square * dt
                    in_stage = (2.0 if drive.is_dc[lane] > 0.5 else 1.5) * drive.on_resistance[lane]
                    sums[COPPER, axis] += in_stage * square * dt
                    sums[SOURCE, axis] += (drive.supply_voltage[lane] - R * fed) * fed * dt
                    sums[CHOPPER, axis] += (
                        drive.chopper[lane] * before[lane] / drive.chopper_resistance[lane] * mean_u * dt
                    )
                    sums[IDLE, axis] += drive.idle_current[lane] * mean_u * dt
                    torque[axis] += drive.tau_m[lane] / rates.ticks
                    if drive.stage_on[lane] == 0.0:
                        current = max(abs(drive.i_d[lane]), abs(drive.i_q[lane]))
                        sums[OFF_CURRENT, axis] = max(sums[OFF_CURRENT, axis], current)
        mechanics_window(records, plant, rates, scratch)
        for axis in range(num_axes):
            drive, lane = records[axis // LANES], axis % LANES
            moved = drive.theta_m[lane] - theta[axis]
            gained = drive.omega_m[lane] - omega[axis]
            sums[SHAFT, axis] += torque[axis] * moved
            leap = abs(moved - 0.5 * h * (omega[axis] + drive.omega_m[lane])) - 0.5 * h * (abs(gained) + change[axis])
            sums[LEAP, axis] = max(sums[LEAP, axis], leap)
            sums[SPEED, axis] = max(sums[SPEED, axis], abs(omega[axis]))
            change[axis] = abs(gained)
