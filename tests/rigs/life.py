"""A life of a set of drives: every mode, a fault, homing."""

from __future__ import annotations

import dataclasses
import math
import warnings

import numpy as np
import pytest

from drive_env import EmulatedDrives, motion
from drive_env.devices import find_device
from drive_env.dictionary.access import ObjectAccessError
from drive_env.dictionary.roles import Role
from drive_env.drives.currents import ampere_per_count, to_counts
from drive_env.drives.speeds import per_increment
from drive_env.emulator.inertia_check import MAX_INERTIA_RATIO, MisfitWarning
from drive_env.firmware.common.modes import MODES
from drive_env.firmware.record import get_lanes
from drive_env.motors import MOTORS
from mechanics.loads import find_load
from mechanics.model import read_model
from mechanics.packed import PackedLoad
from mechanics.shaft import shaft_load

SPEED = 4  # rev/s: slow for all of these motors, short ways for a load with end stops
ENABLED, FAULT, DISABLED = (0x6F, 0x27), (0x4F, 0x08), (0x4F, 0x40)
BEFORE_SWITCH = 0.1  # where a life begins before the left switch of an axis, if there is one [m]


def life_of(load):
    """Return a load where its life begins, the way at the switches per rotor's radian, and whether it swings.

    What swings goes on when the drives stand still.
    """
    row = find_load(load)
    model = read_model(row)
    joints = [model.joint(k).name for k in range(model.nv)]
    matrix = lambda motions: np.array([[way.get(joint, 0.0) for joint in joints] for way in motions])  # noqa: E731
    rigid = matrix([contact.motion for contact in row.contacts if contact.transmits]).reshape(-1, model.nv)
    rigid = np.vstack([rigid, np.eye(model.nv)[model.jnt_stiffness > 0.0]])
    packed = PackedLoad(row, np.ones((1, row.num_axes)), np.zeros((1, row.num_axes, 4)), {}, 1e-6)
    led = np.vstack([packed.plant.axis_motion, rigid])
    turning = np.linalg.pinv(led)[:, : row.num_axes]
    per_radian = np.diag(packed.plant.axis_position @ turning)
    left = [switch.high for switch in row.switches if switch.kind == "left"]
    if left:
        begin = turning @ ((np.array(left) + BEFORE_SWITCH) / per_radian)
        row = dataclasses.replace(row, start=dict(zip(joints, begin.tolist(), strict=True)))
    return row, per_radian, np.linalg.matrix_rank(led) < model.nv


class Demand:
    """What a load asks of a motor on a drive: the worst of its axes, in the motor's measures."""

    def __init__(self, device, load, motor):
        row, motor = find_load(load), MOTORS[motor]
        axes = (1, row.num_axes)
        bearing = np.broadcast_to([motor.coulomb, motor.coulomb, 1.0, 0.0], (*axes, 4))
        at_shaft = shaft_load(PackedLoad(row, np.full(axes, motor.inertia), bearing, {}, 200e-6))
        self.torque = (at_shaft.gravity + at_shaft.friction).max() / find_device(device).torque_of(motor)
        rotors = at_shaft.inertia / motor.inertia
        self.ratio = rotors.max()
        self.is_warned_of = bool(self.torque > 1.0 or self.ratio > MAX_INERTIA_RATIO)
        total = (1.0 + rotors) / 3.0
        self.suits = bool(total.min() >= 0.25 and total.max() <= 4.0 and self.torque <= 0.5)


