"""A stop by grades, row by row: an axis as it may behave, and what its stop makes of it."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest

from drive_env.safety.stopping import AxisStop, Phase, Sample

ENABLED, STOPPING, OFF = 0x0637, 0x0617, 0x0650  # statuswords (CiA 402)
QUICK_STOP, DISABLE_VOLTAGE = 0x02, 0x00  # controlwords
SPEED, RAMP, REST = 600_000.0, 6_000_000.0, 10_000.0  # inc/s, inc/s^2, inc/s: the ramp takes 0.1 s
PERIOD = 0.005  # s between two samples


class Axis:
    """An axis that obeys controlwords, though it brakes as it likes.

    Args:
        speed: Speed [inc/s] over the time since its quick stop began [s].
        obeys: Takes the quick stop.
        seen_until: Shows nothing new afterwards [s].
    """

    def __init__(self, speed, *, obeys=True, seen_until=math.inf):
        self.speed, self.obeys, self.seen_until = speed, obeys, seen_until
        self.status, self.begun, self.last = ENABLED, None, None

    def sample(self, now):
        if self.last is None or now <= self.seen_until:
            moving = SPEED if self.begun is None else self.speed(now - self.begun)
            self.last = Sample(now, self.status, moving)
        return self.last

    def take(self, word, now):
        if word == QUICK_STOP and self.obeys and self.status == ENABLED:
            self.status, self.begun = STOPPING, now
        if word == DISABLE_VOLTAGE:
            self.status = OFF


def stop(axis, *, ramp=RAMP, holds=False, longest=4.0):
    """Stop an axis; return its stop, and when the voltage went [s], None if it never did."""
    one, cut = AxisStop(0.0, SPEED, ramp, REST, holds), None
    for step in range(round(longest / PERIOD)):
        now = step * PERIOD
        word = one.step(now, axis.sample(now))
        if word is not None:
            axis.take(word, now)
        if word == DISABLE_VOLTAGE and cut is None:
            cut = now
        if one.is_over:
            break
    return one, cut


def down(rate, to=0.0):
    """Slow down at a rate [inc/s^2] to a speed."""
    return lambda t: max(SPEED - rate * t, to)


def swing(share, lasting):
    """Slow down as the ramp says, past rest, and come back from a share of the speed after a time [s]."""

    def speed(t):
        passed = t - SPEED / RAMP
        if passed < 0.0:
            return SPEED - RAMP * t
        return -share * SPEED * math.sin(math.pi * passed / lasting) if passed < lasting else 0.0

    return speed


@pytest.mark.parametrize(
    ("speed", "ramp", "why", "earliest", "latest"),
    [
        # It slows down well enough: the voltage goes at rest, without a reason to tell.
        (down(RAMP), RAMP, "", 0.1, 0.15),
        (down(0.6 * RAMP), RAMP, "", 0.16, 0.2),  # more than half of the ramp
        (down(0.2 * RAMP), RAMP, "", 0.4, 0.6),  # less, but it will stand within a second
        (down(0.2 * RAMP), 0.0, "", 0.4, 0.6),  # of a ramp that is not known
        # At its limit of current it goes on as before, until the ramp has come down to the speed that it has.
        (
            lambda t: SPEED * (1.0 + 2.0 * t) if t < 0.04 else max(1.08 * SPEED - RAMP * (t - 0.04), 0.0),
            RAMP,
            "",
            0.14,
            0.2,
        ),
        # It does not.
        (down(0.0), RAMP, "it does not slow down by its ramp", 0.04, 0.1),
        (down(0.0), 0.0, "it does not slow down by its ramp", 0.04, 0.1),
        (down(-RAMP), RAMP, "it does not slow down by its ramp", 0.04, 0.1),
        (down(0.05 * RAMP), RAMP, "it does not slow down by its ramp", 0.04, 0.1),  # two seconds and more
        (down(RAMP, to=0.1 * SPEED), RAMP, "it does not slow down by its ramp", 0.24, 0.28),
        # Slower and slower, always fast enough to stand within a second, and never at rest.
        (lambda t: 0.1 * SPEED + 0.9 * SPEED * math.exp(-t), RAMP / 20.0, "it is still turning after 2 s", 2.0, 2.05),
        # As slowly as a ramp says that would take minutes.
        (down(RAMP / 10_000.0), RAMP / 10_000.0, "it does not slow down by its ramp", 0.04, 0.1),
        # Past rest and back.
        (swing(0.12, 0.2), RAMP, "", 0.3, 0.4),
        (swing(-0.4, 0.2), RAMP, "it does not slow down by its ramp", 0.1, 0.25),  # on again, not back
        (swing(0.4, 0.2), RAMP, "it does not slow down by its ramp", 0.1, 0.22),
        (down(RAMP, to=-0.1 * SPEED), RAMP, "it does not slow down by its ramp", 0.22, 0.28),  # it stays there
    ],
)
def test_an_axis_keeps_its_voltage_while_it_slows_down(speed, ramp, why, earliest, latest):
    one, cut = stop(Axis(speed), ramp=ramp)
    assert one.why == why
    assert one.phase is Phase.OFF
    assert earliest <= cut <= latest


def test_an_axis_that_does_not_obey_the_quick_stop_loses_its_voltage_after_100_ms():
    one, cut = stop(Axis(down(0.0), obeys=False))
    assert one.why == "it does not obey the quick stop"
    assert 0.1 < cut <= 0.1 + 2 * PERIOD


def test_an_axis_that_is_not_seen_loses_its_voltage_after_400_ms():
    one, cut = stop(Axis(down(RAMP), seen_until=0.05))
    assert one.why.startswith("its position was not received for 0.4 s")
    assert 0.45 < cut <= 0.45 + 3 * PERIOD


def test_an_axis_that_is_held_keeps_its_voltage_at_rest_until_it_is_released():
    axis = Axis(down(RAMP))
    one, cut = stop(axis, holds=True)
    assert (one.phase, cut, axis.status) == (Phase.REST, None, STOPPING)
    assert one.rests_for(5.0) > 4.0
    one.release(5.0)
    assert one.step(5.0, axis.sample(5.0)) == DISABLE_VOLTAGE


def test_an_axis_that_is_held_and_breaks_loose_loses_its_voltage():
    axis = Axis(down(RAMP))
    one, _ = stop(axis, holds=True)
    assert one.step(1.0, Sample(1.0, STOPPING, 9.0 * REST)) is None
    assert one.step(1.1, Sample(1.1, STOPPING, -11.0 * REST)) == DISABLE_VOLTAGE
    assert one.why == "it moves though it is held"


def test_voltage_off_is_repeated_and_given_up_after_600_ms():
    one, sent = AxisStop(0.0, SPEED, RAMP, REST, holds=False), []
    for step in range(400):
        now = step * PERIOD
        if one.step(now, Sample(now, ENABLED, SPEED)) == DISABLE_VOLTAGE:
            sent.append(now)
        if one.is_over:
            break
    assert one.phase is Phase.LOST
    assert sent[-1] - sent[0] == pytest.approx(0.6, abs=0.03)
    assert max(after - before for before, after in pairwise(sent)) <= 0.02 + PERIOD
