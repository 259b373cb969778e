"""The losses of a screw or a gear proportional to the transmitted torque, if the moves of an axis show them.

While the motor drives the load, the loss adds to the transmitted torque; while the load drives the motor, it reduces
it. With i_L the current behind the rotor and behind the friction before the transmission, and T the transmitted torque,

    i_L = (1 + loss) T while i_L has the sign of the speed,    i_L = (1 - loss) T while it has the opposite sign.

An axis that always drives shows (1 + loss) times its load's inertia, and so does each part of a braking in which
friction brakes more than is needed; the balance of a whole move cancels only the rest. The share of the friction before
the transmission is unknown: the inertia is computed for half of it, and the interval includes that for none and for
all. A loss that is not significant may still exist, hidden by friction that brakes enough: the interval includes it,
too.

A load behind backlash glides: after a change of speed it runs free within the gap for the whole cruise, and the motor
then shows too little friction. Moves from standstill to standstill do not hide it, but there the loss matters. So
friction is estimated twice, from cruises and from whole ways, and the interval includes both.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from drive_env.drives.interface import CYCLE
from mechanics.arrays import Floats
from tuning.identify.confidence import t_quantile
from tuning.identify.momentum_balance import Motion, Solved, balance_rows, smoothed, solve, step

if TYPE_CHECKING:
    from drive_env.motors import Motor

Cruises = tuple[tuple[int, int, int], ...]

CLEAR = 3.0  # times its standard deviation: a clearer loss is taken out of friction; else inertia's interval is widened
MOST = 2.0 / 3.0  # greatest share that may be hidden: loss of a quarter of the transmitted torque
BEFORE = (0.5, 0.0, 1.0)  # shares of friction before the transmission: middle, and both ends
TURNING = 0.15  # of a ramp, around standstill: omitted, since friction breaks away and backlash is crossed there
STEEP = 0.5  # of a ramp, over which a weight fades out
EDGE = 1.0 / 3.0  # of a ramp to either side of standstill: begin and end of a whole way


class Loss(NamedTuple):
    """The loss of a transmission.

    while_braking: Braking current per sample [A], less its mean in cruises.
    share: Relative difference between driving and braking; 2 loss / (1 - loss).
    is_clear: Whether it is significant in the moves.
    """

    while_braking: Floats
    share: float
    is_clear: bool = True

    @property
    def loss(self) -> float:
        """Losses over the transmitted torque; of a screw of 90 % efficiency: 0.11."""
        return self.share / (2.0 + self.share)

    def load_alone(self, inertia: float, rotor: float) -> float:
        """Correct a total inertia [kg*m^2] in which the load, all but the rotor, was counted with its loss."""
        return rotor + (inertia - rotor) / (1.0 + self.loss)


def find_losses(did: Motion, cruises: Cruises, motor: Motor, friction: Floats) -> tuple[Loss, ...]:
    """Return the loss for each of `BEFORE`: measured if clear, else the likely, the greatest possible, and none.

    Args:
        did: Motion of the axis.
        cruises: First and last sample of every cruise, and the number of its move.
        motor: Its motor.
        friction: Dry [A] and viscous [A*s/rad] friction, estimated without a loss.
    """
    weights, moves = _parts(did, cruises)
    rows = balance_rows(did, weights, moves)
    found: list[Loss] = []
    most: list[float] = []
    for before in BEFORE:
        braking = _while_braking(did, cruises, motor, before * friction)
        columns = np.column_stack([rows.columns[:, :4], rows.weights @ braking * CYCLE])
        solved = solve(columns, rows.charge, rows.duration, rows.moves)
        share, spread = float(solved.mean[-1]), float(solved.spread[-1])
        found.append(Loss(braking, max(share, 0.0), found[0].is_clear if found else share > CLEAR * spread))
        most.append(float(np.clip(share + t_quantile(solved.freedom) * spread, 0.0, MOST)))
    middle, behind, ahead = found
    if middle.is_clear:
        return middle, behind, ahead
    return middle, behind._replace(share=most[1]), ahead._replace(share=0.0)


def friction_of_whole_ways(did: Motion, cruises: Cruises, loss: Loss, inertia: float) -> Solved:
    """Return dry and viscous friction and offset, [A], [A*s/rad], [A], from moves from standstill to standstill.

    Args:
        did: Motion of the axis.
        cruises: As in `find_losses`.
        loss: Loss of its transmission.
        inertia: J/K by the balance with that loss [A*s^2/rad].
    """
    t = np.arange(len(did.angle), dtype=float)
    weights, moves = [], []
    for first, last, ramp, number in _ramps(cruises):
        begin, end, edge = first - ramp, last + ramp, EDGE * ramp
        weights.append(step(t, begin - edge, begin + edge) * (1.0 - step(t, end - edge, end + edge)))
        moves.append(number)
    rows = balance_rows(did, weights, moves)
    known = inertia * rows.columns[:, 0] + loss.share * (rows.weights @ loss.while_braking) * CYCLE
    return solve(rows.columns[:, 1:4], rows.charge - known, rows.duration, rows.moves)


def _while_braking(did: Motion, cruises: Cruises, motor: Motor, before: Floats) -> Floats:
    """Return the braking part of the current behind the rotor, with the sign of the speed, per sample [A]."""
    accelerating = motor.inertia / motor.torque_constant * smoothed(np.gradient(did.smooth) / CYCLE)
    behind = smoothed(smoothed(smoothed(did.current))) - accelerating - before[0] * did.sign - before[1] * did.smooth
    braking = np.maximum(-behind * did.sign, 0.0) * did.sign
    # A descending weight brakes all the time: cruises show that as friction and offset, so it is subtracted.
    for there in (cruises[::2], cruises[1::2]):
        way = np.sign(sum(float(did.smooth[a:b].mean()) for a, b, _ in there))
        braking[way * did.sign > 0.0] -= float(np.concatenate([braking[a:b] for a, b, _ in there]).mean())
    return np.asarray(braking)


def _parts(did: Motion, cruises: Cruises) -> tuple[list[Floats], list[int]]:
    """Return weights of cruises, brakings and accelerations, without standstill, and the numbers of their moves."""
    t = np.arange(len(did.angle), dtype=float)
    weights, moves = [], []
    for first, last, ramp, number in _ramps(cruises):
        begin = first + (last - first) // 5  # the loop is settling before
        middle = 0.5 * (begin + last)
        weights.append(np.minimum(step(t, begin, middle), 1.0 - step(t, middle, last)))
        there = any(a > last and move == number for a, _, move in cruises)
        if there:  # the axis turns afterwards
            end = last + ramp
            weights.append(step(t, middle, last) * (1.0 - step(t, end - STEEP * ramp, end - TURNING * ramp)))
        else:
            start = first - ramp
            weights.append(step(t, start + TURNING * ramp, start + STEEP * ramp) * (1.0 - step(t, begin, middle)))
        moves += [number, number]
    return weights, moves


def _ramps(cruises: Cruises) -> list[tuple[int, int, int, int]]:
    """Return first and last sample of every cruise, its ramp [samples], and its move; two ramps lie between cruises."""
    both: dict[int, list[tuple[int, int]]] = {}
    for first, last, number in cruises:
        both.setdefault(number, []).append((first, last))
    ramps = {number: (second[0] - first[1]) // 2 for number, (first, second) in both.items()}
    return [(first, last, ramps[number], number) for first, last, number in cruises]
