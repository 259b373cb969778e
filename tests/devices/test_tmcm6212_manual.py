"""The recipes of the manual as they stand there, and every writable object varied as an engineer would.

Recipes: TMCM-3313 manual, sections 6.2, 7.2 and 8.3, whose objects and values those of the TMCM-6212 are.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rigs.canopen_wire import Wire
from rigs.stepper_scenes import (
    BELT,
    COMMON,
    TURN,
    Scene,
    belt,
    check_every_object_is_varied,
    label,
    stand,
    there_and_back,
    turn,
    vary,
)

from drive_env import EmulatedDrives
from drive_env.devices import find_device
from drive_env.firmware.record import get_lanes


# --- the recipes ------------------------------------------------------------------------------------------------------
@pytest.fixture
def drives():
    with EmulatedDrives("tmcm6212", "inertia", num_threads=1) as made:
        yield made


def write(drives, *rows):
    """Write objects one after the other, with what a master needs from one frame to the next."""
    for name, raw in rows:
        drives.write(name, raw)
        drives.advance(0.002)


def test_how_to_move_a_motor_in_pp(drives):
    write(drives, (0x2005, 3), (0x6060, 1), (0x6040, 6), (0x6040, 7), (0x6040, 15), (0x607A, 500_000))
    drives.advance(0.1)
    assert drives.read(0x6064)[0] == 0, "the target is not active yet"
    write(drives, (0x6040, 31), (0x6040, 15))  # while the motor is still moving
    assert drives.read(0x6041)[0] & 0x0400 == 0
    drives.advance(6.0)
    assert drives.read(0x6064)[0] == 500_000 and drives.read(0x6041)[0] & 0x0400
    assert drives.machine.rotor_angle[0] / (2 * np.pi) == pytest.approx(500_000 / TURN, abs=0.002)


def test_its_maker_s_demonstration_of_pp():
    """PyTrinamic's pp example for this module: of the ramp it writes 6083h alone, and waits for the position."""
    with EmulatedDrives("tmcm6212", "inertia", num_machines=6, num_threads=1, commissioned=False) as drives:
        wire = Wire(drives)
        for index, raw, size in ((0x2005, 3, 4), (0x6040, 6, 2), (0x6040, 7, 2), (0x6060, 1, 1), (0x6040, 15, 2),
                                 (0x607A, 50_000, 4), (0x6083, 20_000, 4)):  # fmt: skip
            assert wire.download(index, 0, raw, size) == 0
            wire.wait(2)
        for target in (50_000, 0):
            for index, raw, size in ((0x607A, target, 4), (0x6040, 15, 2), (0x6040, 31, 2)):
                assert wire.download(index, 0, raw, size) == 0
                wire.wait(2)
            wire.wait(3400)  # 2 sqrt(50,000 / 20,000) s
            assert wire.value(0x6064) == target
        assert wire.value(0x6081) == 51_200


def test_how_to_move_a_motor_in_pv(drives):
    write(drives, (0x2005, 3), (0x6060, 3), (0x6040, 6), (0x6040, 7), (0x6040, 15), (0x60FF, 100_000))
    drives.advance(0.5)
    assert drives.read(0x606C)[0] == 100_000
    assert drives.machine.rotor_speed[0] / (2 * np.pi) == pytest.approx(100_000 / TURN, rel=0.05)
    write(drives, (0x60FF, 0))
    drives.advance(0.5)
    assert drives.read(0x606C)[0] == 0


def test_how_to_start_a_homing():
    """The carriage comes to the home switch from below: method 19 ends at that edge."""
    with EmulatedDrives("tmcm6212", belt(-0.1), num_threads=1) as drives:
        write(drives, (0x6060, 6), (0x6040, 6), (0x6040, 7), (0x6040, 15), (0x6098, 19))
        write(drives, ((0x6099, 1), 50_000), ((0x6099, 2), 10_000), (0x6040, 31))
        drives.advance(4.0)
        assert drives.read(0x6041)[0] & 0x3400 == 0x1400
        write(drives, (0x6040, 15))
        place = get_lanes(drives.inside.records, "load_position", 1)[0]
        assert place - drives.read(0x6064)[0] / TURN * BELT == pytest.approx(-0.06, abs=2e-4)


# --- every writable object has an effect ------------------------------------------------------------------------------
def set_outputs(drives):
    return np.array([drives.machine.outputs[0], drives.read((0x3003, 1))[0]])


FAST = {0x20B6: TURN}
DC_STEP = {0x20B3: TURN, 0x20B4: 60, 0x20B7: 1, 0x20B8: 1}

# Object: scene, one value, another.
ROWS: dict[Any, tuple[Scene, int, int]] = COMMON | {
    0x2015: (Scene(there_and_back), 0, 2000),
    0x20B3: (Scene(turn, rows=DC_STEP), 0, TURN),
    0x20B4: (Scene(turn, rows=DC_STEP), 20, 90),
    0x20B5: (Scene(turn, rows=DC_STEP | {0x20A4: TURN - 1}), 0, 255),
    0x20B6: (Scene(turn, rows={0x20B8: 1}), 0, TURN),
    0x20B7: (Scene(turn, rows=FAST), 0, 1),
    0x20B8: (Scene(turn, rows=FAST), 0, 1),
    0x20B9: (Scene(stand), 0, 15),
    (0x3003, 1): (Scene(set_outputs, rows={(0x3003, 2): 0xF << 16}), 0, 0x3 << 16),
    (0x3003, 2): (Scene(set_outputs, rows={(0x3003, 1): 0xF << 16}), 0, 0x5 << 16),
}  # fmt: skip
# Objects whose effect other tests find, or that take one value.
ELSEWHERE = {
    (0x208C, 0): "takes 181 alone: units of the chip are refused (test_tmcm6212_parity.py)",
    (0x3004, 0): "bit rate after a reset: below",
    (0x3005, 0): "node-ID after a reset: below",
    (0x3006, 1): "a service that stores both: below",
} | {
    key: f"its figures: {test}.py"
    for test, found in {
        "test_stepper_protection": [(0x20A2, 0)],
        "test_tmcm6212_axis": [(0x210B, 1), (0x210B, 2), (0x3000, 0), (0x3001, 0)],
    }.items()
    for key in found
}


@pytest.mark.slow  # some 50 lives of a drive
@pytest.mark.parametrize("name", ROWS, ids=label)
def test_an_object_has_an_effect(name):
    scene, one, other = ROWS[name]
    first, second = vary("tmcm6212", name, scene, one, other)
    assert np.isfinite(first).all() and np.isfinite(second).all()
    assert not np.array_equal(first, second), f"{one} and {other} are the same to this drive"


def test_every_writable_object_of_an_axis_is_varied():
    check_every_object_is_varied(find_device("tmcm6212"), ROWS, ELSEWHERE)


def test_bit_rate_and_node_id_are_those_that_were_stored_after_a_reset(tmp_path):
    with EmulatedDrives("tmcm6212", "inertia", num_machines=6, num_threads=1) as six:
        wire = Wire(six, store=tmp_path / "store.json")
        assert wire.download(0x3005, 0, 9, 1) == wire.download(0x3004, 0, 500, 2) == 0
        wire.play("""
            rx 000  81 05
            tx 705  00                # nothing was stored: node 5 still
        """)
        assert wire.download(0x3005, 0, 9, 1) == wire.download(0x3004, 0, 500, 2) == 0
        assert wire.download(0x3006, 1, 0x65766173, 4) == 0
        wire.play("""
            rx 000  81 05
            tx 709  00
        """)
        assert (wire.value(0x3007), wire.value(0x3008)) == (500, 9)
