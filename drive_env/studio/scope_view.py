"""The scope of one axis: channels in their units, rolling or triggered, and stored recordings.

It reads the recorder, and accesses no drive.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drive_env.cia402 import Key
from drive_env.dictionary.entries import Entry
from drive_env.dictionary.quantities import SHOWN, UNITS, Scale, find_unit
from drive_env.studio.decimation import min_max, stride_of
from drive_env.studio.recorder import GAP, RingSamples, ScopeRecorder
from drive_env.studio.scope_trigger import ScopeTrigger, first_fired
from mechanics.arrays import Floats

MOST_CHANNELS = 8
WINDOWS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 60.0)  # s
MODES = {"roll": "rolling", "auto": "auto", "normal": "normal", "single": "single"}
AUTO_WAIT = 1.0  # s without a trigger after which auto shows the newest samples
STEPS = 65_000  # integer steps to which a value is quantised for the page


@dataclass(frozen=True)
class ScopeChannel:
    """An object of an axis on the scope, with unit and factor that convert an integer to a value."""

    key: Key
    axis: int
    name: str
    unit: str
    factor: float

    @property
    def label(self) -> str:
        """Name and unit."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


@dataclass(frozen=True)
class ScopeRecording:
    """A stored recording: times from the trigger [s], shape (n,), and each channel's values, shape (n,)."""

    t: Floats
    values: tuple[tuple[ScopeChannel, Floats], ...]

    def of(self, channel: ScopeChannel) -> Floats | None:
        """Return the values of a channel; None if it was not recorded."""
        return next((values for one, values in self.values if one == channel), None)


def channel_of(
    entry: Entry, axis: int, scale: Scale, *, several: bool, units: Mapping[str, str] = SHOWN
) -> ScopeChannel:
    """Return an object of an axis as a channel in the unit of its dimension."""
    unit = find_unit(entry.unit, scale)
    shown = entry.unit if unit is None else units[unit.dimension]
    factor = 1.0 if unit is None else unit.factor / UNITS[shown].factor
    name = f"{entry.name} (axis {axis})" if several else entry.name
    return ScopeChannel((entry.index, entry.sub), axis, name, shown, factor)


