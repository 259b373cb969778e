"""Every writable object of the TMCM-3313 varied as an engineer would: on one axis, with the other two beside it.

The same scene runs twice, and the value differs on that axis alone: there something is different, and on the other two
nothing is, to the bit. What the objects do in figures, the tests of the stepper firmwares have.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rigs.stepper_scenes import (
    COMMON,
    ENCODER,
    TURN,
    Scene,
    check_acts_on_one_axis,
    check_every_object_is_varied,
    close_loop,
    go,
    label,
    lean,
    nudge,
    overload,
    turn_fast,
    twist,
    vary,
)

from drive_env import EmulatedDrives
from drive_env.devices import find_device

AXES = 3
DEVICE = find_device("tmcm3313")

# The loop's settings are table 2's (the preset); what holds the motor in its place is left out.
LOOP = ENCODER | {0x2020: 1, 0x6065: 0}
PID = LOOP | {0x2020: 2, 0x202B: 8000, 0x202C: 500, 0x202D: 400, 0x202E: 2, 0x202F: 400_000, 0x2021: 10_000}
BOWS = {0x6086: 1, (0x60A4, 1): 100 * TURN, (0x60A4, 2): 100 * TURN, (0x60A4, 3): 100 * TURN, (0x60A4, 4): 100 * TURN}
FAST = LOOP | {0x6081: 40 * TURN, 0x6083: 100 * TURN}
TORQUE = LOOP | {0x2003: 255, 0x6071: 300}

# Object: scene, one value, another.
ROWS: dict[Any, tuple[Scene, int, int]] = COMMON | {
    0x2014: (Scene(go, rows={0x6082: 5000}), 0, 20_000),
    0x2015: (Scene(go, rows=BOWS), 1, 4),
    0x2020: (Scene(overload, rows=LOOP), 1, 0),
    0x2021: (Scene(lean, rows=LOOP | {0x2022: 0}), 65_536, 200_000),
    0x2022: (Scene(lean, rows=LOOP | {0x2021: 200_000}), 0, 255),
    0x2027: (Scene(overload, rows=LOOP), 255, 128),
    0x2029: (Scene(close_loop, rows=LOOP), 50, 120),
    0x202A: (Scene(lean, rows=LOOP), 255, 150),
    0x202B: (Scene(overload, rows=LOOP | {0x202F: 10**6}), 3000, 500),
    0x202C: (Scene(overload, rows=LOOP | {0x202B: 500, 0x202F: 10**6}), 0, 200),
    0x202D: (Scene(overload, rows=LOOP | {0x202B: 0, 0x202C: 500, 0x202F: 10**6}), 2000, 20),
    0x202E: (Scene(nudge, rows=PID | {0x2021: 1_000_000}), 2, 3000),
    0x202F: (Scene(overload, rows=LOOP), 100_000, 20_000),
    0x2030: (Scene(lean, rows=LOOP), 1000, 100_000),
    0x2031: (Scene(lean, rows=LOOP), 1000, 100_000),
    0x2034: (Scene(turn_fast, rows=FAST | {0x2036: 200}), 4 * TURN, 16 * TURN),
    0x2035: (Scene(turn_fast, rows=FAST | {0x2034: 4 * TURN, 0x2036: 200}), 0, 40 * TURN),
    0x2036: (Scene(turn_fast, rows=FAST | {0x2034: 4 * TURN, 0x2035: 0}), 0, 200),
    0x204E: (Scene(go), 0, 250),
    0x6071: (Scene(twist, rows=TORQUE), 100, 300),
    0x6086: (Scene(go, rows=BOWS), 0, 1),
    0x60B2: (Scene(twist, rows=TORQUE), 0, -200),
} | {
    (0x60A4, sub): (Scene(go, rows=BOWS), 100 * TURN, 400 * TURN) for sub in range(1, 5)
} | {
    (0x607D, 1): (Scene(lambda drives: go(drives, -0.5)), -(2**31), -5000),
    (0x607D, 2): (Scene(go), 2**31 - 1, 5000),
}  # fmt: skip
# Objects whose effect other tests find, or that take one value.
ELSEWHERE = {
    (0x208C, 0): "takes 181 alone: test_objects_of_one_value_take_no_other",
    (0x605B, 0): "takes one value: the same",
    (0x605C, 0): "takes one value: the same",
    (0x605D, 0): "takes one value: the same",
    (0x605E, 0): "takes one value: the same",
    (0x2028, 0): "below: the initialisation writes it, too",
    (0x2703, 1): "below: the module's",
    (0x2703, 2): "below: the module's",
}


def acts_on_one_axis(name, axis):
    scene, one, other = ROWS[name]
    check_acts_on_one_axis(*vary("tmcm3313", name, scene, one, other, axis, AXES), axis)


@pytest.mark.slow  # some 90 lives of a module
@pytest.mark.parametrize("name", ROWS, ids=label)
def test_an_object_has_an_effect_on_its_axis_and_on_no_other(name):
    acts_on_one_axis(name, 0)


@pytest.mark.every(3)
@pytest.mark.parametrize("axis", [1, 2])
@pytest.mark.parametrize("name", [0x2003, 0x2014, 0x2027, 0x6085], ids=label)
def test_so_it_is_on_the_other_axes(name, axis):
    acts_on_one_axis(name, axis)


def test_every_writable_object_of_an_axis_is_varied():
    """And none of an axis is refused."""
    check_every_object_is_varied(DEVICE, ROWS, ELSEWHERE)
    assert not {key for key in DEVICE.unsupported if key[0] >= 0x2000}


def test_the_offset_of_the_encoder_is_the_initialisations_and_can_be_changed():
    """2028h: 100 microsteps more, and the axis is seen as much farther on; the motor stands where it stood."""
    with EmulatedDrives("tmcm3313", "inertia", num_machines=AXES, num_threads=1) as drives:
        for name, raw in LOOP.items():
            drives.write(name, raw)
        close_loop(drives)
        assert drives.read(0x2120).tolist() == [1, 1, 1]
        before, stands = drives.read(0x6064), drives.machine.rotor_angle.copy()
        drives.write(0x2028, drives.read(0x2028) + np.array([0, 100, 0]))
        drives.advance(0.05)
        np.testing.assert_allclose(drives.read(0x6064) - before, [0, 100, 0], atol=2)
        np.testing.assert_allclose(drives.machine.rotor_angle, stands, atol=2 * np.pi / TURN)
        drives.write(0x2020, 0)
        drives.advance(0.01)
        drives.write(0x2028, 12345)
        drives.write(0x2020, 1)
        drives.advance(0.6)
        assert np.abs(drives.read(0x2028)).max() < 1000


def test_the_modules_outputs_are_those_of_the_mask():
    for mask, outputs in ((0, 0), (0x5, 0x1), (0xF, 0x3)):
        with EmulatedDrives("tmcm3313", "inertia", num_machines=AXES, num_threads=1) as drives:
            drives.write((0x2703, 2), mask << 16)
            drives.write((0x2703, 1), 0x3 << 16)
            assert drives.machine.outputs[0] == outputs
