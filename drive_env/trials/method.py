"""How a device's gains are tried: trials, first gains, rule and cost of a cascade of loops, and of an open loop.

The gain set determines the method. Code that tries gains gets it from `method_of` and needs to know nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from drive_env.devices.gain_set import LOAD_DETECTION, PID_ALONE
from drive_env.devices.gains import BASELINE_RULE, bandwidth_gains, rule_gains, small_time_constants
from drive_env.phase_current import currents_for, rated_setting, swing_period, with_currents
from drive_env.trials.closed_loop import ClosedLoopTrials, plan_overload
from drive_env.trials.gain_trial import Identified, Trials, softness
from drive_env.trials.load_detection import LoadDetectionTrials, is_load_detection
from drive_env.trials.load_reading import DOWN, LOWER, UP, WIDTH, lacks_load_detection
from drive_env.trials.open_loop import OpenLoopTrials, acceleration_share, open_loop_cost, open_loop_softness
from drive_env.trials.position_pid import PID_I, PID_P, PidTrials, load_step_error, pid_time, plan_pid
from drive_env.trials.positioning import SPEED_SHARE, highest_ramp, plan_move
from drive_env.trials.score import RobustScore, Terms, cost
from mechanics.arrays import Floats, Integers

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.devices.gain_set import ClosedLoop
    from drive_env.drives.interface import Drives
    from drive_env.motors import Motor
    from drive_env.trials.positioning import Move


# Gains that can move an axis of which only the motor is known: the commissioning presets' bandwidths, three rotors.
FIRST_HZ = {"current_hz": 1000.0, "velocity_hz": 20.0, "position_hz": 5.0}
# The baseline rule at a sixth of its speed and half its position gain, with which no elastic axis of the public suite
# oscillates: start of a safe search.
SAFE_RULE = BASELINE_RULE._replace(speed=BASELINE_RULE.speed / 6.0, position=0.5 * BASELINE_RULE.position)

# CoolStep at the start of a search: the lowest threshold, a narrow band above it, fast up and slow down.
FIRST_COOLSTEP = {LOWER: 1, WIDTH: 2, DOWN: 2, UP: 3}

SLOW = 1.0 / 3.0  # of the gains of a stepper's closed loop, at the start of a safe search
SLOW_I = SLOW**2  # of the integral gain of a PID: it then has the same time scale as its P


@dataclass(frozen=True)
class Cascade:
    """A cascade of loops, whose gains a rule computes from the motor's data.

    The methods below are the interface for all kinds of gain sets; gains are raw, (n, count).
    `measures_current`: Whether the drive measures the torque current, which shows oscillation.
    `caution`: 1 if higher gains are closer to a stopped trial, -1 if lower ones are.
    """

    device: Device
    motor: Motor
    measures_current: ClassVar[bool] = True
    caution: ClassVar[int] = 1

    def t_0(self) -> float:
        """Return four times the sum of the small time constants [s]."""
        return 4.0 * float(small_time_constants(self.device, self.device.stage["velocity_filter"].default))

    def highest(self) -> Integers:
        """Return the greatest integers of the gains."""
        return self.device.gains.highest

    def first(self, supply: Floats) -> Integers:
        """Return gains for a total inertia of three rotors, by the supply voltages [V], (n,)."""
        inertia = 3.0 * self.motor.inertia
        rows = [bandwidth_gains(self.device, self.motor, inertia, supply=float(v), **FIRST_HZ) for v in supply]
        return np.array(rows, np.int64)

    def plan(self, found: Identified, scaler: ArrayLike, reach: ArrayLike) -> Move:
        """Return the move of trials; arguments as in `positioning.plan_move`."""
        return plan_move(self.motor, found.inertia, scaler, reach, highest_ramp(self.device))

    def rule(self, found: Identified, move: Move, supply: Floats) -> Integers:
        """Return the gains of the baseline rule."""
        return self._rule(BASELINE_RULE, found, supply)

    def safe(self, found: Identified, move: Move, supply: Floats) -> Integers:
        """Return slow gains that start a safe search."""
        return self._rule(SAFE_RULE, found, supply)

    def keep(self, gains: Integers, present: Integers) -> Integers:
        """Return gains unchanged: all of them are the rule's."""
        return gains

    def trials(self, drives: Drives, axes: int) -> Trials:
        """Return the runner of trials on these drives."""
        return Trials(drives, self.motor, axes, self.t_0())

    def softness(self, gains: Integers) -> Floats:
        """Return the softness of gains under a load, computed from the integrators."""
        return softness(self.device.gains, gains)

    def cost(self, terms: Terms) -> Floats:
        """Return J from its terms."""
        return cost(terms)

    def current(self, terms: Terms) -> Floats:
        """Return the current's ripple among the terms."""
        return terms.noise

    def _rule(self, rule: Any, found: Identified, supply: Floats) -> Integers:
        each = zip(found.inertia, supply, strict=True)
        return np.concatenate([rule_gains(self.device, self.motor, J, rule, supply=float(volts)) for J, volts in each])


