"""The phase current: while the motor turns, while its speed changes, and some time after it has come to rest."""

from __future__ import annotations

import numpy as np

from drive_env.firmware.stepper.cool_step import reduction_span
from mechanics.kernels.compiled import stage

STEPS = 32.0  # of the current, 0...255 divided by eight (TMCM-3313 manual, table 33)
RAMP_CLOCKS = 262144.0  # 2^18, for each step of the ramp down (TMC5160 data sheet, IHOLDDELAY)


@stage
def scale_current(drive, lane, dt):
    """Choose the step of the current once per period of dt [s]: writes current_scale, amplitude and stage_on.

    With an off time of 0 the bridges are off, and the motor turns freely (2097h).
    """
    energised = drive.drive_function[lane] > 0.0 or drive.holding[lane] == 1
    drive.stage_on[lane] = 1.0 if energised and drive.off_time[lane] > 0.0 else 0.0
    velocity = drive.velocity_demand[lane]
    changes = velocity != drive.velocity_before[lane]
    drive.velocity_before[lane] = velocity
    if velocity != 0.0 or drive.step_rate[lane] != 0.0 or drive.drive_function[lane] == 0.0:
        drive.standstill_time[lane] = 0.0
    else:
        drive.standstill_time[lane] += dt
    asked = drive.run_current[lane]
    if changes and drive.boost_current[lane] > 0.0:
        asked = drive.boost_current[lane]
    rests = drive.standstill_time[lane] > drive.standby_delay[lane]
    if rests:
        asked = drive.standby_current[lane]
    wanted = np.floor(asked * (STEPS / 256.0))
    drive.cool_span[lane] = reduction_span(drive, lane, wanted)
    wanted -= min(drive.cool_reduction[lane], drive.cool_span[lane])
    if rests and drive.power_down_ramp[lane] > 0.0 and drive.current_scale[lane] > wanted:
        lowered = drive.current_scale[lane] - dt * drive.chopper_clock[lane] / (
            RAMP_CLOCKS * drive.power_down_ramp[lane]
        )
        drive.current_scale[lane] = max(lowered, wanted)
    else:
        drive.current_scale[lane] = wanted
    share = (np.floor(drive.current_scale[lane]) + 1.0) / STEPS
    drive.amplitude[lane] = drive.full_scale_current[lane] / (1.0 + drive.vsense[lane]) * share
