"""Quotients that the ticks need, once per supervision period: a division costs a tick as much as ten products."""

from __future__ import annotations

from drive_env.firmware.common.dc_link import derive_link
from drive_env.firmware.common.encoder import derive_counter
from drive_env.firmware.record import LANES
from mechanics.kernels.compiled import inlined


@inlined
def derive_sensors(drive):
    """Compute the constants of encoder, current sensor and flux regulator."""
    for lane in range(LANES):
        derive_counter(drive, lane)
        drive.adc_steps_per_ampere[lane] = 1.0 / drive.adc_step[lane]
        drive.ampere_per_lsb[lane] = drive.adc_step[lane] / drive.adc_step_lsb[lane]
        drive.dead_time_slope[lane] = 1.0 / drive.dead_time_current[lane]
        drive.current_p_d[lane] = drive.current_p[lane] * drive.current_d_share[lane]


@inlined
def derive(drive, dt):
    """Compute the constants of encoder, current limit and sensor, DC link and rotor for ticks of dt [s]."""
    derive_sensors(drive)
    for lane in range(LANES):
        share = drive.torque_limit[lane]
        drive.current_share[lane] = share if share > 0.0 and share < 1.0 else 1.0
        i_max = drive.i_max[lane]
        drive.torque_demand_share[lane] = drive.i_q_ref[lane] / i_max if i_max > 0.0 else 0.0
        drive.chopper_conductance[lane] = 1.0 / drive.chopper_resistance[lane]
    derive_link(drive, dt)