@dataclass(frozen=True)
class OpenLoop:
    """Currents of a stepper in open loop: no torque current is measured.

    Lower currents lose steps. For the members see `Cascade`.
    """

    device: Device
    motor: Motor
    measures_current: ClassVar[bool] = False
    caution: ClassVar[int] = -1

    def t_0(self) -> float:
        """Return the period of the rotor's swing in its field at rated current [s]."""
        return swing_period(self.motor)

    def highest(self) -> Integers:
        """Return the greatest integers of the gains; those of currents are the motor's rated current."""
        full = with_currents(self.device, self.motor, self.device.gains.highest.max(), self.device.gains.highest.max())
        currents = self.device.gains.columns(self.device.gains.outer)
        most = self.device.gains.highest.copy()
        most[currents] = full[0, currents]
        return most

    def first(self, supply: Floats) -> Integers:
        """Return the rated current, moving and at rest; the threshold is 0, and CoolStep off."""
        most = rated_setting(self.device, self.motor)
        return np.tile(with_currents(self.device, self.motor, most, most), (len(supply), 1))

    def plan(self, found: Identified, scaler: ArrayLike, reach: ArrayLike) -> Move:
        """Return the move of trials, with the torque that friction and a constant load leave."""
        speed = SPEED_SHARE * self.motor.rated_speed
        taken = self.motor.torque_constant * (found.coulomb + np.abs(found.offset) + found.viscous * speed)
        share = acceleration_share(self.device, self.motor, taken)
        return plan_move(self.motor, found.inertia, scaler, reach, highest_ramp(self.device), share)

    def rule(self, found: Identified, move: Move, supply: Floats) -> Integers:
        """Return currents with which the load causes 30 degrees of load angle in the move."""
        constant = self.motor.torque_constant
        speed, acceleration = move.velocity / move.increments, move.acceleration / move.increments
        moving = found.inertia * acceleration + constant * (
            found.coulomb + found.viscous * speed + np.abs(found.offset)
        )
        return currents_for(self.device, self.motor, moving, constant * found.offset)

    def safe(self, found: Identified, move: Move, supply: Floats) -> Integers:
        """Return the rated current, which holds a stepper best."""
        return self.first(supply)

    def keep(self, gains: Integers, present: Integers) -> Integers:
        """Return gains in which those of other loops, and of the load detection, keep their present values."""
        kept, own = present.copy(), self._columns()
        kept[:, own] = gains[:, own]
        return kept

    def trials(self, drives: Drives, axes: int) -> OpenLoopTrials:
        """Return the runner of trials on these drives."""
        return OpenLoopTrials(drives, self.motor, axes, self.t_0())

    def softness(self, gains: Integers) -> Floats:
        """Return the softness of gains under a load, computed from the standby current."""
        return open_loop_softness(self.device, gains)

    def cost(self, terms: Any) -> Floats:
        """Return J from its terms."""
        return np.asarray(open_loop_cost(terms))

    def current(self, terms: Any) -> Floats:
        """Return the RMS of the set currents, or of the current that CoolStep leaves."""
        return np.asarray(np.sqrt(terms.effort))

    def _columns(self) -> list[int]:
        return list(self.device.gains.columns(self.device.gains.outer))