def build(device, load, motor, num_machines, **options):
    """Return drives and whether their construction warned of a misfit."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        drives = EmulatedDrives(device, load, motor, num_machines, **options)
    assert all(each.category is MisfitWarning for each in caught), caught
    return drives, len(caught) > 0


class Life:
    """A life of a set of drives: fixed times, so that sets of any size live alike; `seen` is what a bus shows."""

    OBJECTS = (0x6041, 0x6061, 0x6064, 0x606C, 0x6062, 0x6077, Role.MOTOR_FLAGS, 0x60FD)  # those that it has

    def __init__(self, device, load, motor, num_machines):
        row, per_radian, self.swings = life_of(load)
        self.drives, warned = build(device, row, motor, num_machines, seed=3, num_threads=1)
        self.demand = Demand(device, load, motor)
        assert warned == self.demand.is_warned_of
        self.suits = self.demand.suits
        self.per_radian = np.tile(per_radian, num_machines)
        # As gravity demands: what hangs must not fall while a stage is off.
        self.drives.machine.brake = "with_stage" if self.demand.torque <= 1.0 else "closed"
        self.turn = int(self.drives.read(Role.POSITION_SCALE)[0])
        self.counts = per_increment(self.drives, 0x606C)  # per inc/s
        self.speed = np.rint(SPEED * self.turn * self.counts).astype(int)
        ramp = SPEED * self.turn * per_increment(self.drives, 0x6083) / self.drives.read(0x6083)
        self.ramp = math.ceil(1000 * np.max(ramp)) / 1000  # s, to that speed
        self.modes = self.drives.device.allowed_values.get((0x6060, 0), tuple(mode.number for mode in MODES))
        known = self.drives.device.new_dictionary()
        self.objects = [name for name in self.OBJECTS if known.has(name)]
        self.seen = []

    def run(self, duration, play=None):
        trace = self.drives.record(self.objects, duration, play)
        self.seen.append(np.stack([trace[name] for name in self.objects]))
        return trace

    def rows(self, start, end):
        """Return 100 rows of set-points, from one evenly to the other."""
        return np.rint(np.linspace(start, np.broadcast_to(end, self.drives.num_axes), 100)).astype(int)

    def slip(self):
        """Return by how much the rotor is off the drive's position [rev]."""
        return self.drives.machine.rotor_angle / (2 * math.pi) - self.drives.read(0x6064) / self.turn

    def in_state(self, pattern):
        return np.all(self.drives.read(0x6041) & pattern[0] == pattern[1])

    def mode(self, abbreviation):
        number = next(mode.number for mode in MODES if mode.abbreviation == abbreviation)
        self.drives.write(0x6060, number)
        own = self.drives.device.mode_gate.get(number)
        if own is not None:
            self.drives.write(Role.MODE_GATE, own)
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
        preset = drives.device.preset(drives.motor)
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
        self.drives.write(0x607A, start + self.turn // 4)
        self.drives.write(0x6040, 0x1F)
        self.run(0.002)
        assert np.all(self.drives.read(0x6041) & 0x1000)
        self.drives.write(0x6040, 0x0F)
        trace = self.run(0.5)
        moved = self.drives.read(0x6064) - start
        assert np.all(moved > self.turn // 16)
        if self.suits:
            # Reached once; friction and cogging may make an axis hunt about the window afterwards.
            assert np.all(np.any(trace[0x6041] & 0x0400, axis=0))
            assert np.all(np.abs(moved - self.turn // 4) < self.turn / 131)

    def pv(self):
        """Up to speed by the ramp of 6083h, and to rest."""
        self.mode("pv")
        self.drives.write(0x60FF, self.speed)
        trace = self.run(max(0.25, self.ramp + 0.1))
        assert np.all(self.drives.read(0x6041) & 0x0400)
        demanded = np.diff(trace[0x6062][-100:], axis=0) * 1000
        assert np.all(np.abs(demanded - SPEED * self.turn) <= 1000)
        assert np.all(np.mean(trace[0x606C], axis=0) > 0)
        if self.suits:
            np.testing.assert_allclose(np.mean(trace[0x606C][-50:], axis=0), self.speed, rtol=0.15)
        self.drives.write(0x60FF, 0)
        self.run(max(0.2, self.ramp + 0.05))

    def csp(self, mode="csp", target=0x607A):
        """Back by half a turn, a set-point each millisecond."""
        self.mode(mode)
        start = self.drives.read(0x6062)
        # As a controller plans it: a step of the speed would be too much for a motor without a loop.
        share = np.minimum(np.arange(300) / 200, 1.0)
        way = -share * share * (3.0 - 2.0 * share) * self.turn // 2
        trace = self.run(0.3, {target: (start + way[:, None]).astype(np.int64)})
        # Row k is written, then recorded, then acted on.
        assert np.all(np.abs(trace[0x6062][1:] - start - way[:-1, None]) <= 1)
        assert np.all(trace[0x6041][10:] & 0x1000)
        assert np.all(self.drives.read(0x6064) < start)
        if self.suits:
            assert np.all(np.abs(self.drives.read(0x6064) - trace[0x6062][-1]) < self.turn // 16)

    def csv(self):
        self.mode("csv")
        self.run(0.1, {0x60FF: self.rows(0, -self.speed)})
        moved = self.run(0.1, {0x60FF: self.rows(-self.speed, -self.speed)})[0x606C]
        assert np.all(np.mean(moved, axis=0) < 0)
        self.run(0.1, {0x60FF: self.rows(-self.speed, 0)})
        self.run(0.1, {0x60FF: self.rows(0, 0)})
        if self.suits:
            np.testing.assert_allclose(np.mean(moved, axis=0), -self.speed, rtol=0.2)

    def ip(self):
        """As csp, by the object of its own (60C1h:01)."""
        self.csp("ip", (0x60C1, 1))

    def tq(self):
        """As cst."""
        self.cst("tq")

    def cst(self, mode="cst"):
        """A tenth of the rated current, but at least one that the measurement resolves; then none."""
        self.close_loop(1)
        self.mode(mode)
        ampere = ampere_per_count(self.drives)
        current = max(0.1 * self.drives.motor.rated_current, 0.3)
        trace = self.run(
            0.02, {0x6071: np.tile(to_counts(self.drives, np.full(self.drives.num_axes, current)), (20, 1))}
        )
        # The integrator follows the back-EMF of a motor that speeds up: the current lags.
        assert np.all(np.abs(np.mean(trace[0x6077][5:], axis=0) * ampere - current) < 0.25 * current + 0.06)
        trace = self.run(0.02, {0x6071: np.zeros(20, int)})
        assert np.all(np.abs(np.mean(trace[0x6077][5:], axis=0) * ampere) < 0.1 * current + 0.06)

        self.close_loop(0)

    def close_loop(self, mode):
        """Let a stepper's encoder commutate, without which it makes no torque that is asked for; others do always."""
        if Role.LOOP_MODE not in self.drives.device.roles:
            return
        self.mode("pp")
        self.drives.write(0x606A, 0 if mode else -1)
        self.drives.write(Role.LOOP_MODE, mode)
        self.run(1.0)
        assert np.all(self.drives.read(Role.LOOP_INITIALISED) == mode)

    def no_mode(self):
        """Mode 0 brings a turning axis to rest and holds it there."""
        self.mode("pv")
        self.drives.write(0x60FF, self.speed)
        self.run(0.1)
        self.mode("no")
        trace = self.run(0.3)
        if not self.swings:
            assert np.all(np.abs(np.mean(trace[0x606C][-100:], axis=0)) < self.speed / 20)
        elif self.suits:  # what falls or swings pushes it about where it is held
            assert np.all(np.abs(trace[0x6064] - trace[0x6062])[-100:] < self.turn // 4)
        assert np.all(np.ptp(trace[0x6062][-100:], axis=0) == 0)

    def hm(self):
        """Method 35: here is home."""
        self.mode("hm")
        self.drives.write(0x6098, 35)
        self.drives.write(0x6040, 0x1F)
        self.run(0.002)
        assert np.all(self.drives.read(0x6041) & 0x3400 == 0x1400)
        assert np.all(np.abs(self.drives.read(0x6064)) < self.turn // 16)
        self.drives.write(0x6040, 0x0F)
        self.run(0.05)

    def fault_and_reset(self):
        drives = self.drives
        assert drives.emergencies() == []
        drives.machine.enable_input = False
        self.run(0.003)
        assert self.in_state(FAULT)
        row = next(row for name, row in drives.device.emergencies.items() if name in ("shutdown_switch", "sto"))
        assert [(m.axis, m.code) for m in drives.emergencies()] == [(k, row.code) for k in range(drives.num_axes)]
        for name in {"i_q", "i_a", "i_b"} & set(drives.inside.records.dtype.names):  # of a servo, of a stepper
            assert np.all(get_lanes(drives.inside.records, name, drives.num_axes) == 0.0), name
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
        ratio, rated = np.abs(self.per_radian), drives.motor.rated_speed
        least = 2 * math.pi * SPEED  # steppers turn slowly, and all of their torque is there at standstill
        fast = np.minimum(max(0.3 * rated, least), 0.25 / ratio)
        slow = np.minimum(max(0.05 * rated, least / 8), 0.02 / ratio)
        drives.write(0x6098, 17)
        drives.write((0x6099, 1), np.rint(fast / (2 * math.pi) * self.turn * self.counts).astype(int))
        drives.write((0x6099, 2), np.rint(slow / (2 * math.pi) * self.turn * self.counts).astype(int))
        drives.write(0x609A, drives.read(0x6083))
        motion.select_mode(drives, "hm")
        drives.write(0x6040, 0x1F)
        ramp = self.ramp * fast / least  # s; there and back, then over the edge and back, each with as much to spare
        way = BEFORE_SWITCH / ratio
        self.run(max(2.5, math.ceil(np.max(way / fast + 2 * ramp + fast * ramp / slow + 0.5))))
        status = drives.read(0x6041)
        assert np.all(status & 0x2400 == 0x0400)
        assert np.all(status & 0x1000)
        position = get_lanes(drives.inside.records, "load_position", drives.num_axes)
        home = position - drives.read(0x6064) / self.turn * 2 * math.pi * self.per_radian
        # The edge is seen once per millisecond; belt, nut and bridge give a little.
        np.testing.assert_allclose(home, switch.high, atol=(slow * ratio).max() * 1.5e-3 + 1e-4)
        if self.suits:
            assert np.all(np.abs(position - switch.high) < 2e-3)

    def whole(self):
        drives = self.drives
        self.commission()
        motion.enable(drives)
        assert self.in_state(ENABLED)
        if self.demand.torque <= 1.0:
            stations = {"no": self.no_mode, "pp": self.pp, "pv": self.pv, "hm": self.hm}
            stations |= {"csp": self.csp, "csv": self.csv, "cst": self.cst, "ip": self.ip, "tq": self.tq}
            # Zero last: it is the mode that stops.
            for mode in sorted(MODES, key=lambda mode: mode.number == 0):
                if mode.number not in self.modes:
                    with pytest.raises(ObjectAccessError):
                        drives.write(0x6060, mode.number)
                    continue
                before = self.slip()
                stations[mode.abbreviation]()
                if self.suits and not self.swings and mode.abbreviation != "hm":
                    # No step of the motor, nor a count of the encoder, is lost: four full steps are 0.02 rev.
                    assert np.all(np.abs(self.slip() - before) < 0.01), mode
                assert self.in_state(ENABLED), mode
                assert drives.emergencies() == [], mode
        self.fault_and_reset()
        if drives.load.has_switches and self.demand.torque <= 1.0:
            self.home_on_a_switch()
            assert self.in_state(ENABLED)
        motion.disable(drives)
        self.run(0.01)
        assert drives.emergencies() == []
        assert not np.any(drives.machine.diverged)
        self.readable()
        drives.close()
        return np.concatenate(self.seen, axis=1)
