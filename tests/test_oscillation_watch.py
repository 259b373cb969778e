"""What oscillates while it is experimented on is off within 50 ms; what is only shaken, or quiet, is left alone."""

import math

import numpy as np
import pytest

from drive_env import cia402
from drive_env.devices import find_device
from drive_env.dictionary.entries import ObjectDictionary
from drive_env.drives.observed import ObservedDrives
from drive_env.drives.trace import Trace
from drive_env.gains import write_gains
from tuning.identify.estimate import NAMES
from tuning.identify.identification import identify
from tuning.oscillation_watch import OscillationError, OscillationWatch, shaken
from tuning.target import emulated

GAIN_OBJECTS = find_device("tmcm1636").gains.keys

CURRENT = 0x6077
SMALL, LARGE = 100, 3000  # mA
LIMIT = np.array([3.0, 3.0])  # A


class TwoAxes:
    """Two axes whose currents are a square wave of 100 Hz: small, and large on the second from some cycle on."""

    num_axes = 2
    device = find_device("tmcm1636")

    observers = ()

    def __init__(self, begins):
        self.begins, self.now, self.off = begins, 0, []
        self._dictionary = emulated(load="inertia", num_threads=1).device.new_dictionary()

    def record(self, objects, duration, play=None, period=0.001):
        cycle = self.now + np.arange(round(duration / period))
        self.now += len(cycle)
        sign = np.where(cycle // 5 % 2 == 0, 1, -1)
        current = np.stack([sign * SMALL, sign * np.where(cycle >= self.begins, LARGE, SMALL)], axis=1)
        assert isinstance(self._dictionary, ObjectDictionary)
        return Trace(np.arange(len(cycle)) * period, {(CURRENT, 0): current}, self._dictionary)

    def write(self, name, value, where=None):
        self.off.append((self.now, name, value, where.tolist()))


def watched(begins, where=(True, True)):
    own = TwoAxes(begins)
    watch = OscillationWatch(np.array(where), LIMIT)
    return own, ObservedDrives(own, watch), watch


@pytest.mark.parametrize("begins", [0, 1, 24, 25, 26, 40, 310])
@pytest.mark.parametrize("cycles", [1, 7, 400])  # of one call
def test_an_axis_that_oscillates_has_no_voltage_within_50_ms(begins, cycles):
    own, drives, watch = watched(begins)
    for _ in range(400 // cycles):
        drives.record([CURRENT], cycles * 0.001)
    [(at, name, value, where)] = own.off
    assert (name, value, where) == (0x6040, 0, [False, True])
    assert begins < at <= begins + 50
    assert watch.swung.tolist() == [False, True]


def test_once_all_axes_that_matter_have_oscillated_nothing_goes_on():
    own, drives, _watch = watched(30, where=(False, True))
    with pytest.raises(OscillationError):
        drives.advance(1.0)
    assert own.now <= 80


def test_what_is_quiet_is_recorded_as_without_a_watch():
    own, drives, _watch = watched(10**6)
    trace = drives.record([CURRENT], 0.09)
    other = TwoAxes(10**6).record([CURRENT], 0.09)
    assert trace.t == pytest.approx(other.t)
    assert (trace[CURRENT] == other[CURRENT]).all()
    assert own.off == []


def test_a_current_that_is_asked_for_is_no_oscillation_until_it_is_exceeded():
    own, drives, _watch = watched(0)
    with shaken(drives, np.array([3.1, 3.1])):
        drives.record([CURRENT], 0.5)
    assert own.off == []
    with pytest.raises(OscillationError), shaken(drives, np.array([0.05, 2.9])):
        drives.record([CURRENT], 0.5)


# --- identification ---------------------------------------------------------------------------------------------------
WILD = np.array([[30000, 30000, 32000, 20000, 30000]])
# A soft shaft, and a filter that lags at its resonance: velocity loops that are cautious on other axes swing on it.
SWINGING = {
    "load.inertia": 2.25e-5, "load.stiffness": 3.0, "load.damping": 2.8e-4, "load.coulomb": 5.6e-4,
    "load.viscous": 1e-7, "stage.velocity_filter": 169.0,
}  # fmt: skip


def test_a_motor_that_is_not_the_one_named_oscillates_and_is_said():
    """A data sheet with forty times the inertia makes gains that no rotor of this size stands."""
    from dataclasses import replace

    target = emulated(load="inertia", num_threads=1)
    write_gains(target.drives, WILD)
    wrong = replace(target, motor=target.motor._replace(inertia=40.0 * target.motor.inertia))
    found = identify(wrong)[0]
    assert "oscillated" in found.estimates["inertia"].reason
    assert "off within 50 ms" in found.estimates["resonance"].reason
    assert [int(target.drives.read(name)[0]) for name in GAIN_OBJECTS] == WILD[0].tolist()
    assert not cia402.matches(target.drives.read(0x6041)[0], cia402.OPERATION_ENABLED)
    assert set(found.estimates) == set(NAMES)


def test_an_axis_that_swings_is_identified_with_softer_gains():
    target = emulated(load="two_mass", parameters=SWINGING, num_threads=1)
    found = identify(target)[0]
    J = target.motor.inertia + SWINGING["load.inertia"]
    parallel = target.motor.inertia * SWINGING["load.inertia"] / J
    resonance = math.sqrt(SWINGING["load.stiffness"] / parallel) / (2.0 * math.pi)
    assert found.value("resonance") == pytest.approx(resonance, rel=0.02)
    assert found.value("inertia") == pytest.approx(J, rel=0.05)
