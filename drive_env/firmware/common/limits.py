"""The software limits of the position, 607Dh, as the drive applies them."""

from __future__ import annotations

from mechanics.kernels.compiled import stage

ROUNDING = 1e-9  # rad: a target at the corrected limit itself is within it
# rad, one degree of the rotor: an axis held at its limit moves by less, and is not reported.
LIMIT_MARGIN = 0.017453292519943295


@stage
def corrected_minimum(drive, lane):
    """Return 607Dh:01 corrected by the home offset (TMCM-1636 manual, section 6.1.11) [rad]."""
    return drive.position_min[lane] - drive.home_offset[lane]


@stage
def corrected_maximum(drive, lane):
    """Return 607Dh:02 corrected by the home offset [rad]."""
    return drive.position_max[lane] - drive.home_offset[lane]


@stage
def demand_above(drive, lane):
    """Return whether the position demand is past the upper limit.

    Only position modes have such a demand: the one that velocity modes integrate for 6062h drifts from an axis that a
    load pushes.
    """
    return drive.loop_level[lane] == 2 and drive.position_demand[lane] > corrected_maximum(drive, lane)


@stage
def demand_below(drive, lane):
    """Return whether the position demand is past the lower limit."""
    return drive.loop_level[lane] == 2 and drive.position_demand[lane] < corrected_minimum(drive, lane)
