"""The contract: every device turns every load with every motor through a whole life; a new row joins by being a row.

For all combinations: the protocol (states, mode display, fault and reset, homing's outcome), no emergency but the one
that is caused, no divergence, every object readable as an integer in its range, currents as commanded, motion the right
way, and machine 0 the same in any set. How closely a motion follows is asserted where the motor suits the load, by the
numbers of the rows: the total inertia within a factor of four of the three rotors that the presets were made for, and
dry friction below half the rated torque.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from drive_env import EmulatedDrives, motion
from drive_env.devices import device_names, find_device
from drive_env.firmware.modes import MODES
from drive_env.firmware.record import get_lanes
from drive_env.motors import MOTORS
from mechanics.loads import LOADS

TURN = 65536
SPEED = 4 * TURN  # pps: slow for all of these motors, short ways for a load with end stops
ENABLED, FAULT, DISABLED = (0x6F, 0x27), (0x4F, 0x08), (0x4F, 0x40)
ROWS = [(device, load, motor) for device in device_names() for load in LOADS for motor in MOTORS]


def suits(drives):
    """Return whether the presets' assumptions hold for this motor on this load."""
    motor, parameters = drives.motor, {name: values[0] for name, values in drives.machine.parameters.items()}
    gear = drives.load.gears[0] if drives.load.gears else 1.0
    if not {"load.inertia", "load.mass"} & set(parameters):
        return False
    inertia = motor.inertia + parameters.get("load.inertia", 0.0) + parameters.get("load.mass", 0.0) / gear**2
    friction = motor.coulomb + parameters.get("load.breakaway", 0.0) / gear
    return 0.25 <= inertia / (3.0 * motor.inertia) <= 4.0 and friction <= 0.5 * motor.rated_torque


