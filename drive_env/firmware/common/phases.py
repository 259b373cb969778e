"""Monitoring of two phases of any bridge: broken cables, largest currents, and a phase without current."""

from __future__ import annotations

from drive_env.firmware.record import Field
from mechanics.kernels.compiled import inlined, stage

OPEN_LOAD_TIME = 0.05  # s for which a phase may lack the demanded current

PARAMETERS = (
    # Temporary faults (drive_env/faults); a faultless machine has the initial values.
    Field("open_a", "f8", "", "1: the cable of phase A is broken"),
    Field("open_b", "f8", "", "1: the cable of phase B is broken"),
)

STATE = (
    Field("sin_e", "f8", "1", "sine of the rotor's true electrical angle at the tick's start"),
    Field("cos_e", "f8", "1", "", 1.0),
    Field("half_turn_sin", "f8", "1", "sine of half the electrical angle that the rotor turns in a tick"),
    Field("half_turn_cos", "f8", "1", "", 1.0),
    Field("peak_a", "f8", "A", "largest current of phase A since protection looked last"),
    Field("peak_b", "f8", "A", "the same of phase B"),
    Field("open_load_time_a", "f8", "s", "time for which phase A carried no current although it should"),
    Field("open_load_time_b", "f8", "s", "the same of phase B"),
)


@inlined
def note_peaks(drive, lane, i_a, i_b):
    """Keep the largest currents: writes peak_a and peak_b."""
    size_a = abs(i_a)
    size_b = abs(i_b)
    drive.peak_a[lane] = size_a if size_a > drive.peak_a[lane] else drive.peak_a[lane]
    drive.peak_b[lane] = size_b if size_b > drive.peak_b[lane] else drive.peak_b[lane]


@stage
def forget_peaks(drive, lane, dt):
    """Restart the largest currents for the next period, after protection has checked this one's."""
    drive.peak_a[lane] = 0.0
    drive.peak_b[lane] = 0.0


@stage
def open_load_a(drive, lane, told):
    """Return whether phase A has carried no current for long, although it should."""
    return drive.open_load_time_a[lane] > OPEN_LOAD_TIME


@stage
def open_load_b(drive, lane, told):
    """Return whether phase B has carried no current for long, although it should."""
    return drive.open_load_time_b[lane] > OPEN_LOAD_TIME
