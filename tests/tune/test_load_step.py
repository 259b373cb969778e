"""The load step of a certificate against what the integrators of a cascade leave no choice about."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from rigs.chip_gains import Gains

from drive_env import motion
from drive_env.devices.gains import gains_in_si
from drive_env.drives.raw_gains import write_gains
from mechanics.shaft import one, way
from tuning.auto import moves as module
from tuning.auto.moves import BEFORE, NAME, load_step
from tuning.target import emulated

TURN = 2.0 * np.pi
DIP, RECOVERY = "greatest dip of the rotor [turns]", "recovery to within 5 % of the dip [ms]"
SOFT, STIFF = Gains(4021, 1573, 600, 1200, 300), Gains(4021, 1573, 900, 1800, 500)


@pytest.fixture
def target():
    with emulated(load="inertia", num_machines=3, ideal=True, friction="none") as made:
        write_gains(made.drives, np.array([SOFT, STIFF, STIFF]))
        yield made


def test_the_error_adds_up_to_what_the_gains_say(target):
    """A load that takes the current i leaves the integral of the position error at i T_i / (P k_v)."""
    found = load_step(target, np.array([True, True, False]))
    assert set(found) == {0, 1}
    i = 0.3 * target.motor.rated_torque / target.motor.torque_constant
    for axis, gains in ((0, SOFT), (1, STIFF)):
        step = found[axis]
        si = gains_in_si(target.device, 24.0, gains)
        expected = i * si.velocity_integration / (si.velocity_p * si.position_p)
        after = step.t >= BEFORE
        assert abs(np.sum(step.actual[after]) * 1e-3) == pytest.approx(expected, rel=0.05)
        assert np.mean(step.current[-50:]) - np.mean(step.current[:20]) == pytest.approx(i, rel=0.1)
        assert step.figures[DIP] == pytest.approx(np.abs(step.actual[after]).max() / TURN, rel=0.02)
        assert step.tuned and step.name == NAME and step.unit == "rad"
    dips = [found[axis].figures[DIP] for axis in (0, 1)]
    assert dips[1] < 0.7 * dips[0]


@pytest.mark.parametrize(("load", "gains"), [("inertia", STIFF), ("belt", Gains(5580, 1579, 1099, 1845, 395))])
def test_dip_and_recovery_are_those_of_the_rotor_in_the_emulator(load, gains):
    """Without an encoder: the same load step by hand, the angle that the physics has every millisecond."""
    with emulated(load=load, num_machines=2, num_threads=1) as target:
        drives, machine = target.drives, target.drives.machine
        write_gains(drives, np.array([gains, gains]))
        found = load_step(target, np.ones(2, bool))[0].figures
        motion.enable(drives, mode="pp")
        drives.advance(0.1)
        rest = machine.rotor_angle[1]
        packed = one(machine.drives.load)
        lever = abs(float((way(packed).joints @ packed.plant.disturbance[:, 0])[0]))
        machine.load_torque = np.full(2, -0.3 * target.motor.rated_torque / lever)
        angle = []
        for _ in range(300):
            drives.advance(1e-3)
            angle.append(abs(machine.rotor_angle[1] - rest))
    dip = max(angle)
    away = np.flatnonzero(np.array(angle) > 0.05 * dip)[-1] + 2.0  # [ms]
    assert found[DIP] == pytest.approx(dip / TURN, rel=0.1, abs=2.0 / target.motor.encoder_counts)
    assert found[RECOVERY] == pytest.approx(away, rel=0.15, abs=3.0)


def test_the_machines_are_left_alone_afterwards(target):
    load_step(target, np.ones(3, bool))
    assert target.drives.machine.load_torque.tolist() == [0.0, 0.0, 0.0]
    assert np.all(target.drives.read(0x6041) & 0x6F != 0x27)
    assert load_step(target, np.zeros(3, bool)) == {}


# --- by hand, on machines that a test plays ---------------------------------------------------------------------------
class Played:
    """Two machines of two axes, of which the last axis is on: what is done to them is noted, in its order."""

    bus = None

    def __init__(self, swings):
        self.log, self.swings = [], list(swings)
        log = self.log

        class Machine:
            load = "belt"

            def __setattr__(self, name, value):
                log.append((name, np.round(value, 9).tolist()))

        self.machine = Machine()

    def read(self, name):
        return np.array([0x0240, 0x0240, 0x0240, 0x0637])

    def advance(self, seconds):
        self.log.append(("wait", seconds))

    def record(self, objects, seconds):
        rows = round(seconds / 1e-3)
        self.log.append(("record", rows))
        t = np.arange(rows)
        sign = np.where(np.arange(rows) % 2, 1.0, -1.0)
        position, current = np.full((rows, 4), 100.0), np.full((rows, 4), 50.0)
        if rows == 300:
            position[1:] += 20.0 * np.exp(-t[:-1] / 50.0)[:, None] * [1, 2, 3, 4]
            # It creeps, and at the end of the record it swings.
            current[:] += 0.5 * t[:, None] + self.swings.pop(0) * np.where(t >= 200, sign, 30.0 * sign)[:, None]
        return {POSITION: position, CURRENT: current}


POSITION, CURRENT = 0x6064, 0x6077


@pytest.fixture
def played(monkeypatch):
    """Make load steps on such machines; a count of current is 10 mA, the rated one 2 A, the longest lever 0.5."""

    def step(where, swings=(1.0, 1.0, 1.0, 1.0)):
        drives = Played(swings)
        monkeypatch.setattr(module, "ampere_per_count", lambda drives: 0.01)
        monkeypatch.setattr(module, "machine_of", lambda drives: drives.machine)
        monkeypatch.setattr("mechanics.shaft.one", lambda load: SimpleNamespace(
            plant=SimpleNamespace(disturbance=np.array([[1.0, 9.0]]))
        ))  # fmt: skip
        monkeypatch.setattr("mechanics.shaft.way", lambda packed: SimpleNamespace(joints=np.array([[0.2], [-0.5]])))
        for name in ("enable", "disable"):
            monkeypatch.setattr(
                module.motion, name,
                lambda drives, where, mode=None, name=name: drives.log.append((name, mode, where.tolist())),
            )  # fmt: skip
        target = SimpleNamespace(
            drives=drives, num_axes=4, axes_per_machine=2, increments=lambda: np.full(4, 10.0),
            motor=SimpleNamespace(rated_torque=0.1, rated_current=2.0),
        )  # fmt: skip
        return module.load_step(target, np.array(where)), drives.log

    return step


def test_a_load_comes_and_goes_both_ways_on_machines_all_of_whose_axes_are_chosen(played):
    """0.3 of the rated torque at the axis with the longest lever; who was on stays on."""
    found, log = played([True, False, True, True])
    assert set(found) == {2, 3}
    yes = [False, False, True, True]
    steps = [entry for load in (-0.06, 0.0, 0.06, 0.0) for entry in (("load_torque", [0.0, load]), ("record", 300))]
    assert log == [
        ("enable", "pp", yes), ("wait", 0.1), ("record", 20), *steps, ("load_torque", 0.0), ("wait", 0.1),
        ("disable", None, [False, False, True, False]),
    ]  # fmt: skip
    assert played([True, False, False, True]) == ({}, [])


@pytest.mark.parametrize("worst", range(4))
def test_what_is_recorded_is_the_first_step_and_the_swing_the_worst_of_all_rests(played, worst):
    """Of the last 100 ms, about a straight line: 2 counts of 10 mA, of 2 A."""
    swings = [1.0] * 4
    swings[worst] = 2.0
    found, _ = played([False, False, True, True], swings)
    step = found[3]
    np.testing.assert_allclose(step.t, np.arange(320) * 1e-3)
    np.testing.assert_allclose(step.actual[:21], 0.0)
    np.testing.assert_allclose(step.actual[21:], 8.0 * np.exp(-np.arange(299) / 50.0), atol=1e-6)
    np.testing.assert_allclose(step.current[:20], 0.5)
    assert step.current[-1] == pytest.approx(0.01 * (50.0 + 0.5 * 299.0 + swings[0]))
    assert step.figures["current at rest afterwards, RMS [% of rated]"] == pytest.approx(1.0, rel=1e-3)
    assert step.figures[DIP] == pytest.approx(8.0 / TURN)
    assert step.figures[RECOVERY] == pytest.approx(1.0 + 50.0 * np.log(20.0), abs=0.1)
    assert (step.name, step.tuned, step.unit) == ("load step of 0.3 rated torque at standstill", True, "rad")
    assert not step.reference.any() and len(step.reference) == 320


def test_the_load_is_taken_away_and_the_axes_switched_off_whatever_happens(played, monkeypatch):
    monkeypatch.setattr(Played, "record", lambda self, objects, seconds: 1 // 0)
    log = []
    monkeypatch.setattr(Played, "advance", lambda self, seconds: log.append(self.log))
    with pytest.raises(ZeroDivisionError):
        played([True, True, False, False])
    assert log[-1][-2:] == [("load_torque", 0.0), ("disable", None, [True, True, False, False])]
