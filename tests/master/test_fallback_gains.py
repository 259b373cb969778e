"""What goes on shaking gets calm gains, once it has shaken for windows in a row; nothing else does."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from drive_env import cia402
from drive_env.devices import find_device
from drive_env.drives.observed import ObservedDrives
from tuning.fallback_gains import FallbackGains

GAIN_OBJECTS = find_device("tmcm1636").gains.keys

RATED = 4.0  # A
OSCILLATION, WATCH = 0.4, 25  # of the rated current, cycles
CALM = np.array([[1, 2, 3, 4, 5], [6, 7, 8, 9, 10]])


class TwoAxes:
    """Two axes of which the second shakes in the windows that are told, by so many times what counts as shaking."""

    num_axes = 2
    device = find_device("tmcm1636")

    def __init__(self, shaking, strength):
        self.shaking, self.strength, self.window, self.written = shaking, strength, -1, {}

    def record(self, objects, duration, play=None, period=0.001):
        self.window += 1
        step = 1e3 * OSCILLATION * RATED * self.strength * (self.shaking[self.window] == "S")  # mA from cycle to cycle
        second = np.where(np.arange(WATCH) % 2, step, 0.0)
        return _Trace({cia402.TORQUE_ACTUAL: np.stack([np.full(WATCH, 3000.0), 2000.0 + second], axis=1)})

    def write(self, name, value, where=None):
        self.written[name] = (self.window, np.asarray(value).tolist(), np.asarray(where).tolist())


class _Trace(dict):
    def __len__(self):
        return WATCH


@pytest.mark.parametrize(
    ("windows", "calmed_in"),
    [
        ("SSS", 2),
        ("-SSS", 3),
        ("SS-SS-", None),  # not in a row
        ("S-S-S-S-", None),
        ("------", None),
    ],
)
def test_an_axis_is_calmed_after_three_windows_in_a_row(windows, calmed_in):
    own = TwoAxes(windows, 1.1)
    fallback = FallbackGains(2, RATED)
    fallback.calm = CALM
    drives = ObservedDrives(own, fallback)
    for _ in windows:
        drives.record([cia402.TORQUE_ACTUAL], WATCH * 0.001)
    if calmed_in is None:
        assert own.written == {}
        assert not fallback.calmed.any()
    else:
        assert set(own.written) == set(GAIN_OBJECTS)
        assert {window for window, _, _ in own.written.values()} == {calmed_in}
        assert all(where == [False, True] for _, _, where in own.written.values())
        assert fallback.calmed.tolist() == [False, True]


def test_less_than_shaking_a_new_trial_and_unknown_gains_calm_nothing():
    for strength, begins_anew, calm in ((0.9, False, CALM), (1.1, True, CALM), (1.1, False, None)):
        own = TwoAxes("SSS", strength)
        fallback = FallbackGains(2, RATED)
        fallback.calm = calm
        drives = ObservedDrives(own, fallback)
        for window in range(3):
            if begins_anew and window == 2:
                fallback.begin()
            drives.record([cia402.TORQUE_ACTUAL], WATCH * 0.001)
        assert own.written == {}


def test_another_look_than_a_window_s_does_not_count():
    own = TwoAxes("SSSS", 1.1)
    fallback = FallbackGains(2, RATED)
    fallback.calm = CALM
    drives = ObservedDrives(own, fallback)
    own.record = lambda objects, duration, play, period: SimpleNamespace(__len__=lambda: 7)
    for _ in range(4):
        drives.record([0x606C], 0.007)
    assert own.written == {}
