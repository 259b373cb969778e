"""Digital inputs: limit switches, home switch and enable, as pressed by the load, and as interpreted by 2005h."""

from __future__ import annotations

from mechanics.kernels.compiled import stage

LEFT, RIGHT, HOME, ENABLE = 1, 2, 4, 8

# 2005h (TMCM-1636 manual, table 58): bits that deactivate and that invert the switches, in the order left, right, home.
_DEACTIVATE = (0x01, 0x02, 0x10)
_INVERT = (0x04, 0x08, 0x20)


@stage
def read_inputs(drive, lane):
    """Write the inputs' levels (60FDh). An unconnected input reads active."""
    levels = ENABLE if drive.enable_input[lane] == 1 else 0
    x = drive.load_position[lane]
    for k in range(3):
        wired = drive.wired[lane] & (1 << k)
        pressed = drive.switch_low[k, lane] <= x and x <= drive.switch_high[k, lane]
        if pressed or wired == 0:
            levels |= 1 << k
    drive.inputs[lane] = levels


@stage
def is_active(drive, lane, k):
    """Return whether switch k (0 left, 1 right, 2 home) is active after 2005h's deactivation and inversion."""
    settings = drive.limit_switches[lane]
    if settings & _DEACTIVATE[k]:
        return False
    level = (drive.inputs[lane] >> k) & 1
    return level == (0 if settings & _INVERT[k] else 1)
