"""Writes the settings besides gains: motor parameters of factory-fresh drives, wiring; restores all else at the end."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from drive_env import cia402, motion
from drive_env.cia402 import Key
from drive_env.dictionary.roles import Role
from drive_env.drives.raw_gains import write_gains
from mechanics.arrays import Integers, Mask
from tuning.identify.wiring import changes, corrected, findings
from tuning.identify.working_state import BOTH_ENDS
from tuning.snapshot import Transaction, restore

if TYPE_CHECKING:
    from tuning.auto.bench import AutoBench
    from tuning.auto.stages import IdentifiedAxes
    from tuning.target import Target

LEAST_WAY = 0.2  # rad, least travel: finding the poles alone turns a rotor this far


def begin(bench: AutoBench) -> None:
    """Reject axes with too short a travel, and disable enabled ones: identification begins at rest."""
    drives, way = bench.target.drives, bench.target.high - bench.target.low
    for axis in np.flatnonzero(way < LEAST_WAY):
        turns, least = (0.5 * x / np.pi for x in (way[axis], LEAST_WAY))
        bench.journals[axis].stop(
            f"the travel is too short: {way[axis]:.2g} rad ({turns:.2g} turns), and {LEAST_WAY:g} rad ({least:.2g} "
            "turns) are needed; allow more with --travel"
        )
    on = cia402.matches(drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED)
    if on.any():
        motion.disable(drives, where=on)


def commission(bench: AutoBench, identified: IdentifiedAxes) -> Mask:
    """Write the motor's parameters to factory-fresh drives, and wiring settings to any; return which were fresh.

    Identification wrote them, too, but restored the drives afterwards.
    """
    target = bench.target
    fresh: Mask = bench.going & (target.drives.read(Role.MOTOR_TYPE) == 0)
    _wire(bench, identified, fresh)
    if not fresh.any():
        return fresh
    for key, value in motor_parameters(target).items():
        if key not in findings(target.device):
            target.drives.write(key, value, where=fresh)
    bench.note(fresh, f"factory-fresh drive: commissioned for {target.motor.name} first")
    unwired = ignore_unwired_switches(target, fresh)
    if unwired.any():
        bench.note(unwired, told_unwired(target))
    return fresh


def ignore_unwired_switches(target: Target, where: Mask) -> Mask:
    """Ignore limit switches of axes on which both are active, so not connected; return these axes."""
    if Role.LIMIT_SWITCHES not in target.device.roles:
        return np.zeros_like(where)
    unwired: Mask = where & (target.drives.read(cia402.DIGITAL_INPUTS) & BOTH_ENDS == BOTH_ENDS)
    target.drives.write(Role.LIMIT_SWITCHES, BOTH_ENDS, where=unwired)
    return unwired


def told_unwired(target: Target) -> str:
    """Return the note on ignored switches."""
    index, _ = target.device.roles[Role.LIMIT_SWITCHES]
    return f"both limit switches were active at once, so they are not connected: they are ignored ({index:04X}h)"


def _wire(bench: AutoBench, identified: IdentifiedAxes, fresh: Mask) -> None:
    """Write the wiring settings as identified; for factory-fresh drives the motor's known ones where not identified."""
    target = bench.target
    known = {key: value for key, value in motor_parameters(target).items() if key in findings(target.device)}
    wanted: list[dict[Key, int]] = []
    for k, found in enumerate(identified.found):
        seen = {} if found is None else found.wiring
        needed = known | {key: one.needs for key, one in seen.items()} if fresh[k] else changes(seen)
        wanted.append(needed if bench.going[k] else {})
        if bench.going[k] and not fresh[k]:
            for text in corrected(target.device, seen):
                bench.journals[k].note(text)
    bench.wire(wanted)


def write(bench: AutoBench, fresh: Mask, gains: Integers, transaction: Transaction) -> Mask:
    """Leave the accepted axes with gains and restore everything else; return these axes, (num_axes,).

    Args:
        bench: The drives.
        fresh: Axes that were factory-fresh, which keep the parameters written by `commission`, (num_axes,).
        gains: Raw, (num_axes, count).
        transaction: Has the state before.
    """
    bench.drop_faults("its gains were verified")
    going = bench.going
    bench.stop(~going, "another axis of its machine was rejected")
    if not going.any():
        return going
    drives = bench.target.drives
    write_gains(drives, gains, going)
    motion.disable(drives, where=going)
    # 0, no mode, is the value before the first mode; it cannot be written.
    other = going & (bench.modes != 0) & (drives.read(cia402.MODE) != bench.modes)
    if other.any():
        drives.write(cia402.MODE, bench.modes, where=other)
    wiring, roles = list(findings(bench.target.device)), bench.target.device.roles
    commissioned = [*wiring, *motor_parameters(bench.target)]
    if Role.LIMIT_SWITCHES in roles:
        commissioned.append(roles[Role.LIMIT_SWITCHES])
    axes = []
    for k, values in enumerate(transaction.before.axes):
        stays = [key for key in (commissioned if fresh[k] else wiring) if key in values]
        own = dict(zip(bench.target.device.gains.keys, map(int, gains[k]), strict=True))
        axes.append({**values, **{key: int(drives.read(key)[k]) for key in stays}, **own})
    restore(drives, replace(transaction.before, axes=tuple(axes)), going, whole=False)
    return going


def motor_parameters(target: Target) -> dict[Key, int]:
    """Return the motor's parameters for a drive by key, without those of the encoder's initialisation.

    Presets assume a known encoder offset, which is unknown here.
    """
    dictionary, left = target.device.new_dictionary(), target.device.roles.get(Role.ENCODER_INITIALISATION)
    entries = [(dictionary.find(name), value) for name, value in target.device.preset(target.motor).items()]
    return {(entry.index, entry.sub): value for entry, value in entries if (entry.index, entry.sub) != left}