class Life:
    """A life of a set of drives: fixed times, so that sets of any size live alike; `seen` is what a bus shows."""

    OBJECTS = (0x6041, 0x6061, 0x6064, 0x606C, 0x6062, 0x6077, 0x2101, 0x60FD)

    def __init__(self, device, load, motor, num_machines):
        self.drives = EmulatedDrives(device, load, motor, num_machines, seed=3, num_threads=1)
        self.suits = suits(self.drives)
        self.seen = []

    def run(self, duration, play=None):
        trace = self.drives.record(self.OBJECTS, duration, play)
        self.seen.append(np.stack([trace[name] for name in self.OBJECTS]))
        return trace

    def in_state(self, pattern):
        return np.all(self.drives.read(0x6041) & pattern[0] == pattern[1])

    def mode(self, abbreviation):
        number = next(mode.number for mode in MODES if mode.abbreviation == abbreviation)
        self.drives.write(0x6060, number)
        self.run(0.002)
        assert np.all(self.drives.read(0x6061) == number)

    def readable(self):
        """Every object reads as an integer of its range."""
        for entry in self.drives.device.new_dictionary():
            if entry.access == "wo" or isinstance(entry.default, str):
                continue
            value = self.drives.read((entry.index, entry.sub))
            assert value.dtype == np.int64, entry.label
            assert np.all((entry.low <= value) & (value <= entry.high)), entry.label

    # --- the stations of a life -----------------------------------------------------------------------------------
    def commission(self):
        drives = self.drives
        assert self.in_state(DISABLED)
        preset = drives.device.preset(drives.motor.name)
        assert preset
        for name, value in preset.items():
            assert np.all(drives.read(name) == value), name
        self.run(0.02)
        assert self.in_state(DISABLED)
        self.readable()

    def pp(self):
        """A quarter turn: reached, or the right way at least."""
        self.mode("pp")
        start = self.drives.read(0x6064)
        self.drives.write(0x607A, start + TURN // 4)
        self.drives.write(0x6040, 0x1F)
        self.run(0.002)
        assert np.all(self.drives.read(0x6041) & 0x1000)
        self.drives.write(0x6040, 0x0F)
        trace = self.run(0.5)
        moved = self.drives.read(0x6064) - start
        assert np.all(moved > TURN // 16)
        if self.suits:
            # Reached once; friction and cogging may make an axis hunt about the window afterwards.
            assert np.all(np.any(trace[0x6041] & 0x0400, axis=0))
            assert np.all(np.abs(moved - TURN // 4) < 500)

    def pv(self):
        """Up to speed by the ramp of 6083h, and to rest."""
        self.mode("pv")
        self.drives.write(0x60FF, SPEED)
        trace = self.run(0.25)
        assert np.all(self.drives.read(0x6041) & 0x0400)
        demanded = np.diff(trace[0x6062][-100:], axis=0) * 1000
        assert np.all(np.abs(demanded - SPEED) <= 1000)
        assert np.all(np.mean(trace[0x606C], axis=0) > 0)
        if self.suits:
            np.testing.assert_allclose(np.mean(trace[0x606C][-50:], axis=0), SPEED, rtol=0.15)
        self.drives.write(0x60FF, 0)
        self.run(0.2)

    def csp(self):
        """Back by half a turn, a set-point each millisecond."""
        self.mode("csp")
        start = self.drives.read(0x6062)
        way = -np.minimum(np.arange(300) / 200, 1.0) * TURN // 2
        trace = self.run(0.3, {0x607A: (start + way[:, None]).astype(np.int64)})
        # Row k is written, then recorded, then acted on.
        assert np.all(np.abs(trace[0x6062][1:] - start - way[:-1, None]) <= 1)
        assert np.all(trace[0x6041][10:] & 0x1000)
        assert np.all(self.drives.read(0x6064) < start)
        if self.suits:
            assert np.all(np.abs(self.drives.read(0x6064) - trace[0x6062][-1]) < TURN // 16)

    def csv(self):
        self.mode("csv")
        self.run(0.1, {0x60FF: np.full(100, -SPEED)})
        moved = self.run(0.1, {0x60FF: np.full(100, -SPEED)})[0x606C]
        assert np.all(np.mean(moved, axis=0) < 0)
        self.run(0.2, {0x60FF: np.zeros(200, int)})
        if self.suits:
            np.testing.assert_allclose(np.mean(moved, axis=0), -SPEED, rtol=0.2)

    def cst(self):
        """A tenth of the rated current, but at least one that the measurement resolves; then none."""
        self.mode("cst")
        current = max(100.0 * self.drives.motor.rated_current, 300.0)  # mA
        trace = self.run(0.02, {0x6071: np.full(20, round(current))})
        # The integrator follows the back-EMF of a motor that speeds up: the current lags.
        assert np.all(np.abs(np.mean(trace[0x6077][5:], axis=0) - current) < 0.25 * current + 60.0)
        trace = self.run(0.02, {0x6071: np.zeros(20, int)})
        assert np.all(np.abs(np.mean(trace[0x6077][5:], axis=0)) < 0.1 * current + 60.0)

    def no_mode(self):
        """Mode 0 brings a turning axis to rest and holds it there."""
        self.mode("pv")
        self.drives.write(0x60FF, SPEED)
        self.run(0.1)
        self.mode("no")
        trace = self.run(0.3)
        assert np.all(np.abs(np.mean(trace[0x606C][-100:], axis=0)) < SPEED / 20)
        assert np.all(np.ptp(trace[0x6062][-100:], axis=0) == 0)

    def hm(self):
        """Method 35: here is home."""
        self.mode("hm")
        self.drives.write(0x6098, 35)
        self.drives.write(0x6040, 0x1F)
        self.run(0.002)
        assert np.all(self.drives.read(0x6041) & 0x3400 == 0x1400)
        assert np.all(np.abs(self.drives.read(0x6064)) < TURN // 16)
        self.drives.write(0x6040, 0x0F)
        self.run(0.05)

    def fault_and_reset(self):
        drives = self.drives
        assert drives.emergencies() == []
        drives.machine.enable_input = False
        self.run(0.003)
        assert self.in_state(FAULT)
        assert [(m.axis, m.code) for m in drives.emergencies()] == [(k, 0x5441) for k in range(drives.num_axes)]
        assert np.all(get_lanes(drives._records, "i_q", drives.num_axes) == 0.0)
        self.readable()
        drives.write(0x6040, 0x80)
        self.run(0.003)
        assert self.in_state(FAULT)  # the cause is still there
        drives.machine.enable_input = True
        drives.write(0x6040, 0x00)
        self.run(0.002)  # inputs are read once per millisecond
        drives.write(0x6040, 0x80)
        self.run(0.003)
        assert self.in_state(DISABLED)
        assert {m.code for m in drives.emergencies()} == {0x0000}
        self.run(0.1)
        motion.enable(drives)
        assert self.in_state(ENABLED)

    def home_on_a_switch(self):
        """Method 17 ends at the left switch's edge, at speeds that motor and travel allow."""
        drives = self.drives
        switch = next(row for row in drives.load.switches if row.kind == "left")
        gear, rated = drives.load.gears[0], drives.motor.rated_speed
        fast = min(0.3 * rated, 0.25 * gear)
        slow = min(0.05 * rated, 0.02 * gear)
        drives.write(0x6098, 17)
        drives.write((0x6099, 1), round(fast / (2 * math.pi) * TURN))
        drives.write((0x6099, 2), round(slow / (2 * math.pi) * TURN))
        drives.write(0x609A, drives.read(0x6083))
        motion.select_mode(drives, "hm")
        drives.write(0x6040, 0x1F)
        self.run(3.0)
        status = drives.read(0x6041)
        assert np.all(status & 0x2400 == 0x0400)
        assert np.all(status & 0x1000)
        position = get_lanes(drives._records, "load_position", drives.num_axes)
        home = -drives.read(0x6064) / TURN * 2 * math.pi / gear + position
        # The edge is seen once per millisecond; the belt gives a little.
        np.testing.assert_allclose(home, switch.high, atol=slow / gear * 1.5e-3 + 1e-4)
        if self.suits:
            assert np.all(np.abs(position - switch.high) < 2e-3)

    def whole(self):
        drives = self.drives
        self.commission()
        motion.enable(drives)
        assert self.in_state(ENABLED)
        stations = {"no": self.no_mode, "pp": self.pp, "pv": self.pv, "hm": self.hm}
        stations |= {"csp": self.csp, "csv": self.csv, "cst": self.cst}
        # Zero last: it is the mode that stops.
        for mode in sorted(MODES, key=lambda mode: mode.number == 0):
            stations[mode.abbreviation]()
            assert self.in_state(ENABLED), mode
            assert drives.emergencies() == [], mode
        self.fault_and_reset()
        if drives.load.has_switches:
            self.home_on_a_switch()
            assert self.in_state(ENABLED)
        motion.disable(drives)
        self.run(0.01)
        assert drives.emergencies() == []
        assert not np.any(drives.machine.diverged)
        self.readable()
        drives.close()
        return np.concatenate(self.seen, axis=1)


@pytest.mark.parametrize(("device", "load", "motor"), ROWS, ids=["-".join(row) for row in ROWS])
def test_every_device_turns_every_load_with_every_motor(device, load, motor):
    two = Life(device, load, motor, 2).whole()
    alone = Life(device, load, motor, 1).whole()
    np.testing.assert_array_equal(alone[:, :, 0], two[:, :, 0])
    assert np.any(two[:, :, 1] != two[:, :, 0])  # another machine: its noise is its own


def test_every_row_is_in_the_contract_and_most_motors_suit_a_load():
    assert len(ROWS) == len(device_names()) * len(LOADS) * len(MOTORS)
    for device in device_names():
        assert find_device(device).name == device
    for load in LOADS:
        suited = []
        for motor in MOTORS:
            with EmulatedDrives(load=load, motor=motor) as drives:
                suited.append(suits(drives))
        assert sum(suited) >= len(MOTORS) // 2, load
