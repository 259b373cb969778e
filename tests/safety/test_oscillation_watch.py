"""What oscillates while it is experimented on is off within 50 ms; what is only shaken, or quiet, is left alone."""

import math

import numpy as np
import pytest

from drive_env import cia402
from drive_env.devices import find_device
from drive_env.dictionary.entries import ObjectDictionary
from drive_env.drives.observed import ObservedDrives
from drive_env.drives.raw_gains import write_gains
from drive_env.drives.trace import Trace
from tuning.identify.identification import identify
from tuning.identify.identified_axis import NAMES
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


@pytest.mark.slow
def test_an_axis_that_swings_is_identified_with_softer_gains():
    target = emulated(load="two_mass", parameters=SWINGING, num_threads=1)
    found = identify(target)[0]
    J = target.motor.inertia + SWINGING["load.inertia"]
    parallel = target.motor.inertia * SWINGING["load.inertia"] / J
    resonance = math.sqrt(SWINGING["load.stiffness"] / parallel) / (2.0 * math.pi)
    assert found.value("resonance") == pytest.approx(resonance, rel=0.02)
    assert found.value("inertia") == pytest.approx(J, rel=0.05)


class OneAxis:
    """Axes whose current is what a test says [mA], one row after the other."""

    device, observers = find_device("tmcm1636"), ()

    def __init__(self, num_axes=1):
        self.num_axes, self.log = num_axes, []

    def write(self, name, value, *, where):
        self.log.append((name, np.asarray(value).tolist(), where.tolist()))


@pytest.mark.parametrize(
    ("limit", "noise", "change", "off"),
    [
        (2.0, 0.0, 0.79, False),  # two fifths of what is asked for
        (2.0, 0.0, 0.81, True),
        (2.0, 0.3, 0.89, False),  # three times the noise, where that is more
        (2.0, 0.3, 0.91, True),
        (2.0, 0.2, 0.81, True),
    ],
)
def test_an_oscillation_is_more_than_two_fifths_of_the_limit_and_three_times_the_noise(limit, noise, change, off):
    own = OneAxis(2)
    watch = OscillationWatch(np.array([True, True]), np.array([limit, 99.0]), noise)
    wave = 0.5 * change * 1e3 * (-1.0) ** np.arange(25)[:, None] * [1.0, 1.0]
    watch.passed(own, 0.025, {CURRENT: wave}, (), None)
    assert watch.swung.tolist() == [off, False]
    assert own.log == ([(0x6040, 0, [True, False])] if off else [])
    watch.passed(own, 0.025, {CURRENT: wave}, (), None)
    assert len(own.log) == int(off)  # once


@pytest.mark.parametrize(("rms", "off"), [(0.99, False), (1.01, True)])
def test_what_is_shaken_on_purpose_may_have_so_much_about_its_mean(rms, off):
    own = OneAxis(2)
    watch = OscillationWatch(np.array([True, True]), np.array([0.1, 0.1]))
    wave = 1e3 * (50.0 + rms * (-1.0) ** np.arange(26))[:, None] * [1.0, 0.0]
    with watch.shaken(np.array([1.0, 1.0])):
        watch.passed(own, 0.025, {CURRENT: wave[:24]}, (), None)
        assert watch.patience() == 1
        watch.passed(own, 0.025, {CURRENT: wave[24:]}, (), None)
        assert watch.patience() == 25
    assert watch.swung.tolist() == [off, False]


def test_an_axis_that_is_softened_has_a_fourth_of_its_velocity_gains_and_is_watched_anew(monkeypatch):
    own, enabled, written = OneAxis(2), [], []
    monkeypatch.setattr("tuning.oscillation_watch.device_of", lambda drives: OneAxis.device)
    monkeypatch.setattr(
        "tuning.oscillation_watch.write_gains", lambda drives, gains, where: written.append((gains, where.tolist()))
    )
    monkeypatch.setattr(
        "tuning.oscillation_watch.motion.enable", lambda drives, mode, where: enabled.append((mode, where.tolist()))
    )
    watch = OscillationWatch(np.array([True, True]), np.array([1.0, 1.0]))
    watch.swung[:] = True
    gains = np.array([[1000, 200, 800, 96, 50]] * 2)
    first = np.array([True, False])
    softer = watch.soften(own, first, gains, "csp")
    assert softer[1].tolist() == gains[1].tolist() and softer[0, [0, 1, 2, 4]].tolist() == [1000, 200, 200, 50]
    assert watch.swung.tolist() == [False, True] and enabled == [("csp", [True, False])]
    assert own.log == [(0x60FF, 0, [True, False])] and written[0][1] == [True, False] and written[0][0] is softer
