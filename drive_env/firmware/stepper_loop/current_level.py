"""The current of a closed loop: by the load angle, or as demanded by a torque mode; and its torque-producing part.

The scale goes from 2029h without a load angle to 202Ah at 2027h, one step of 255 in 2030h clocks up and 2031h down
(TMCM-3313 manual, section 1.5.3). It scales the run current, as reduced by CoolStep; boost and standby belong to the
open loop.
"""

from __future__ import annotations

import numpy as np

from drive_env.firmware.common.arithmetic import TWO_PI, sine_cosine
from drive_env.firmware.record import LANES
from drive_env.firmware.stepper.current_scale import STEPS
from drive_env.firmware.stepper_loop.load_angle import FULL_ANGLE, electrical_angle, lead_of_field
from mechanics.kernels.compiled import inlined

SCALES = 256.0
AT_ONCE = 1e9  # steps of the scale in a window


@inlined
def scale_by_load(drive, h):
    """Choose the amplitude for this window of h [s] if the encoder commutates: writes loop_scale and amplitude."""
    for lane in range(LANES):
        steps = drive.full_steps[lane] if drive.full_steps[lane] > 0.0 else 1.0
        beta = drive.load_angle_limit[lane] * (TWO_PI * 4.0 / FULL_ANGLE) / steps
        share = lead_of_field(drive, lane) / beta if beta > 0.0 else 1.0
        share = share if share < 1.0 else 1.0
        low = drive.current_scale_min[lane]
        wanted = low + (drive.current_scale_max[lane] - low) * share
        clocks = h * drive.motion_clock[lane]
        up = clocks / drive.upscale_delay[lane] if drive.upscale_delay[lane] > 0.0 else AT_ONCE
        down = clocks / drive.downscale_delay[lane] if drive.downscale_delay[lane] > 0.0 else AT_ONCE
        scale = drive.loop_scale[lane]
        scale = wanted if wanted - scale < up else scale + up
        scale = scale if drive.loop_scale[lane] - scale < down else drive.loop_scale[lane] - down
        run = drive.run_amplitude[lane]
        # CoolStep reduces the run current by steps, in addition to the load angle's scale: the driver applies both.
        steps = np.floor(drive.run_current[lane] * (STEPS / SCALES)) + 1.0
        reduction = drive.cool_reduction[lane]
        reduction = reduction if reduction < drive.cool_span[lane] else drive.cool_span[lane]
        run *= 1.0 - reduction / steps
        amplitude = run * (np.floor(scale) + 1.0) / SCALES
        asks = drive.asks_torque[lane] > 0.5
        amplitude = drive.asked_amplitude[lane] if asks else amplitude
        scale = amplitude / drive.run_amplitude[lane] * (SCALES - 1.0) if asks else scale
        tracks = drive.tracks_rotor[lane] > 0.5
        drive.loop_scale[lane] = scale if tracks else SCALES - 1.0
        drive.amplitude[lane] = amplitude if tracks else drive.amplitude[lane]


@inlined
def tell_torque(drive):
    """Write torque_current: across the rotor's flux if the encoder commutates, else the absolute current."""
    for lane in range(LANES):
        rotor = drive.step_position[lane] - drive.loop_deviation[lane] + drive.field_shift[lane]
        s, c = sine_cosine(electrical_angle(drive, lane, rotor))
        across = drive.i_b[lane] * c - drive.i_a[lane] * s
        size = (drive.i_a[lane] * drive.i_a[lane] + drive.i_b[lane] * drive.i_b[lane]) ** 0.5
        drive.torque_current[lane] = across if drive.tracks_rotor[lane] > 0.5 else size
