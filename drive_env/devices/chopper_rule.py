"""Blank time and off time of a stepper driver's chopper for a motor (TMC5160 class), where the factory's do not suit.

In spread cycle a phase current ripples by no less than what it rises by in the blank time, in which nothing is
measured, and falls by in both slow decays of a cycle:

    ripple = (u t_blank + 2 R i t_off) / L

The factory's blank time of 36 clocks and off time of 172 suit windings of some millihenries. For one on which this is
more than `MOST` of the run current, the two that the data sheet of the chip has besides are taken: a blank time of
24 clocks ("1 or 2 for most applications", TBL) and the off time 3 of its first example of a CHOPCONF (000100C3h). The
chopper's frequency grows, and with it the losses of switching, which is why it is not done for every motor.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drive_env.motors import Motor

MOST = 0.05  # of the run current
CLOCK = 16e6  # Hz
FACTORY_BLANK, FACTORY_OFF = 36.0, 12.0 + 32.0 * 5.0  # clocks: 2092h = 2, 2097h = 5
SHORT = {"Chopper blank time": 1, "Chopper off time": 3}


def least_ripple(motor: Motor, current: float, supply: float) -> float:
    """Return the least ripple [A] of the factory's settings at an amplitude [A] and a supply [V]."""
    rises = supply * FACTORY_BLANK / CLOCK
    falls = 2.0 * motor.R_s * current * FACTORY_OFF / CLOCK
    return (rises + falls) / motor.L_q


def chopper_settings(motor: Motor, current: float, supply: float) -> dict[str, int]:
    """Return the settings to write for a motor, object name -> raw value; {} if the factory's suit it."""
    return dict(SHORT) if least_ripple(motor, current, supply) > MOST * current else {}