class ScopeView:
    """The scope of an axis; pages that show it share it.

    Args:
        recorder: The recorder of the samples.

    Attributes:
        channels: Displayed channels, at most eight.
        window: Duration of a recording [s].
        before: Share of it before the trigger.
        trigger: Trigger of a recording; unused in the mode "roll".
        mode: A name of `MODES`.
        is_running: Whether new samples are shown.
        columns: Number of pixel columns.
        kept: The recording of the last trigger, or of the halt; None without one.
        reference: Another recording, shown below.
        cursors: Times of A and B [s], None if they are hidden.
    """

    def __init__(self, recorder: ScopeRecorder) -> None:
        self._recorder = recorder
        self.channels: tuple[ScopeChannel, ...] = ()
        self.window = 2.0
        self.before = 0.1
        self.trigger: ScopeTrigger | None = None
        self.mode = "roll"
        self.is_running = True
        self.columns = 800
        self.kept: ScopeRecording | None = None
        self.reference: ScopeRecording | None = None
        self.cursors: tuple[float | None, float | None] = (None, None)
        self._generation = recorder.generation
        self._looked = recorder.ring.total  # number of samples that the trigger has evaluated
        self._fired: int | None = None  # sample at which it fired, while the rest of the recording is missing
        self._fired_at = recorder.now  # time of the last recording [s]
        self._frame = 0

    # --- called by the page -----------------------------------------------------------------------------------------
    def run(self) -> None:
        """Show new samples from now on."""
        self.is_running = True
        self.kept = None
        self.arm()

    def halt(self) -> None:
        """Keep the recording on display."""
        if self.is_running and self.kept is None:
            self.kept = self._rolling()
        self.is_running = False

    def arm(self) -> None:
        """Wait for the trigger, from now on."""
        self._looked = self._recorder.ring.total
        self._fired = None
        self._fired_at = self._recorder.now

    def keep_as_reference(self) -> bool:
        """Keep the current traces as dashed reference; return whether there were any."""
        shown = self.shown()
        self.reference = shown if len(shown.t) else None
        return self.reference is not None

    def shown(self) -> ScopeRecording:
        """Return the recording on display, with all samples."""
        return self.kept if self.kept is not None else self._rolling()

    @property
    def is_armed(self) -> bool:
        """Whether it waits for its trigger, or for the rest of a recording."""
        return self.is_running and self.mode != "roll" and self.trigger is not None

    @property
    def status(self) -> str:
        """The scope's state in a few words."""
        if not self.is_running:
            return "halted"
        if self.mode == "roll":
            return "running"
        if self._fired is not None:
            return "triggered"
        return "waiting for the trigger"

    # --- time ------------------------------------------------------------------------------------------------------
    def step(self) -> None:
        """Process new samples."""
        recorder = self._recorder
        with recorder.lock:
            if recorder.generation != self._generation:  # other objects are sampled: numbers begin again
                self._generation, self._looked, self._fired = recorder.generation, 0, None
            if not self.is_armed or self.trigger is None:
                return
            if self._fired is None:
                self._look_for_trigger(self.trigger)
            if self._fired is not None:
                self._complete()

    def _look_for_trigger(self, trigger: ScopeTrigger) -> None:
        ring = self._recorder.ring
        if trigger.key not in ring.keys:
            return
        rows = ring.read(self._looked - 1, ring.total)
        if len(rows) < 2:
            return
        found = first_fired(trigger, rows.values[trigger.key][:, trigger.axis])
        self._looked = ring.total
        if found is not None:
            self._fired = rows.first + found

    def _complete(self) -> None:
        """Store the recording when all its samples exist."""
        ring, period = self._recorder.ring, self._recorder.period
        assert self._fired is not None
        count = round(self.window / period)
        before = round(self.before * count)
        end = self._fired + count - before
        if ring.total < end:
            return
        rows = ring.read(self._fired - before, end)
        start = float(rows.t[self._fired - rows.first])
        self.kept = self._recording(rows, start)
        self._fired_at = self._recorder.now
        self._fired, self._looked = None, end
        if self.mode == "single":
            self.is_running = False

    def _rolling(self) -> ScopeRecording:
        """Return the newest samples, with times relative to now."""
        with self._recorder.lock:
            rows = self._newest()
        return self._recording(rows, float(rows.t[-1]) if len(rows) else 0.0)

    def _newest(self) -> RingSamples:
        ring = self._recorder.ring
        return ring.read(ring.total - round(self.window / self._recorder.period), ring.total)

    def _recording(self, rows: RingSamples, start: float) -> ScopeRecording:
        there = [one for one in self.channels if one.key in rows.values]
        values = tuple((one, np.asarray(rows.values[one.key][:, one.axis] * one.factor, np.float64)) for one in there)
        return ScopeRecording(rows.t - start, values)

    # --- the picture -----------------------------------------------------------------------------------------------
    def frame(self) -> bytes:
        """Return the picture as bytes: length of the header, the header as JSON, 16-bit integers.

        For each trace the least value of each column, then the greatest; they are scaled between `low` and `high` of
        the header.
        """
        self.step()
        self._frame += 1
        waits = self._recorder.now - self._fired_at > max(AUTO_WAIT, self.window)
        if self.kept is not None and not (self.is_running and self.mode == "auto" and waits):
            span = (float(self.kept.t[0]), float(self.kept.t[-1])) if len(self.kept.t) else (0.0, 1.0)
            traces, blobs = self._traces(self.kept, 0)
        else:
            with self._recorder.lock:
                rows = self._newest()
            now = self._recorder.now
            traces, blobs = self._traces(self._recording(rows, now), rows.first)
            span = (-self.window, 0.0)
        under, more = self._traces(self.reference, 0) if self.reference is not None else ([], [])
        header = {
            "frame": self._frame, "status": self.status, "from": span[0], "to": span[1],
            "triggered": self.kept is not None and self.mode != "roll",
            "channels": [{"label": one.label, "name": one.name, "unit": one.unit} for one in self.channels],
            "traces": traces, "reference": under,
        }  # fmt: skip
        text = json.dumps(header, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        return struct.pack("<I", len(text)) + text + b"".join([*blobs, *more])

    def _traces(self, recording: ScopeRecording, first: int) -> tuple[list[dict[str, Any]], list[bytes]]:
        """Return each channel's trace as an entry of the header, and as integers."""
        traces, blobs = [], []
        stride = stride_of(len(recording.t), self.columns)
        for channel, values in recording.values:
            if channel not in self.channels or not len(values):
                continue
            columns = min_max(values, stride, first)
            low, high = float(columns.low.min()), float(columns.high.max())
            step = (high - low) / STEPS or 1.0
            both = (columns.low, columns.high) if stride > 1 else (columns.low,)
            blobs += [np.rint((one - low) / step - STEPS / 2).astype("<i2").tobytes() for one in both]
            t = recording.t[columns.starts]
            every = stride * self._recorder.period
            nominal = float(t[1]) - every if len(t) > 1 else float(t[0])  # the first column may be incomplete
            broken = np.flatnonzero(np.diff(t) > GAP * every) + 1
            traces.append({
                "channel": self.channels.index(channel), "count": len(t), "thick": stride > 1,
                "low": low, "high": high, "step": step, "offset": STEPS / 2, "from": nominal,
                "every": every, "breaks": [(int(k), float(t[k])) for k in broken],
            })  # fmt: skip
        return traces, blobs


def with_channels(view: ScopeView, channels: tuple[ScopeChannel, ...]) -> None:
    """Set the displayed channels; a kept recording of others is dropped while the scope runs.

    Raises:
        ValueError: For more than eight.
    """
    if len(channels) > MOST_CHANNELS:
        raise ValueError(f"{len(channels)} channels are too many; the scope shows {MOST_CHANNELS}: take some away")
    view.channels = channels
    if view.kept is not None and view.is_running:
        view.kept = None


def with_units(view: ScopeView, channels: tuple[ScopeChannel, ...]) -> None:
    """Show the same channels in other units, also in stored recordings."""
    new = {one.key: one for one in channels}

    def of(recording: ScopeRecording | None) -> ScopeRecording | None:
        if recording is None:
            return None
        pairs = ((new.get(one.key, one), one, values) for one, values in recording.values)
        return replace(recording, values=tuple((to, values * (to.factor / one.factor)) for to, one, values in pairs))

    view.channels, view.kept, view.reference = channels, of(view.kept), of(view.reference)


def moved(recording: ScopeRecording, by: float) -> ScopeRecording:
    """Return a recording with its times shifted [s]."""
    return replace(recording, t=recording.t + by)
