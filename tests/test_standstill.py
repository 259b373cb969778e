"""Winding resistance from readings at rest: with any dead time, and over a bus whose time goes on while it is read."""

from dataclasses import replace

import numpy as np
import pytest
from test_parity import served

from drive_env.dictionary.roles import Role
from tuning.identify.identification import identify
from tuning.identify.standstill import standstill_resistances
from tuning.identify.working_state import working_state
from tuning.target import Target, emulated


def at_rest(target):
    with working_state(target) as working:
        return standstill_resistances(working)


def test_dead_time_of_any_kind_is_in_the_interval():
    """The ends of what a bridge may have: 100 and 700 ns, that fade below 0.1 and 0.8 A."""
    ends = [(dead, fades) for dead in (100e-9, 700e-9) for fades in (0.1, 0.8)]
    machines = {"stage.dead_time": [dead for dead, _ in ends], "stage.dead_time_current": [fades for _, fades in ends]}
    target = emulated(load="inertia", num_machines=4, parameters=machines, num_threads=1)
    for found, true in zip(at_rest(target), target.drives.machine.parameters["motor.R_s"], strict=True):
        assert found.low < true < found.high
        assert found.value == pytest.approx(true, rel=0.03)
        assert found.high - found.low < 0.1 * true


def test_drives_are_left_as_they_were_and_nothing_has_turned_far():
    target = emulated(load="inertia", num_threads=1)
    before = [int(target.drives.read(name)[0]) for name in (Role.COMMUTATION, Role.OPEN_LOOP_CURRENT)]
    at_rest(target)
    assert [int(target.drives.read(name)[0]) for name in (Role.COMMUTATION, Role.OPEN_LOOP_CURRENT)] == before
    # The field pulls the rotor to itself, half an electrical turn at most, and swings.
    assert abs(float(target.drives.machine.rotor_angle[0])) < 1.5 * np.pi / target.motor.n_p


def test_a_rotor_that_slips_says_nothing():
    target = emulated(load="inertia", num_threads=1)
    target.drives.machine.load_torque = 0.7 * target.current * target.motor.torque_constant
    assert "slipped" in at_rest(target)[0].reason or "switched off" in at_rest(target)[0].reason


@pytest.mark.parametrize("current", [0.5, 2.0])
def test_currents_that_dead_time_swallows_are_too_weak(current):
    """Without what dead time may be in the interval, R would be told a third too high here."""
    ends = {"stage.dead_time": [100e-9, 700e-9], "stage.dead_time_current": [0.1, 0.8]}
    target = emulated(load="inertia", current=current, num_machines=2, parameters=ends, num_threads=1)
    assert all("too weak" in found.reason for found in at_rest(target))


def test_a_brushed_motor_would_turn():
    target = emulated(load="inertia", motor="re_35", num_threads=1)
    assert "a brushed motor turns with its current" in at_rest(target)[0].reason


class Uneven:
    """Drives in real time: a read takes now one, now two, now three cycles, and the clock of `winding` sees it."""

    time_waits = False

    def __init__(self, drives):
        self._drives, self.reads, self.now = drives, 0, 0.0

    def read(self, name):
        self.reads += 1
        self._drives.advance(0.001 * (1 + self.reads % 3))
        return self._drives.read(name)

    def record(self, objects, duration, *arguments, **options):
        self.now += duration + 0.002
        return self._drives.record(objects, duration, *arguments, **options)

    def perf_counter(self):
        return self.now

    def __getattr__(self, name):
        return getattr(self._drives, name)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 4])
def test_over_a_bus_in_real_time_resistance_is_told_and_inductance_refused(monkeypatch, seed):
    """R within 10 % over the bus; L is seen in step with the drive alone."""
    with served("calls", load="inertia", seed=seed, randomise=["stage", "motor"]) as bus:
        own = emulated(load="inertia", seed=seed, randomise=["stage", "motor"], num_threads=1)
        drives = Uneven(bus)
        monkeypatch.setattr("tuning.identify.winding.time", drives)
        target = Target(drives, own.device, own.motor, own.supply, own.low, own.high, own.speed, own.current)
        found = identify(replace(target))[0]
        true = float(own.drives.machine.parameters["motor.R_s"][0])
    resistance = found.estimates["resistance"]
    assert resistance.value == pytest.approx(true, rel=0.1)
    assert resistance.low < true < resistance.high
    assert not found.estimates["inductance"].is_known
    assert "can only be read by SDO" in found.estimates["inductance"].reason
