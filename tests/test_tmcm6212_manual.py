"""The recipes of the manual as they stand there, and every writable object varied as an engineer would.

Recipes: TMCM-3313 manual, sections 6.2, 7.2 and 8.3, whose objects and values those of the TMCM-6212 are.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pytest
from canopen_wire import Wire

from drive_env import EmulatedDrives, motion
from drive_env.devices import find_device
from drive_env.firmware.record import get_lanes
from mechanics.loads import find_load

TURN = 51200
BELT = 0.04  # m of a turn


def belt(start=0.0):
    """Return a belt whose carriage begins there [m]; home is from -0.06 to -0.02 m, its end stops 0.25 m off."""
    return dataclasses.replace(find_load("belt"), start={"pulley": start})


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
class Scene(NamedTuple):
    """What is done with drives, and what is seen; `rows` are objects that it needs."""

    play: Any
    load: Any = "inertia"
    rows: Mapping[Any, int] = MappingProxyType({})


TRUE = (
    "theta_m",
    "step_position",
    "amplitude",
    "ripple",
    "chopper_frequency",
    "i_a",
    "i_b",
    "in_full_steps",
    "T_motor",
)
SEEN = (0x6041, 0x6061, 0x6062, 0x6064, 0x606C, 0x2101, 0x2102, 0x2121, 0x2122)


def look(drives):
    """Return what the bus and the machine show now."""
    bus = [drives.read(name)[0] for name in SEEN]
    names = [name for name in TRUE if name in drives.inside.records.dtype.names]
    return np.array([*bus, *(float(get_lanes(drives.inside.records, name, 1)[0]) for name in names)])


def through(drives, seconds, play=None):
    """Let time pass, and return what is seen of it, sampled and at its end."""
    trace = drives.record(list(SEEN), seconds, play)
    return np.concatenate([*(trace[name][::5, 0].astype(float) for name in SEEN), look(drives)])


def stand(drives):
    motion.enable(drives, mode="pp")
    return np.concatenate([through(drives, 0.05), through(drives, 0.6)])


def go(drives, turns=0.5):
    """A move in pp; a relative one follows."""
    motion.enable(drives, mode="pp")
    target = int(drives.read(0x607A)[0]) or round(turns * TURN)
    drives.write(0x607A, target)
    drives.write(0x6040, 0x1F)
    first = through(drives, 0.4)
    drives.write(0x6040, 0x0F)
    drives.advance(0.3)
    drives.write(0x607A, 3000)
    drives.write(0x6040, 0x5F)
    return np.concatenate([first, through(drives, 0.2)])


def interrupted(drives):
    """A relative move while another is under way."""
    motion.enable(drives, mode="pp")
    motion.start_move(drives, TURN)
    drives.advance(0.2)
    motion.start_move(drives, 2000, relative=True)
    return through(drives, 1.5)


def there_and_back(drives):
    """The way back is asked for on the way there."""
    motion.enable(drives, mode="pp")
    motion.start_move(drives, 4000)
    drives.advance(0.05)
    motion.start_move(drives, -4000)
    return through(drives, 0.6)


def turn(drives):
    """Up to 3 rev/s, which is above every threshold of these tests."""
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, int(drives.read(0x60FF)[0]) or 3 * TURN)
    return np.concatenate([through(drives, 0.15), through(drives, 0.3)])


def press(drives):
    """Turn without a load and then with one, below what half of the current bears."""
    turn(drives)
    drives.machine.load_torque = -0.2
    return np.concatenate([through(drives, 0.01), through(drives, 0.1)])


def stop_quickly(drives):
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, 2 * TURN)
    drives.advance(0.3)
    motion.quick_stop(drives)
    return through(drives, 0.3)


def home(drives):
    motion.enable(drives, mode="hm")
    drives.write(0x6040, 0x1F)
    return through(drives, 2.5)


def follow(drives):
    """Targets in csp, every fourth millisecond a new one."""
    motion.enable(drives, mode="csp")
    return through(drives, 0.1, {0x607A: np.arange(100) // 4 * 60})


def follow_speed(drives):
    motion.enable(drives, mode="csv")
    return through(drives, 0.1, {0x60FF: np.arange(100) * 40})


def push(drives):
    """A load that turns the rotor away from the steps: an encoder sees it."""
    motion.enable(drives, mode="pp")
    drives.advance(0.1)
    drives.machine.load_torque = 1.0
    return through(drives, 0.05)


def shorten(drives):
    """A short circuit across the supply."""
    motion.enable(drives, mode="pp")
    drives.machine.set("stage.short_conductance", 5.0)
    return through(drives, 0.02)


def to_the_switch(drives):
    """Left, until the switch at -0.23 m says no."""
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, -3 * TURN)
    return through(drives, 1.5)


def set_outputs(drives):
    return np.array([drives.machine.outputs[0], drives.read((0x3003, 1))[0]])


SLOW_RAMP = {0x2012: TURN // 2, 0x2011: 2 * TURN, 0x2013: 2 * TURN, 0x6083: 20 * TURN, 0x6084: 20 * TURN}
CONSTANT = {0x2093: 1}
PWM = {0x20B0: 2 * TURN, 0x20B1: 10, 0x20B2: 60}
FAST = {0x20B6: TURN}
HOMING = {0x6098: 21, (0x6099, 1): TURN, (0x6099, 2): TURN // 8, 0x609A: 10 * TURN}
ENCODER = {0x606A: 0}
COOL = {0x2003: 255, 0x2099: 3, 0x209C: 1, 0x209E: 40}
DC_STEP = {0x20B3: TURN, 0x20B4: 60, 0x20B7: 1, 0x20B8: 1}

# Object: scene, one value, another.
ROWS: dict[Any, tuple[Scene, int, int]] = {
    0x2000: (Scene(go), 8, 4),
    0x2001: (Scene(go), 200, 400),
    0x2003: (Scene(go), 200, 100),
    0x2004: (Scene(stand), 100, 40),
    0x2005: (Scene(to_the_switch, belt(-0.2)), 0, 3),
    0x2010: (Scene(go), 0, 2000),
    0x2011: (Scene(go, rows=SLOW_RAMP), 2 * TURN, 4 * TURN),
    0x2012: (Scene(go, rows=SLOW_RAMP), TURN // 2, 0),
    0x2013: (Scene(go, rows=SLOW_RAMP), 2 * TURN, TURN),
    0x2015: (Scene(there_and_back), 0, 2000),
    0x2089: (Scene(stand), 5, 50),
    0x2092: (Scene(stand), 0, 3),
    0x2093: (Scene(turn), 0, 1),
    0x2094: (Scene(turn, rows={0x2096: 8}), 0, 3),
    0x2095: (Scene(turn), 0, 10),
    0x2096: (Scene(turn, rows={0x2094: 3}), 0, 7),
    0x2097: (Scene(turn), 2, 12),
    0x2098: (Scene(turn, rows=COOL), 0, 1),
    0x2099: (Scene(turn, rows=COOL), 0, 3),
    0x209A: (Scene(turn, rows=COOL | {0x209C: 15}), 0, 15),
    0x209B: (Scene(press, rows=COOL | {0x209C: 15, 0x209E: 22}), 0, 3),
    0x209C: (Scene(turn, rows=COOL), 1, 0),
    0x209D: (Scene(turn), 0, 1),
    0x209E: (Scene(turn), 0, 20),
    0x20A1: (Scene(shorten), 0, 1),
    0x20A3: (Scene(stand), 0, 1),
    0x20A4: (Scene(turn, rows={0x209E: -63}), 0, TURN),
    0x20A5: (Scene(turn, rows=COOL), 0, 4 * TURN),
    0x20B0: (Scene(turn, rows=PWM), 0, 2 * TURN),
    0x20B1: (Scene(turn, rows=PWM), 10, 40),
    0x20B2: (Scene(turn, rows=PWM), 60, 20),
    0x20B3: (Scene(turn, rows=DC_STEP), 0, TURN),
    0x20B4: (Scene(turn, rows=DC_STEP), 20, 90),
    0x20B5: (Scene(turn, rows=DC_STEP | {0x20A4: TURN - 1}), 0, 255),
    0x20B6: (Scene(turn, rows={0x20B8: 1}), 0, TURN),
    0x20B7: (Scene(turn, rows=FAST), 0, 1),
    0x20B8: (Scene(turn, rows=FAST), 0, 1),
    0x20B9: (Scene(stand), 0, 15),
    (0x3003, 1): (Scene(set_outputs, rows={(0x3003, 2): 0xF << 16}), 0, 0x3 << 16),
    (0x3003, 2): (Scene(set_outputs, rows={(0x3003, 1): 0xF << 16}), 0, 0x5 << 16),
    0x6040: (Scene(lambda drives: through(drives, 0.01)), 0, 6),
    0x605A: (Scene(stop_quickly), 2, 6),
    0x6060: (Scene(lambda drives: through(drives, 0.01)), 0, 3),
    0x6065: (Scene(push, rows=ENCODER), 20, 0),
    0x6067: (Scene(go), 1, TURN),
    0x6068: (Scene(go, rows={0x6067: 2000}), 0, 300),
    0x606A: (Scene(push, rows={0x6065: 0}), -1, 0),
    0x607A: (Scene(go), 9000, 12000),
    0x607C: (Scene(home, belt(0.0), HOMING), 0, 1000),
    (0x607D, 1): (Scene(lambda drives: go(drives, -0.5)), -(2**31) + 1, -5000),
    (0x607D, 2): (Scene(go), 2**31 - 1, 5000),
    0x6081: (Scene(go), TURN, TURN // 2),
    0x6082: (Scene(go), 0, 3000),
    0x6083: (Scene(go), 10 * TURN, 5 * TURN),
    0x6084: (Scene(go), 10 * TURN, 5 * TURN),
    0x6085: (Scene(stop_quickly), 100 * TURN, 20 * TURN),
    (0x608F, 1): (Scene(turn, rows=ENCODER | {0x6065: 0}), 40_000, 20_000),
    0x6098: (Scene(home, belt(0.0), HOMING), 21, 35),
    (0x6099, 1): (Scene(home, belt(0.0), HOMING), TURN, TURN // 2),
    (0x6099, 2): (Scene(home, belt(0.0), HOMING), TURN // 8, TURN // 16),
    0x609A: (Scene(home, belt(0.0), HOMING), 10 * TURN, 5 * TURN),
    0x60B0: (Scene(follow), 0, 500),
    0x60B1: (Scene(follow_speed), 0, 4000),
    (0x60C2, 1): (Scene(follow), 1, 4),
    (0x60C2, 2): (Scene(follow), -3, -2),
    0x60F2: (Scene(interrupted), 0, 2),
    0x60FF: (Scene(turn), TURN, 2 * TURN),
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
        "test_stepper_brake": [(0x2002, 1), (0x2002, 2), (0x200A, 0), (0x200C, 1), (0x200C, 2)],
        "test_stepper_index": [(0x200B, 1), (0x200B, 2), (0x200B, 3), (0x200F, 1)],
        "test_stepper_protection": [(0x20A2, 0)],
        "test_tmcm6212_axis": [(0x210B, 1), (0x210B, 2), (0x3000, 0), (0x3001, 0)],
    }.items()
    for key in found
}


def keys():
    return {name if isinstance(name, tuple) else (name, 0) for name in ROWS}


def seen(name, scene, value):
    with EmulatedDrives("tmcm6212", scene.load, num_threads=1) as drives:
        for other, raw in scene.rows.items():
            if other != name:
                drives.write(other, raw)
        drives.write(name, value)
        if name not in (0x6040,):
            drives.advance(0.005)
        return scene.play(drives)


def label(name):
    index, sub = name if isinstance(name, tuple) else (name, 0)
    return f"{index:04X}-{sub}"


@pytest.mark.slow  # some 50 lives of a drive
@pytest.mark.parametrize("name", ROWS, ids=label)
def test_an_object_has_an_effect(name):
    scene, one, other = ROWS[name]
    first, second = seen(name, scene, one), seen(name, scene, other)
    assert np.isfinite(first).all() and np.isfinite(second).all()
    assert not np.array_equal(first, second), f"{one} and {other} are the same to this drive"


def test_every_writable_object_of_an_axis_is_varied():
    """Those of communication (1000h to 1FFFh) have their own tests; axis 0 stands for all."""
    device = find_device("tmcm6212")
    writable = {
        (entry.index, entry.sub)
        for entry in device.new_dictionary()
        if entry.access in ("rw", "rww", "wo")
        and entry.index >= 0x2000
        and device.locate(entry.index)[1] == entry.index
    }
    assert writable == keys() | set(ELSEWHERE)
    assert not keys() & set(ELSEWHERE)


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