@dataclass(frozen=True)
class ClosedStepper(OpenLoop):
    """A stepper whose drive closes a loop around it: gains that act only there, at the motor's rated current.

    It is identified in open loop; its trials evaluate the torque current themselves. Higher gains oscillate.
    """

    loop: ClosedLoop
    caution: ClassVar[int] = 1

    def t_0(self) -> float:
        """Return the period of the rotor's swing in its field at rated current; of a PID alone its own time [s]."""
        return pid_time(self.loop) if self.loop.kind == PID_ALONE else super().t_0()

    def first(self, supply: Floats) -> Integers:
        """Return the rated current with the loop's first values, or the commissioned values if it has none."""
        gains = super().first(supply)
        dictionary = self.device.new_dictionary()
        entries = [(dictionary.find(name), value) for name, value in self.device.preset(self.motor).items()]
        preset = {(entry.index, entry.sub): value for entry, value in entries}
        for name, column in zip(self.loop.gains, self._loop_columns(), strict=True):
            row = self.device.gains.rows[column]
            gains[:, column] = self.loop.first.get(name, preset.get(row.key, row.lowest))
        return gains

    def plan(self, found: Identified, scaler: ArrayLike, reach: ArrayLike) -> Move:
        """Return a move that overloads the motor; for a PID a move that it can follow."""
        if self.loop.is_pid:
            return plan_pid(self.motor, self.loop, found, scaler, reach)
        return plan_overload(self.device, self.motor, found, scaler, reach)

    def rule(self, found: Identified, move: Move, supply: Floats) -> Integers:
        """Return the first gains: no rule exists for such a loop."""
        return self.first(supply)

    def safe(self, found: Identified, move: Move, supply: Floats) -> Integers:
        """Return a third of the first gains (of a PID's I a ninth), which catch up more slowly."""
        gains, known = self.first(supply), self.device.gains
        if not self.loop.is_pid:
            return known.scaled(gains, SLOW, self._loop_columns())
        p, i = (known.column(*part) for part in (PID_P, PID_I))
        assert p is not None and i is not None, "a PID has both"
        return known.scaled(known.scaled(gains, SLOW, [p]), SLOW_I, [i])

    def trials(self, drives: Drives, axes: int) -> ClosedLoopTrials:
        """Return the runner of trials on these drives."""
        kind = PidTrials if self.loop.is_pid else ClosedLoopTrials
        return kind(drives, self.motor, axes, self.t_0(), self.loop)

    def softness(self, gains: Integers) -> Floats:
        """Return 1, since every trial measures the recovery from an overload; for a PID a model's load step."""
        if self.loop.is_pid:
            return load_step_error(self.device, self.motor, self.loop, gains)
        return np.ones(len(gains))

    def cost(self, terms: Terms) -> Floats:
        """Return J from its terms."""
        return cost(terms)

    def current(self, terms: Terms) -> Floats:
        """Return the ripple of the torque current; for a PID, which measures none, the vibration in the unit of J."""
        return terms.noise

    def _loop_columns(self) -> list[int]:
        return self.device.gains.columns_of_loop(self.loop)

    def _columns(self) -> list[int]:
        return [*super()._columns(), *self._loop_columns()]


