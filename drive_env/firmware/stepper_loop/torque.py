"""Torque modes: 6071h is a current across the rotor's flux, whose angle comes from the encoder (load angle control).

The field leads by the load angle's limit, and the current is the demanded one, up to the run current. Below 1/32 of
that, which a chopper cannot control exactly, the angle reduces the torque. Without load angle control there is no
torque: the axis holds, and bit 12 of the statusword is 0, since the target is ignored.
"""

from __future__ import annotations

import math

from drive_env import cia402
from drive_env.firmware.stepper.current_scale import STEPS
from mechanics.kernels.compiled import stage

IGNORED = ~0x1000


@stage
def ask_torque(drive, lane):
    """Pass the torque demand to field and current, once per period."""
    asks = drive.tracks_rotor[lane] > 0.5 and drive.drive_function[lane] > 0.0 and drive.loop_level[lane] == 0
    drive.asks_torque[lane] = 1.0 if asks else 0.0
    if not asks:
        return
    asked = drive.torque_demand[lane]
    least = drive.run_amplitude[lane] / STEPS
    size = min(abs(asked), drive.run_amplitude[lane])
    drive.asked_amplitude[lane] = max(size, least)
    share = min(size / least, 1.0)
    lead = math.asin(share * math.sin(min(drive.lead_limit[lane] * drive.full_steps[lane] / 4.0, 0.5 * math.pi)))
    lead = drive.lead_limit[lane] if share >= 1.0 else lead * 4.0 / max(drive.full_steps[lane], 1.0)
    drive.asked_lead[lane] = lead if asked >= 0.0 else -lead


@stage
def tell_torque_mode(drive, lane):
    """Clear bit 12 if a torque mode has no loop for its target."""
    if drive.mode_display[lane] == cia402.CST and drive.tracks_rotor[lane] < 0.5:
        drive.statusword[lane] &= IGNORED
