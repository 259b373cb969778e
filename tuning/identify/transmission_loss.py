"""The losses of a screw or a gear in proportion to the transmitted torque, where the moves of an axis show them.

While the motor drives the load, the loss adds to what it carries; while the load drives the motor, it takes from it.
With i_L the current behind the rotor and behind the friction before the transmission, and T what is carried,

    i_L = (1 + loss) T while i_L has the sign of the speed,    i_L = (1 - loss) T while it has the other one.

An axis that always drives shows (1 + loss) times its load's inertia, and so does each part of a braking in which
friction brakes more than is needed; the balance of a whole move cancels only the rest. How much of the friction lies
before the transmission is not known: the inertia is that of the middle, and the interval holds those of both ends. A
loss that is not clear may be there all the same, hidden by friction that brakes enough: the interval holds it, too.

A load behind play glides: after a change of speed it runs along by itself, in the gap, for as long as a cruise lasts,
and the motor then shows less friction than there is. From standstill to standstill nothing hides so, but the loss
matters there. So friction is estimated twice, from cruises and from whole ways, and the interval holds both.
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

CLEAR = 3.0  # times its deviation: from here on it is taken out of friction; below, inertia's interval becomes wider
MOST = 2.0 / 3.0  # share of a loss that may hide: of a quarter of the transmitted torque
BEFORE = (0.5, 0.0, 1.0)  # share of friction that lies before the transmission: the middle, and both ends
TURNING = 0.15  # of a ramp, about standstill: there friction breaks away, and play is passed
STEEP = 0.5  # of a ramp, on which a weight fades
EDGE = 1.0 / 3.0  # of a ramp to either side of standstill: where a whole way begins and ends


class Loss(NamedTuple):
    """The loss of a transmission.

    while_braking: What it gives back while it brakes, per sample [A], less what it does so in cruises.
    share: By how much more it shows while it drives than while it brakes; 2 loss / (1 - loss).
    is_clear: Whether the moves show it beyond chance.
    """

    while_braking: Floats
    share: float
    is_clear: bool = True

    @property
    def loss(self) -> float:
        """Losses over the transmitted torque; of a screw of 90 % efficiency: 0.11."""
        return self.share / (2.0 + self.share)

    def load_alone(self, inertia: float, rotor: float) -> float:
        """Return total inertia [kg*m^2] where one was seen whose load, all but the rotor, counts with its loss."""
        return rotor + (inertia - rotor) / (1.0 + self.loss)


def find_losses(did: Motion, cruises: Cruises, motor: Motor, friction: Floats) -> tuple[Loss, ...]:
    """Return the loss for each of `BEFORE`: if not clear, the likely one, the most that may hide, and none.

    Args:
        did: What the axis did.
        cruises: First and last sample of every cruise, and its move.
        motor: Its motor.
        friction: Dry [A] and viscous [A*s/rad] friction, as the moves show it without a loss.
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
    """Return dry and viscous friction and offset, [A], [A*s/rad], [A], from standstill to standstill.

    Args:
        did: What the axis did.
        cruises: As `find_losses` takes them.
        loss: What its transmission loses.
        inertia: J/K as the balance shows it with that loss [A*s^2/rad].
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
    """Return the part of the current behind the rotor that brakes, with the sign of the speed, per sample [A]."""
    accelerating = motor.inertia / motor.torque_constant * smoothed(np.gradient(did.smooth) / CYCLE)
    behind = smoothed(smoothed(smoothed(did.current))) - accelerating - before[0] * did.sign - before[1] * did.smooth
    braking = np.maximum(-behind * did.sign, 0.0) * did.sign
    # A weight that goes down brakes all the time: that is part of friction and offset as cruises show them.
    for there in (cruises[::2], cruises[1::2]):
        way = np.sign(sum(float(did.smooth[a:b].mean()) for a, b, _ in there))
        braking[way * did.sign > 0.0] -= float(np.concatenate([braking[a:b] for a, b, _ in there]).mean())
    return np.asarray(braking)


def _parts(did: Motion, cruises: Cruises) -> tuple[list[Floats], list[int]]:
    """Return weights of cruises, brakings and accelerations apart, without standstill, and their moves."""
    t = np.arange(len(did.angle), dtype=float)
    weights, moves = [], []
    for first, last, ramp, number in _ramps(cruises):
        begin = first + (last - first) // 5  # the loop swings in
        middle = 0.5 * (begin + last)
        weights.append(np.minimum(step(t, begin, middle), 1.0 - step(t, middle, last)))
        there = any(a > last and move == number for a, _, move in cruises)
        if there:  # it turns afterwards
            end = last + ramp
            weights.append(step(t, middle, last) * (1.0 - step(t, end - STEEP * ramp, end - TURNING * ramp)))
        else:
            start = first - ramp
            weights.append(step(t, start + TURNING * ramp, start + STEEP * ramp) * (1.0 - step(t, begin, middle)))
        moves += [number, number]
    return weights, moves


def _ramps(cruises: Cruises) -> list[tuple[int, int, int, int]]:
    """Return first and last sample of every cruise, its ramp [samples], and its move; between two there are two."""
    both: dict[int, list[tuple[int, int]]] = {}
    for first, last, number in cruises:
        both.setdefault(number, []).append((first, last))
    ramps = {number: (second[0] - first[1]) // 2 for number, (first, second) in both.items()}
    return [(first, last, ramps[number], number) for first, last, number in cruises]
