"""CoolStep: adapts the current to the load, by the load reading of StallGuard2.

At each reading below the lower threshold the current rises by 1, 2, 4 or 8 of its 32 steps; after 32, 8, 2 or 1
readings not below the upper one it falls by a step. It stays between the run current and a half or a quarter of it.
"""

from __future__ import annotations

from drive_env.firmware.record import LANES
from mechanics.kernels.compiled import inlined, stage

THRESHOLD_UNIT = 32.0  # of the reading, for each step of 209Ah and 209Ch


@stage
def reduction_span(drive, lane, wanted):
    """Return how many steps CoolStep may lower a current of `wanted` steps, 0...31 (2098h scales the number)."""
    share = 0.25 if drive.cool_minimum[lane] > 0.5 else 0.5
    return wanted - float(int(wanted * share))


@inlined
def adapt_current(drive):
    """Raise or lower the current after a fresh reading: writes cool_reduction, which is 0 if CoolStep is inactive.

    It is active above the speed of 20A5h, while StallGuard2 reads the load, and with a lower threshold above 0.
    """
    for lane in range(LANES):
        reads = drive.stage_on[lane] * (1.0 - drive.in_pwm[lane]) * drive.in_spread_cycle[lane] > 0.5
        runs = abs(drive.step_rate[lane]) > drive.cool_speed[lane] and drive.cool_start[lane] > 0.0
        works = reads and runs
        fresh = works and drive.load_is_fresh[lane] > 0.5
        value = drive.load_value[lane]
        low = fresh and value < THRESHOLD_UNIT * drive.cool_start[lane]
        upper = THRESHOLD_UNIT * (drive.cool_start[lane] + drive.cool_hysteresis[lane] + 1.0)
        high = fresh and value >= upper
        code = drive.cool_down[lane]
        slow = 32.0 if code < 0.5 else 8.0
        quick = 2.0 if code < 2.5 else 1.0
        asked = slow if code < 1.5 else quick
        few = 1.0 if drive.cool_up[lane] < 0.5 else 2.0
        many = 4.0 if drive.cool_up[lane] < 2.5 else 8.0
        rise = few if drive.cool_up[lane] < 1.5 else many
        # Readings between the thresholds change nothing; a rise restarts the count.
        count = drive.cool_count[lane] + (1.0 if high else 0.0)
        falls = count >= asked
        count = 0.0 if falls or low or not works else count
        reduction = drive.cool_reduction[lane] + (1.0 if falls else 0.0) - (rise if low else 0.0)
        reduction = reduction if reduction < drive.cool_span[lane] else drive.cool_span[lane]
        reduction = reduction if reduction > 0.0 else 0.0
        drive.cool_count[lane] = count
        drive.cool_reduction[lane] = reduction if works else 0.0


@stage
def forget_reduction(drive, lane):
    """Reset to the full current."""
    drive.cool_count[lane] = 0.0
    drive.cool_reduction[lane] = 0.0
