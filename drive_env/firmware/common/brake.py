"""The holding brake at a drive's output: when the drive releases and applies it, and how the brake follows.

    transition 4     current flows, enable_delay, brake released, brake_release_delay, operation enabled
    an orderly stop  brake applied, brake_apply_delay, current off

The output has one current for each of the two states; if both are 0, the drive does not control the brake. Commands and
causes that cut the energy (disable voltage, a quick stop of an axis that is not enabled, a cause that cuts the stage)
act at once, and the brake is applied at the same time: no delay keeps current in a motor that must not have any.

The brake is closed by a spring. It opens some time after its current has reached the pull-in share of the output's
largest, and closes some time after it has fallen below the drop-out share; in between it keeps its state.
"""

from __future__ import annotations

from mechanics.kernels.compiled import stage

LARGEST = 255.0  # of an output's current
PULL_IN, DROP_OUT = 0.6, 0.2  # of the output's largest current; usual for spring-applied brakes
OPEN, CLOSED, WITH_STAGE, WITH_OUTPUT = 0, 1, 2, 3  # modes of a machine's brake


@stage
def is_controlled(drive, lane):
    """Return whether the drive controls a brake."""
    return drive.brake_apply_current[lane] > 0.0 or drive.brake_release_current[lane] > 0.0


@stage
def enabling_time(drive, lane):
    """Return the time from the command to operation enabled [s]."""
    return drive.enable_delay[lane] + (drive.brake_release_delay[lane] if is_controlled(drive, lane) else 0.0)


@stage
def hold_until_closed(drive, lane):
    """Keep the current of an axis that has stopped until the brake carries it."""
    stands = drive.velocity_demand[lane] == 0.0 and abs(drive.omega_slow[lane]) <= drive.standstill[lane]
    if stands and is_controlled(drive, lane) and drive.brake_apply_delay[lane] > 0.0:
        drive.holding[lane] = 1
        drive.switching_time[lane] = 0.0


@stage
def drive_output(drive, lane, dt):
    """Set the output's current for one period of dt [s], end an elapsed hold, and advance both delays."""
    enabling = drive.transition_pending[lane] == 4
    waited = drive.switching_time[lane] + 0.5 * dt
    if drive.holding[lane] == 1 and not enabling and waited > drive.brake_apply_delay[lane]:
        drive.holding[lane] = 0
    released = drive.drive_function[lane] > 0.0 or (enabling and waited > drive.enable_delay[lane])
    current = drive.brake_release_current[lane] if released else drive.brake_apply_current[lane]
    # A drive without supply drives no output.
    powered = drive.u_dc[lane] >= drive.undervoltage[lane]
    drive.brake_output[lane] = current / LARGEST if powered else 0.0
    drive.switching_time[lane] += dt


@stage
def follow_output(drive, lane, dt):
    """Move the brake itself: writes brake_opened."""
    opened = drive.brake_opened[lane]
    wants_open = drive.brake_output[lane] >= PULL_IN
    wants_closed = drive.brake_output[lane] < DROP_OUT
    if (opened == 0 and not wants_open) or (opened == 1 and not wants_closed):
        drive.brake_time[lane] = 0.0
        return
    needed = drive.brake_closes_in[lane] if opened == 1 else drive.brake_opens_in[lane]
    if drive.brake_time[lane] + 0.5 * dt > needed:
        drive.brake_opened[lane] = 1 - opened
        drive.brake_time[lane] = 0.0
    else:
        drive.brake_time[lane] += dt
