"""Every writable object of the TGZ-D varied as an engineer would: on the first axis, with the second one beside it.

The same scene runs twice, and the value differs on that axis alone: there something is different, and on the other one
nothing is, to the bit. What the objects do in figures, test_servo_mains.py and test_tgz.py have.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from rigs.stepper_scenes import Scene, check_acts_on_one_axis, check_every_object_is_varied, label

from drive_env import EmulatedDrives, motion
from drive_env.devices import find_device
from drive_env.firmware.record import get_lanes
from mechanics.loads import find_load

DEVICE = find_device("tgz_d")
TURN = 2**20
RPM = 1000  # velocity units, as a drive is commissioned
SEEN = (0x6041, 0x6061, 0x6062, 0x6064, 0x606B, 0x606C, 0x6077, 0x60F4)
TRUE = ("theta_m", "omega_m", "i_q", "i_d", "i_q_ref", "stage_on", "u_q")


def look(drives):
    """Return what the bus and the machines show now."""
    inside = (get_lanes(drives.inside.records, name, 2) for name in TRUE)
    return np.array([*(drives.read(name) for name in SEEN), *inside], dtype=float)


def through(drives, seconds, play=None):
    """Let time pass, and return what is seen of it, sampled and at its end."""
    if play:
        play = {name: np.broadcast_to(path[:, None], (len(path), 2)) for name, path in play.items()}
    trace = drives.record(list(SEEN), seconds, play)
    return np.concatenate([*(trace[name].astype(float) for name in SEEN), look(drives)])


def go(drives, turns=0.1):
    """A move in pp."""
    motion.enable(drives, mode="pp")
    given = drives.read(0x607A)
    drives.write(0x607A, np.where(given, given, round(turns * TURN)))
    drives.write(0x6040, 0x1F)
    return through(drives, 0.15)


def turn(drives):
    given = drives.read(0x60FF)
    motion.enable(drives, mode="pv")  # by which the axes stay
    drives.write(0x60FF, np.where(given, given, 200 * RPM))
    return through(drives, 0.05)


def stop_quickly(drives):
    turn(drives)
    motion.quick_stop(drives)
    return through(drives, 0.05)


def twist(drives):
    given = drives.read(0x6071)
    motion.enable(drives, mode="cst")
    drives.write(0x6071, given)
    return through(drives, 0.01)


def follow(drives):
    """Targets in csp, every fourth millisecond a new one."""
    motion.enable(drives, mode="csp")
    return through(drives, 0.04, {0x607A: np.arange(40) // 4 * 60})


def hold(drives):
    """In csp, without a new target."""
    motion.enable(drives, mode="csp")
    return through(drives, 0.03)


def push(drives):
    """A closed brake, and a target beyond it."""
    motion.enable(drives, mode="csp")
    drives.machine.brake = "closed"
    drives.write(0x607A, 2000)
    return through(drives, 0.06)


def home(drives):
    motion.enable(drives, mode="hm")
    drives.advance(0.002)  # switches are looked at once per period
    drives.write(0x6040, 0x1F)
    return through(drives, 1.0)


def switch_on(drives):
    """Enabling word by word."""
    found = []
    drives.write(0x6060, 8)
    for word in (6, 7, 15):
        drives.write(0x6040, word)
        found.append(through(drives, 0.01))
    return np.concatenate(found)


def wait(drives):
    return through(drives, 0.005)


def outputs(drives):
    return np.array([drives.machine.outputs, drives.read((0x60FE, 1)), drives.read(0x4001)], float)


def belt(start):
    """Return a belt whose carriage begins there [m]; its home switch is from -0.06 to -0.02 m."""
    return dataclasses.replace(find_load("belt"), start={"pulley": start})


FREE = {0x6065: 0}
HOMING = FREE | {0x6098: 21, (0x6099, 1): 300 * RPM, (0x6099, 2): 60 * RPM, 0x609A: 20_000 * RPM}

# Object: scene, one value, another.
ROWS: dict[Any, tuple[Scene, int, int]] = {
    0x2303: (Scene(switch_on), 3, 6),
    0x2107: (Scene(twist, rows={0x6071: 3000}), 4000, 8000),
    0x2506: (Scene(twist, rows={0x6071: 3000}), 4000, 100),
    0x23C6: (Scene(twist, rows={0x6071: 3000}), 0, 32_000),
    0x23C7: (Scene(hold, rows=FREE), 0, 2**22),
    0x2500: (Scene(twist, rows={0x6071: 3000}), 500, 1000),
    0x2501: (Scene(twist, rows={0x6071: 3000}), 12_800, 0),
    0x2502: (Scene(turn), 100, 50),
    0x2509: (Scene(turn), 0, 100),
    0x2700: (Scene(turn), 1800, 3600),
    0x2701: (Scene(turn), 0, 50_000),
    0x2900: (Scene(follow, rows=FREE), 70_000, 140_000),
    0x2901: (Scene(follow, rows=FREE), 0, 1000),
    0x2109: (Scene(twist, rows={0x6071: 3000}), 5, 4),
    0x2B01: (Scene(turn), 65536, 32768),
    0x23E2: (Scene(turn), 0, 1),
    0x23E3: (Scene(switch_on, rows={0x2303: 3}), 3, 0),
    0x23E4: (Scene(switch_on, rows={0x2303: 3}), 3, 0),
    0x23E5: (Scene(turn, rows={0x23E4: 1}), 1000, 3000),
    0x6040: (Scene(wait, rows={0x2303: 3, 0x6060: 8}), 0, 6),
    0x6060: (Scene(wait), 0, 3),
    0x6065: (Scene(push, rows={0x6066: 10}), 0, 500),
    0x6066: (Scene(push, rows={0x6065: 500}), 10, 30),
    0x6067: (Scene(go), 1, TURN),
    0x6068: (Scene(go, rows={0x6067: TURN}), 0, 100),
    0x6071: (Scene(twist), 1000, 3000),
    0x607A: (Scene(go), 3000, 6000),
    0x607C: (Scene(home, belt(-0.01), HOMING), 0, 1000),
    (0x607D, 1): (Scene(lambda drives: go(drives, -0.1)), -(2**31), -2000),
    (0x607D, 2): (Scene(go), 2**31 - 1, 2000),
    0x6081: (Scene(go), 300 * RPM, 30 * RPM),
    0x6083: (Scene(go), 20_000 * RPM, 2000 * RPM),
    0x6084: (Scene(go), 20_000 * RPM, 2000 * RPM),
    0x6085: (Scene(stop_quickly), 50_000 * RPM, 2000 * RPM),
    (0x608F, 1): (Scene(go), 4096, 8192),
    (0x608F, 2): (Scene(go), 1, 2),
    (0x6094, 1): (Scene(turn), 1, 2),
    (0x6094, 2): (Scene(turn), 1000, 500),
    0x6098: (Scene(home, belt(0.0), HOMING), 21, 35),
    0x23C0: (Scene(home, belt(0.0), HOMING | {0x6098: 17}), 0, 1),
    0x23C1: (Scene(home, belt(0.0), HOMING | {0x6098: 18}), 0, 2),
    0x23C2: (Scene(home, belt(0.0), HOMING), 0, 4),
    (0x6099, 1): (Scene(home, belt(0.0), HOMING), 300 * RPM, 100 * RPM),
    (0x6099, 2): (Scene(home, belt(-0.019), HOMING), 60 * RPM, 10 * RPM),
    0x609A: (Scene(home, belt(0.0), HOMING), 20_000 * RPM, 2000 * RPM),
    0x60B2: (Scene(twist, rows={0x6071: 1000}), 0, 500),
    (0x60C1, 1): (Scene(hold, rows=FREE), 0, 1000),
    (0x60C2, 1): (Scene(follow), 1, 4),
    (0x60C2, 2): (Scene(follow), -3, -2),
    0x6086: (Scene(go), 0, 1),
    0x60FF: (Scene(turn), 100 * RPM, 200 * RPM),
}  # fmt: skip
# Of the maker's registers.
REGISTERS = (
    0x2010, 0x2106, 0x2108, *range(0x210A, 0x210F), *range(0x230A, 0x230F), 0x2B00, 0x2B02, 0x2B03,
    0x2505, 0x2507, 0x2508, 0x2702, 0x2703, 0x2902, 0x2903, 0x3900, 0x3901, 0x3907, 0x3908, 0x390A, 0x390B, 0x390C,
)  # fmt: skip
# Objects whose effect other tests find.
ELSEWHERE = {
    **{(index, 0): "test_tgz_registers.py" for index in REGISTERS},
    **{
        (index, 0): "test_tgz_own_commands.py"
        for index in (0x23C8, 0x23C9, 0x23CA, *range(0x3100, 0x3105), 0x3109, 0x310A, 0x333C, 0x3904, 0x3905, 0x3909)
    },
    (0x200D, 0): "test_tgz.py: node-ID; test_ethercat_tgz.py: alias",
    (0x25C0, 0): "test_tgz.py: images with which a drive begins",
    (0x25C1, 0): "the same",
    (0x25C2, 0): "test_tgz.py: the mapped parameters",
    (0x25C3, 0): "the same",
    (0x4001, 0): "test_tgz.py: outputs, which both axes share",
    (0x60FE, 1): "the same",
    (0x60FE, 2): "the same",
}


def vary(name, scene, one, other, axis=0):
    """Return what a scene shows with one value of an object, and with another on an axis."""
    found = []
    for last in (one, other):
        with EmulatedDrives("tgz_d", scene.load, num_machines=2, num_threads=1) as drives:
            for row, raw in scene.rows.items():
                if row != name:
                    drives.write(row, raw)
            values = np.full(2, one)
            values[axis] = last
            if name == 0x23C7 or name == (0x60C1, 1):  # a target: of an axis that is enabled
                motion.enable(drives, mode="csp")
            drives.write(name, values)
            found.append(scene.play(drives))
    return found


def acts_on_one_axis(name, axis):
    scene, one, other = ROWS[name]
    check_acts_on_one_axis(*vary(name, scene, one, other, axis), axis)


@pytest.mark.slow  # some 90 lives of a drive
@pytest.mark.parametrize("name", ROWS, ids=label)
def test_an_object_has_an_effect_on_its_axis_and_on_no_other(name):
    acts_on_one_axis(name, 0)


@pytest.mark.parametrize("name", [0x2107, 0x2700, 0x6094, 0x60FF], ids=hex)
def test_so_it_is_on_the_second_axis(name):
    acts_on_one_axis((name, 1) if name == 0x6094 else name, 1)


def test_every_writable_object_of_an_axis_is_varied():
    """And none of an axis is refused."""
    check_every_object_is_varied(DEVICE, ROWS, ELSEWHERE, DEVICE.without_effect)
    assert not {key for key in DEVICE.unsupported if key[0] >= 0x2000}


# What the maker calls unused; names; and what is of a port, or of a program, that is not there (device.toml has why).
IDLE = {*range(0x2100, 0x2106), *range(0x2300, 0x2303), 0x2503, 0x2504, 0x2704, 0x2705, 0x2706, 0x2B04, 0x3327}
IDLE |= {0x200C, 0x200F, 0x2011}


def test_an_object_that_is_said_to_have_no_effect_keeps_its_value_and_has_none():
    """No object is one of them in silence, and what they are set to changes nothing, to the bit."""
    assert {index for index, sub in DEVICE.without_effect} == IDLE
    values = {0x200F: 5, 0x2011: 0}
    written = {key: values.get(key[0], 1234) for key in DEVICE.without_effect if key[0] != 0x3327}
    found = []
    for rows in ({}, written):
        with EmulatedDrives("tgz_d", "two_mass", num_machines=2, num_threads=1) as drives:
            for key, value in rows.items():
                drives.write(key, value)
            found.append(np.concatenate([turn(drives), go(drives)]))
            for key, value in rows.items():
                assert drives.read(key).tolist() == [value] * 2
            assert not drives.read(0x3327).any()
    np.testing.assert_array_equal(*found)
