"""Traces between two communication cycles of emulated drives: signals at the rate of the velocity loop.

This is not available on a bus; a real drive of this kind shows its loops once a millisecond. The machines run bit by
bit as otherwise: a cycle is run as windows, and only the first one includes the drive's work per cycle.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from drive_env.dictionary.entries import ObjectName
from drive_env.drives.interface import Drives
from drive_env.emulator.emulated_drives import emulated_of
from drive_env.emulator.group import call_of, channels
from drive_env.emulator.live_dictionary import NOTHING
from drive_env.firmware.record import get_lanes, set_lanes
from mechanics.arrays import Floats

if TYPE_CHECKING:
    pass


# Signal -> unit; fields of the drive's record (firmware/record.py) at the start of a window, if the firmware has them.
SIGNALS = {
    "position_demand": "rad",
    "theta_meas": "rad",
    "velocity_demand": "rad/s",
    "omega_ref": "rad/s",
    "omega_meas": "rad/s",
    "i_q_ref": "A",
    "torque_meas": "A",
    "theta_m": "rad",
    "omega_m": "rad/s",
}


class LoopTrace(NamedTuple):
    """Sample times [s], shape (n,), and each signal in SI, shape (n, num_axes)."""

    t: Floats
    signals: dict[str, Floats]


def trace_loops(
    drives: Drives, signals: Sequence[str], duration: float, play: Mapping[ObjectName, ArrayLike] | None = None
) -> LoopTrace:
    """Let `duration` [s] pass while signals are sampled at the start of every window of the velocity loop.

    Sample 5 k (with five windows a cycle) equals row k of `record`: the state after the last cycle.

    Args:
        drives: Emulated drives; not available on a bus.
        signals: Names of `SIGNALS`.
        duration: Whole communication cycles [s].
        play: As for `record`, one row per communication cycle.

    Raises:
        ValueError: For drives on a bus, an unknown signal, or a time that is not a whole number of cycles.
        ObjectAccessError: For an object that cannot be played, or a value out of range.
    """
    if drives.machine is None:
        raise ValueError("drives on a bus show their loops once per communication cycle only; use record()")
    emulated = emulated_of(drives)  # observers do not notice this time
    fields = emulated.device.firmware.layout.dtype.names or ()
    known = [name for name in SIGNALS if name in fields]
    for name in signals:
        if name not in known:
            raise ValueError(f"no signal is named {name!r}; there are {', '.join(known)}")
    cycles = emulated.inside.cycles(duration)
    values, played = emulated.inside.objects.plan_play(play or {}, cycles)
    sampled = channels(emulated.device.firmware.layout, [(name, 0) for name in signals])
    windows = round(emulated.device.velocity_rate / emulated.device.supervision_rate)
    periods = round(emulated.device.supervision_rate / emulated.device.communication_rate)
    samples = np.empty((cycles, periods, windows, len(signals), emulated.num_axes))
    live = get_lanes(emulated.inside.records, "live", emulated.num_axes).astype(np.int32)
    rates = {id(group.machinery.rates): group.machinery.rates for group in emulated.inside.groups}.values()
    period = 1.0 / emulated.device.supervision_rate
    nothing = np.empty((windows, 0, emulated.num_axes))
    begin, diverged = emulated.inside.cycle, False
    try:
        # Each window is run as if it were a cycle.
        for one in rates:
            one.replace(windows=1, periods=1)
        for k in range(cycles):
            while emulated.inside.schedule and emulated.inside.schedule[0][0] <= begin + k:
                _, name, row, where = emulated.inside.schedule.pop(0)
                emulated.machine.set(name, row, where)
            for p in range(periods):
                first = (np.ascontiguousarray(values[k : k + 1]), played) if p == 0 else (nothing, NOTHING)
                call = call_of(*first, samples[k, p, :1], sampled, 1)
                diverged |= emulated._run_groups(call, 0, 1, True, True)
                # A lane that is not alive is computed as always, and left out of the work done once a period.
                set_lanes(emulated.inside.records, "live", np.zeros(emulated.num_axes, np.int32))
                for one in rates:
                    one.replace(period=0.0)
                others = call_of(nothing, NOTHING, samples[k, p, 1:], sampled, 1)
                diverged |= emulated._run_groups(others, 0, windows - 1, True, True)
                set_lanes(emulated.inside.records, "live", live)
                for one in rates:
                    one.replace(period=period)
            emulated.inside.cycle = begin + k + 1
    finally:
        set_lanes(emulated.inside.records, "live", live)
        for one in rates:
            one.replace(windows=windows, periods=periods, period=period)
    if diverged:
        emulated._report_divergence()
    rows = samples.reshape(cycles * periods * windows, len(signals), emulated.num_axes)
    t = np.arange(len(rows)) / emulated.device.velocity_rate
    return LoopTrace(t, {name: rows[:, k].copy() for k, name in enumerate(signals)})
