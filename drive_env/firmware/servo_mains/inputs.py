"""The digital inputs of a module: those wired to switches, and those used by homing.

A module has eight inputs common to both axes. Each switch of a load is wired to one; a machine may set the others. The
drive knows its switches by masks over the inputs (Homing_NegLimSwitchMask, Homing_PosLimSwitchMask,
Homing_ReferenceSwitchMask): a switch is active while an input of its mask is; with a mask of 0 there is no such switch.
"""

from __future__ import annotations

from drive_env.firmware.common.inputs import ENABLE, HOME, LEFT, RIGHT
from drive_env.firmware.record import LANES
from drive_env.firmware.servo_mains.mains_link import owner
from mechanics.kernels.compiled import stage

NUMBER = 8
LEVELS_SHIFT = 16  # of 60FDh: the lower half is 0


@stage
def pressed(drive, lane):
    """Return the inputs set by the switches of an axis' load, as bits."""
    x, levels = drive.load_position[lane], 0
    for k in range(3):
        if drive.wired[lane] & (1 << k) and drive.switch_low[k, lane] <= x and x <= drive.switch_high[k, lane]:
            levels |= 1 << int(drive.switch_input[k, lane])
    return levels


@stage
def read_module_inputs(drive, rates):
    """Write the levels of the module's inputs, digital_inputs and 60FDh, and those of each axis, axis_inputs."""
    for lane in range(LANES):
        first = owner(drive, lane)
        levels = drive.inputs_set[first] | pressed(drive, first)
        if drive.link_shared[lane] > 0.5:
            levels |= drive.inputs_set[first + 1] | pressed(drive, first + 1)
        drive.digital_inputs[lane] = levels & ((1 << NUMBER) - 1)
        drive.input_word[lane] = drive.digital_inputs[lane] << LEVELS_SHIFT
        own = drive.digital_inputs[lane] >> drive.module_axis[lane]
        drive.axis_inputs[lane] = (own & 1) | (own >> 1 & 2) | (own >> 2 & 4) | (own >> 3 & 8)


@stage
def find_switches(drive, lane, dt):
    """Write the switches for homing: `inputs`, in the order of common/inputs.py, and homing_switches."""
    levels = drive.digital_inputs[lane]
    found = drive.inputs[lane] & ENABLE
    found |= LEFT if levels & drive.negative_switch_mask[lane] else 0
    found |= RIGHT if levels & drive.positive_switch_mask[lane] else 0
    found |= HOME if levels & drive.home_switch_mask[lane] else 0
    drive.inputs[lane] = found
    known = LEFT if drive.negative_switch_mask[lane] else 0
    known |= RIGHT if drive.positive_switch_mask[lane] else 0
    known |= HOME if drive.home_switch_mask[lane] else 0
    drive.homing_switches[lane] = known
