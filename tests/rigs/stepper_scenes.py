"""What an engineer does to see whether an object of a stepper drive acts: scenes on any stepper drive of ours.

A scene returns what bus and machines show, one row per sample and a column per axis.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from drive_env import EmulatedDrives, motion
from drive_env.firmware.record import get_lanes
from mechanics.loads import find_load

TURN = 51200
BELT = 0.04  # m of a turn


def belt(start=0.0):
    """Return a belt whose carriage begins there [m]; home is from -0.06 to -0.02 m, its end stops 0.25 m off."""
    return dataclasses.replace(find_load("belt"), start={"pulley": start})


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
    "stage_on",
    "brake_output",
)
SEEN = (0x6041, 0x6061, 0x6062, 0x6064, 0x606C, 0x2101, 0x2102)
SEEN_OF = {"tmcm6212": (0x2121, 0x2122), "tmcm3313": (0x2033, 0x2120, 0x6077)}


def seen(drives):
    """Return what is sampled of a drive."""
    return (*SEEN, *SEEN_OF[drives.device.name])


def look(drives):
    """Return what the bus and the machines show now."""
    bus = [drives.read(name) for name in seen(drives)]
    names = [name for name in TRUE if name in drives.inside.records.dtype.names]
    return np.array([*bus, *(get_lanes(drives.inside.records, name, drives.num_axes) for name in names)], dtype=float)


def through(drives, seconds, play=None):
    """Let time pass, and return what is seen of it, sampled and at its end."""
    names = seen(drives)
    if play:
        play = {name: np.broadcast_to(path[:, None], (len(path), drives.num_axes)) for name, path in play.items()}
    trace = drives.record(list(names), seconds, play)
    return np.concatenate([*(trace[name][::5].astype(float) for name in names), look(drives)])


def stand(drives):
    motion.enable(drives, mode="pp")
    return np.concatenate([through(drives, 0.05), through(drives, 0.6)])


def go(drives, turns=0.5):
    """A move in pp; a relative one follows."""
    motion.enable(drives, mode="pp")
    given = drives.read(0x607A)
    drives.write(0x607A, np.where(given, given, round(turns * TURN)))
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
    given = drives.read(0x60FF)
    drives.write(0x60FF, np.where(given, given, 3 * TURN))
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


def switch_on(drives):
    """Enabling word by word, and disabling again, as statusword, brake output and current show it."""
    seen = []
    for word in (6, 7, 15, 7):
        drives.write(0x6040, word)
        seen.append(through(drives, 0.1))
    return np.concatenate(seen)


def turn_by_hand(drives):
    """Without current."""
    drives.machine.load_torque = 0.03
    return through(drives, 0.3)


def latch(drives):
    """Pass the index, and look at what was latched there."""
    turn(drives)
    return np.array([drives.read((0x200F, sub)) for sub in (1, 2, 3)])


def close_loop(drives, mode="pp"):
    """Enable with 2020h written, and wait for the loop where there is one to wait for."""
    motion.enable(drives, mode=mode)
    return through(drives, 0.6)


def lean(drives):
    """In a loop: a load that stays, and one that is gone again."""
    first = close_loop(drives)
    drives.machine.load_torque = -0.1
    second = through(drives, 0.1)
    drives.machine.load_torque = -0.3
    return np.concatenate([first, second, through(drives, 0.1)])


def overload(drives):
    """In a loop: more than the motor bears, while it turns, and the way back."""
    close_loop(drives, "pv")
    drives.write(0x60FF, TURN)
    drives.advance(0.3)
    drives.machine.load_torque = -0.9
    first = through(drives, 0.05)
    drives.machine.load_torque = 0.0
    return np.concatenate([first, through(drives, 0.3)])


def nudge(drives):
    """In a loop: a few full steps by force, and the way back."""
    close_loop(drives)
    drives.machine.load_torque = 0.9
    first = through(drives, 0.002)
    drives.machine.load_torque = 0.0
    return np.concatenate([first, through(drives, 0.5)])


def turn_fast(drives):
    """In a loop: more speed than the back-EMF lets the motor have."""
    close_loop(drives, "pv")
    drives.write(0x60FF, 40 * TURN)
    return np.concatenate([through(drives, 0.5), through(drives, 0.3)])


def twist(drives):
    """Current across the flux, in a loop."""
    close_loop(drives)
    motion.enable(drives, mode="cst")
    return through(drives, 0.1)


def vary(device, name, scene, one, other, axis=None, num_axes=1):
    """Return what a scene shows with one value of an object, and with another on an axis, or on all of them."""
    found = []
    for last in (one, other):
        with EmulatedDrives(device, scene.load, num_machines=num_axes, num_threads=1) as drives:
            for index, raw in scene.rows.items():
                if index != name:
                    drives.write(index, raw)
            values = np.full(num_axes, one)
            values[slice(None) if axis is None else axis] = last
            drives.write(name, values)
            if name != 0x6040:
                drives.advance(0.005)
            found.append(scene.play(drives))
    return found


def label(name):
    """Return an object as tests are named by it."""
    index, sub = name if isinstance(name, tuple) else (name, 0)
    return f"{index:04X}-{sub}"


# What scenes need: of ramps, chopper, homing, encoder, load reading.
SLOW_RAMP = {0x2012: TURN // 2, 0x2011: 2 * TURN, 0x2013: 2 * TURN, 0x6083: 20 * TURN, 0x6084: 20 * TURN}
PWM = {0x20B0: 2 * TURN, 0x20B1: 10, 0x20B2: 60}
HOMING = {0x6098: 21, (0x6099, 1): TURN, (0x6099, 2): TURN // 8, 0x609A: 10 * TURN}
INDEX = {0x6098: 34, 0x606A: 0, (0x6099, 2): TURN, 0x609A: 10 * TURN, 0x2005: 3, 0x6065: 0}
ENCODER = {0x606A: 0}
BRAKE = {(0x200C, 2): 255, (0x2002, 1): 20, (0x2002, 2): 20}
COOL = {0x2003: 255, 0x2099: 3, 0x209C: 1, 0x209E: 40}

# Objects that both manuals have, with the same meaning. Object: scene, one value, another.
COMMON: dict[Any, tuple[Scene, int, int]] = {
    0x2000: (Scene(go), 8, 4),
    0x2001: (Scene(go), 200, 400),
    0x2003: (Scene(go), 200, 100),
    0x2004: (Scene(stand), 100, 40),
    0x2005: (Scene(to_the_switch, belt(-0.2)), 0, 3),
    (0x2002, 1): (Scene(switch_on, rows=BRAKE), 0, 50),
    (0x2002, 2): (Scene(switch_on, rows=BRAKE), 0, 50),
    0x200A: (Scene(switch_on), 0, 50),
    (0x200B, 1): (Scene(home, rows=INDEX), 0, 1),
    (0x200B, 2): (Scene(turn, rows=ENCODER | {0x6065: 0}), 0, 1),
    (0x200B, 3): (Scene(turn_by_hand, rows=ENCODER), 0, 1),
    (0x200C, 1): (Scene(switch_on, rows=BRAKE), 0, 40),
    (0x200C, 2): (Scene(switch_on, rows=BRAKE), 255, 200),
    (0x200F, 1): (Scene(latch), 0, 1),
    0x2010: (Scene(go), 0, 2000),
    0x2011: (Scene(go, rows=SLOW_RAMP), 2 * TURN, 4 * TURN),
    0x2012: (Scene(go, rows=SLOW_RAMP), TURN // 2, 0),
    0x2013: (Scene(go, rows=SLOW_RAMP), 2 * TURN, TURN),
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


# --- of the tests that vary every writable object of a device ---------------------------------------------------------
def check_acts_on_one_axis(first, second, axis):
    """Hold that what is seen with two values of an object of one axis differs on that axis, and on no other."""
    assert np.isfinite(first).all() and np.isfinite(second).all()
    differs = [not np.array_equal(one, other) for one, other in zip(first.T, second.T, strict=True)]
    assert differs[axis], "both values are the same to this drive"
    assert sum(differs) == 1, f"axis {axis} alone has another value: {differs}"


def check_every_object_is_varied(device, rows, elsewhere, idle=frozenset()):
    """Hold that each writable object of axis 0 is in the rows, in another test, or without effect, and in one alone.

    Those of communication (1000h to 1FFFh) have their own tests.
    """
    varied = {name if isinstance(name, tuple) else (name, 0) for name in rows}
    writable = {
        (entry.index, entry.sub)
        for entry in device.new_dictionary()
        if entry.access in ("rw", "rww", "wo")
        and entry.index >= 0x2000
        and device.locate(entry.index)[1] == entry.index
    }
    idle = writable & set(idle)
    assert writable == varied | set(elsewhere) | idle
    assert not varied & set(elsewhere) and not idle & (varied | set(elsewhere))
