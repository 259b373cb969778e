"""Common part of csp and csv: interpolation between set-points that come once per interpolation period.

A set-point is reached one interpolation period (60C2h) after it came, along a straight line from the present demand. An
early set-point takes over at once; a repeated one is planned anew; without a new one the demand stays at the last one,
at rest in csp, at the last velocity in csv. Until the first set-point after enabling or a change of mode the axis holds
its position, so that an old target does not move it.
"""

from __future__ import annotations

from mechanics.kernels.compiled import stage

NO_SET_POINT = -1


@stage
def forget(drive, lane):
    """Wait for a first set-point; earlier ones do not count."""
    drive.set_point_fresh[lane] = 0
    drive.set_point_steps[lane] = NO_SET_POINT


@stage
def interpolate(drive, lane, demand, target, dt):
    """Return the demand after one period of dt [s] on the way to the target."""
    if drive.set_point_fresh[lane] == 1:
        drive.set_point_fresh[lane] = 0
        period = drive.interpolation_value[lane] * 10.0 ** drive.interpolation_index[lane]
        drive.set_point_steps[lane] = max(int(period / dt + 0.5), 1)
    steps = drive.set_point_steps[lane]
    if steps == NO_SET_POINT:
        return demand
    if steps <= 1:
        drive.set_point_steps[lane] = 0
        return target
    drive.set_point_steps[lane] = steps - 1
    return demand + (target - demand) / steps