@dataclass(frozen=True)
class LoadSettings(OpenLoop):
    """A stepper's threshold of load detection and its CoolStep, with the currents that the load needs.

    Higher thresholds of CoolStep leave more current; a low threshold stops an axis that is not blocked. The move of
    these trials follows from the working speed instead of `plan`.
    """

    def rule(self, found: Identified, move: Move, supply: Floats) -> Integers:
        """Return the currents for the load, a threshold of 0, and a CoolStep that reduces the current only a little."""
        gains = super().rule(found, move, supply)
        for part, value in FIRST_COOLSTEP.items():
            column = self.device.gains.column(*part)
            if column is not None:
                gains[:, column] = value
        return gains

    def trials(self, drives: Drives, axes: int) -> LoadDetectionTrials:
        """Return the runner of trials on these drives."""
        return LoadDetectionTrials(drives, self.motor, axes, self.t_0())

    def softness(self, gains: Integers) -> Floats:
        """Return 1: no load step is part of the cost."""
        return np.ones(len(gains))

    def _columns(self) -> list[int]:
        return [*super()._columns(), *self.device.gains.columns_of(*LOAD_DETECTION)]


Method = Cascade | OpenLoop


def method_of(device: Device, motor: Motor, names: tuple[str, ...] = ()) -> Method:
    """Return the method for gains of a device; names of gains that act only in a closed loop select this loop."""
    if (loop := device.gains.loop_of(names)) is not None:
        return ClosedStepper(device, motor, loop)
    if is_load_detection(device, names):
        return LoadSettings(device, motor)
    return OpenLoop(device, motor) if device.gains.is_open_loop else Cascade(device, motor)


def check_tried(device: Device, names: tuple[str, ...]) -> None:
    """Raise ValueError, before anything moves, unless trials can show the effect of gains with these names."""
    if not names and not device.gains.outer:
        raise ValueError(
            f"{device.name} has no gains of a velocity or position loop and no phase currents, which trials could "
            "tell apart; name gains of its gains.toml"
        )
    device.gains.columns(names)
    if (loop := device.gains.loop_of(names)) is not None:
        if others := [name for name in names if name not in loop.gains]:
            raise ValueError(
                f"{', '.join(others)}: trials of {', '.join(name for name in names if name in loop.gains)} close the "
                f"loop at the motor's rated current, and show what {', '.join(loop.gains)} do; search the others by "
                "themselves"
            )
        return
    if is_load_detection(device, names):
        if lacks := lacks_load_detection(device):
            raise ValueError(f"{device.name}: the load detection of this drive cannot be set: {lacks}")
        rows = {row.name: row.loop for row in device.gains.rows}
        if others := [name for name in names if rows[name] not in LOAD_DETECTION]:
            raise ValueError(
                f"{', '.join(others)}: trials of the load detection and of CoolStep show what "
                f"{', '.join(name for name, loop in rows.items() if loop in LOAD_DETECTION)} do; search the others by "
                "themselves"
            )
        return
    closed = [name for each in device.gains.closed_loops for name in each.gains]
    if device.gains.is_open_loop and (others := [name for name in names if name not in device.gains.outer]):
        shown = ", ".join(device.gains.outer)
        shown += f", and with its loop closed what {', '.join(closed)} do" if closed else ""
        raise ValueError(
            f"{', '.join(others)}: a trial of an open-loop stepper shows what the phase currents do, {shown}; "
            "drive-tune sweep varies any gain"
        )


def new_score(
    device: str, load: Any, motor: Any, num_machines: int, *, gains: tuple[str, ...] = (), **options: Any
) -> RobustScore:
    """Return the score of a device's gains on emulated machines; arguments as in `RobustScore`.

    Names in `gains` that act only in a closed loop select this loop.
    """
    from drive_env.devices import find_device
    from drive_env.trials.closed_loop_score import ClosedLoopScore
    from drive_env.trials.open_loop_score import OpenLoopScore
    from drive_env.trials.position_pid_score import PidScore

    known = find_device(device)
    if (loop := known.gains.loop_of(gains)) is not None:
        if loop.is_pid:
            return PidScore(device, load, motor, num_machines, loop=loop, **options)
        return ClosedLoopScore(device, load, motor, num_machines, **options)
    kind: Callable[..., RobustScore] = OpenLoopScore if known.gains.is_open_loop else RobustScore
    return kind(device, load, motor, num_machines, **options)
