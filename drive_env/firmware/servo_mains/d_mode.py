"""The gate of a drive whose D-Mode must match the mode of operation: otherwise it ignores its master.

The D-Mode for each mode of operation is data of the device. A mismatch "disconnects" the drive from the master (TGZ
manual, section on 6060h): controlword and set-points are ignored, statusword bit 9 (remote) is 0. The manual does not
say what an enabled axis does then. Here it makes a quick stop, and its power goes off at standstill, since no master
can stop it any more; after the mismatch has ended it must be enabled anew, step by step.

The gate is checked once per supervision period: both numbers may be changed within one, in either order.
"""

from __future__ import annotations

from drive_env import cia402
from drive_env.firmware.common import fsa
from mechanics.kernels.compiled import stage

MOST_MODES = 11  # modes of operation 0 to 10
QUICK_STOP = int(cia402.COMMANDS["quick stop"].value)
DISABLE_VOLTAGE = int(cia402.COMMANDS["disable voltage"].value)


@stage
def fits(drive, lane):
    """Return whether the D-Mode is the one that the mode of operation needs."""
    mode = drive.mode[lane]
    if mode < 0 or mode >= MOST_MODES:
        return False
    needed = drive.d_mode_needed[mode, lane]
    return needed == 0 or needed == drive.d_mode[lane]


@stage
def is_remote(drive, lane):
    """Return whether the axis takes commands from its master."""
    return drive.disconnected[lane] == 0


@stage
def look_at_gate(drive, lane, dt):
    """Connect or disconnect the axis, once per period; an axis disconnected while it moves is stopped.

    An axis enabled by the service program (own_commands.py) is connected after it has stopped.
    """
    has_fit = fits(drive, lane)
    drive.gate_fits[lane] = 1 if has_fit and drive.mode[lane] != 0 else 0
    if has_fit and drive.service[lane] == 0:
        drive.disconnected[lane] = 0
        return
    if drive.disconnected[lane] == 0:
        drive.disconnected[lane] = 1
        drive.controlword[lane] = QUICK_STOP
        fsa.command(drive, lane)
    if drive.fsa[lane] != fsa.STOPPING:
        return
    # By 605Ah a quick stop may end in a state that holds the motor: here its power goes off in any case.
    stands = drive.velocity_demand[lane] == 0.0 and abs(drive.omega_slow[lane]) <= drive.standstill[lane]
    if drive.quick_stop_option[lane] >= fsa.STOP_AND_STAY and (stands or drive.stop_time[lane] > fsa.LONGEST_STOP):
        drive.controlword[lane] = DISABLE_VOLTAGE
        fsa.command(drive, lane)
