"""Restarts and resets restore field by field what they always did, only at once."""

from __future__ import annotations

import numpy as np
import pytest

from drive_env import EmulatedDrives, motion
from drive_env.firmware.servo.stages import FIRMWARE

POSITION_SCALER = (0x2058, 0)


@pytest.fixture
def used():
    """Eleven axes whose every writable number was changed where it can be, and that ran."""
    with EmulatedDrives(num_machines=11, seed=1, randomise=True, num_threads=1) as drives:
        rng = np.random.default_rng(0)
        motion.enable(drives, mode="csv")
        drives.record([0x6064], 0.02, play={0x60FF: rng.integers(-900_000, 900_000, (20, 11))})
        for name in (0x2003, 0x6081, 0x6083, 0x6065, 0x6067, (0x607D, 1), (0x2041, 1), (0x2042, 2), 0x60B1, 0x2400):
            try:
                drives.write(name, rng.integers(1, 200, 11))
            except Exception:
                continue
        drives.write(0x2058, 5000, where=np.arange(11) % 2 == 0)
        yield drives


def fields(drives):
    return {name: drives.inside.records[name].copy() for name in FIRMWARE.layout.dtype.names if name != "padding"}


def test_a_restart_restores_what_single_writes_would(used):
    objects = used.inside.objects
    before = used.inside.records.copy()
    values = {key: value.copy() for key, value in objects._values.items() if isinstance(value, np.ndarray)}
    mask = np.arange(11) % 3 == 0
    objects.restart(mask)
    found, found_values = fields(used), {key: objects._values[key].copy() for key in values}
    used.inside.records[:] = before
    objects._values.update({key: value.copy() for key, value in values.items()})
    for key in sorted(objects._stored, key=lambda key: key != POSITION_SCALER):
        entry, raw = objects.entries.find(key), np.broadcast_to(objects._stored[key], (11,))
        if key not in objects.device.bindings:
            objects._set_value(entry, raw, mask)
        elif entry.access not in ("ro", "const"):  # what is read only the firmware computes
            objects._set_field(entry, raw, mask)
    FIRMWARE.power_on(used.inside.records, mask)
    for name, expected in fields(used).items():
        assert np.array_equal(expected, found[name], equal_nan=True), name
    for key in values:
        assert np.array_equal(objects._values[key], found_values[key]), key
    assert used.read(0x2058)[0] == 65536 and used.read(0x2058)[2] == 5000


def test_what_is_stored_later_is_restored(used):
    used.reset_node()
    used.inside.objects.store(4, {(0x6081, 0): 777, POSITION_SCALER: 1000})
    used.reset_node()
    assert used.read(0x6081)[[3, 4]].tolist() == [2184533, 777]
    assert used.read(0x2058)[[3, 4]].tolist() == [65536, 1000]


def test_a_reset_sets_the_state_of_the_masked_machines_alone(used):
    before = fields(used)
    mask = np.arange(11) == 9
    used.machine.reset(mask)
    after = fields(used)
    others = np.flatnonzero(np.arange(16) != 9)
    for field in FIRMWARE.layout.state:
        if field.name.startswith("block_"):
            continue
        old, new = (each[field.name].reshape(2, -1, 8) for each in (before, after))
        for axis in others:
            assert np.array_equal(old[axis // 8, :, axis % 8], new[axis // 8, :, axis % 8], equal_nan=True), field.name
    assert after["omega_m"][1, 1] == 0.0 and before["omega_m"][1, 1] != 0.0
    assert after["T_winding"][1, 1] == 25.0 and used.read(0x6041)[9] & 0x6F == 0x40
