"""A group: machines in one packed model, with the records of their drives; one thread runs it at a time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drive_env.devices import Device
from drive_env.firmware import cycle
from drive_env.firmware.cycle import Firmware
from drive_env.firmware.record import LANES, RecordLayout
from mechanics.arrays import Floats, Integers
from mechanics.packed import PackedLoad


class Channels(NamedTuple):
    """Fields that a run plays or records: type and index of lane 0, each of shape (objects,)."""

    kinds: Integers
    offsets: Integers


def channels(layout: RecordLayout, fields: list[tuple[str, int]], kinds: list[int] | None = None) -> Channels:
    """Return the channels of (field, part) pairs; `kinds` overrides the field's type."""
    found = []
    offsets = []
    for k, (name, part) in enumerate(fields):
        real, place = layout.place(name, part)
        offsets.append(place)
        found.append((cycle.REAL if real else cycle.INTEGER) if kinds is None or kinds[k] < 0 else kinds[k])
    return Channels(np.array(found, np.int64), np.array(offsets, np.int64))


def call_of(values: Floats, played: Channels, samples: Floats, sampled: Channels, every: int) -> cycle.Call:
    """Return the call that plays `values`, (cycles, objects, axes), into `samples`, (rows, objects, axes), both SI."""
    return cycle.Call(values, played.kinds, played.offsets, samples, sampled.kinds, sampled.offsets, every)


def rates_of(device: Device, physics_steps: int) -> cycle.Rates:
    """Return the periods for a device and a number of physics steps per window.

    Raises:
        ValueError: If the device's rates are not whole multiples of each other or there are too many steps.
    """
    ticks = round(device.current_rate / device.velocity_rate)
    # Step s covers the s-th part of the window; a tick across two steps gives each its share.
    edges = np.linspace(0.0, ticks, physics_steps + 1)
    start, end = edges[:-1, None], edges[1:, None]
    tick = np.arange(ticks)
    first, last = np.maximum(start, tick), np.minimum(end, tick + 1)
    overlap = np.clip(last - first, 0.0, None)
    weights = overlap / (end - start)
    late = (0.5 * (first + last) - 0.5 * (start + end)) / device.current_rate
    return cycle.Rates(
        tick=1.0 / device.current_rate,
        window=1.0 / device.velocity_rate,
        period=1.0 / device.supervision_rate,
        ticks=ticks,
        windows=round(device.velocity_rate / device.supervision_rate),
        periods=round(device.supervision_rate / device.communication_rate),
        substeps=physics_steps,
        weights=np.ascontiguousarray(weights),
        moments=np.ascontiguousarray(weights * late),
    )


def with_cycle(device: Device, cycle: float) -> Device:
    """Return a device with a shorter communication cycle [s]; unchanged for a cycle that is not shorter.

    The drive's supervision runs once in each such cycle, and its velocity loop has the nearest lower rate that fits.
    """
    rate = 1.0 / cycle
    if rate < device.communication_rate * (1.0 + 1e-9):
        return device
    supervision = max(device.supervision_rate, rate)
    fitting = [
        number * supervision
        for number in range(1, int(device.velocity_rate / supervision + 1e-9) + 1)
        if device.current_rate % (number * supervision) == 0
    ]
    return device._replace(velocity_rate=fitting[-1], supervision_rate=supervision, communication_rate=rate)


class Group:
    """Machines `machines` of a set, their mechanics and their records."""

    def __init__(
        self, machines: slice, load: PackedLoad, records: NDArray[np.void], rates: cycle.Rates, firmware: Firmware
    ) -> None:
        self.machines = machines
        self.load = load
        self.records = records
        self.rates = rates
        num_axes = load.copies * load.num_axes
        self.axes = slice(machines.start * load.num_axes, machines.start * load.num_axes + num_axes)
        memory = records.view(np.uint8).reshape(len(records), firmware.layout.dtype.itemsize)
        self.motion = np.zeros((7, len(records) * LANES))
        self.machinery = firmware.machinery(
            records=records,
            reals=memory.view(np.float64),
            integers=memory.view(np.int32),
            plant=load.plant,
            rates=rates,
            motion=self.motion,
            first_axis=self.axes.start,
            num_axes=num_axes,
        )
