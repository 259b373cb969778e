"""Experts of the suite's tasks: the program of a motion engineer who has identified the machine.

An expert knows the parameters of each machine when its episode begins (`told`); on a bus, where they are
unknown, it uses the nominal ones. Delays of the bus, flexibility and sensors still disturb it.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from itertools import product
from typing import Any

import numpy as np

from drive_env.devices import find_device
from drive_env.devices.gains import Rule, rule_gains
from drive_env.envs.gain_scheduling import base_inertia
from drive_env.envs.highest_speed import highest_speeds
from drive_env.motors import find_motor
from drive_env.phase_current import amplitude, rated_setting
from mechanics.arrays import Floats, Singles
from mechanics.loads import find_load

AXIS_ENTRIES = 8
ERROR, SPEED_ERROR, POSITION, SPEED, TORQUE, WANTED_SPEED, WANTED_SPEED_LATER = range(7)  # of an axis in Tracking
PREVIEW = 0.01  # s, how much later
GRAVITY = 9.81  # m/s^2


class Expert:
    """Base of the experts.

    Args:
        configuration: The environment's configuration.
    """

    def __init__(self, configuration: Any) -> None:
        self.configuration = configuration
        self._machine: dict[str, Floats] = {}

    def told(self, parameters: Mapping[str, Floats], mask: Any) -> None:
        """Store the parameters of starting machines, or of those whose payload has changed, where the mask is true.

        Args:
            parameters: By name, (environments,) each.
            mask: The machines, (environments,).
        """
        for name, values in parameters.items():
            kept = self._machine.setdefault(name, np.array(values, float))
            kept[mask] = np.asarray(values, float)[mask]
        self.reset(mask)

    def parameter(self, name: str, nominal: float) -> Floats:
        """Return a parameter of all machines; the nominal one if it is unknown."""
        return np.asarray(self._machine.get(name, nominal), float)

    def reset(self, mask: Any = None) -> None:
        """Forget the state of episodes that have ended."""

    def act(self, observation: Any) -> Singles:
        """Return the action for one observation, or one for each environment."""
        rows = np.atleast_2d(np.asarray(observation, float))
        action = np.clip(self.actions(rows), -1.0, 1.0).astype(np.float32)
        found: Singles = action[0] if np.ndim(observation) == 1 else action
        return found

    def actions(self, rows: Floats) -> Floats:
        """Return actions, shape (environments, actions)."""
        raise NotImplementedError


def nominal(expert: type[Expert]) -> type[Expert]:
    """Return a class of the expert that uses the nominal parameters on every machine, as it does on a bus."""
    return type(f"Nominal{expert.__name__}", (expert,), {"told": lambda self, _parameters, mask: self.reset(mask)})


class ComputedTorque(Expert):
    """Torque by the identified inertia and friction, with proportional and derivative feedback, of one axis in cst.

    Rigid-body feed-forward as in Siciliano et al., Robotics (2009), section 8.5. The bandwidth is what the bus' longest
    delay leaves on most machines, found by trying.
    """

    BANDWIDTH, DAMPING, FRICTION_SPEED = 25.0, 0.9, 2.0  # rad/s, 1, rad/s
    LIMIT = 2.0  # of the motor's rated current: what the drive is commissioned with

    def actions(self, rows: Floats) -> Floats:
        """Return the torque as a share of that at the current limit."""
        motor, configuration = find_motor(self.configuration.motor), self.configuration
        amplitude, speed = (2.0 * np.pi * value for value in (configuration.amplitude, configuration.speed))
        constant = motor.torque_constant * self.parameter("motor.psi_m", motor.psi_m) / motor.psi_m
        inertia = self.parameter("motor.inertia", motor.inertia) + self.parameter("load.inertia", 2.0 * motor.inertia)
        coulomb = self.parameter("motor.coulomb", motor.coulomb) + self.parameter("load.coulomb", 0.0)
        viscous = self.parameter("motor.viscous", motor.viscous) + self.parameter("load.viscous", 0.0)
        wanted = speed * rows[:, WANTED_SPEED]
        acceleration = speed * (rows[:, WANTED_SPEED_LATER] - rows[:, WANTED_SPEED]) / PREVIEW
        feedback = self.BANDWIDTH**2 * amplitude * rows[:, ERROR]
        feedback += 2.0 * self.DAMPING * self.BANDWIDTH * speed * rows[:, SPEED_ERROR]
        torque = inertia * (acceleration + feedback)
        torque += coulomb * np.tanh(wanted / self.FRICTION_SPEED) + viscous * wanted
        return np.asarray(torque / (constant * self.LIMIT * motor.rated_current))[:, None]


class Pendulum(Expert):
    """A linear-quadratic regulator of cart and pendulum about the flat feed-forward, through the cart's acceleration.

    Flat output is where the bob is (Fliess et al. 1995).
    """

    WEIGHTS = np.diag([1000.0, 30.0, 0.0, 0.0])  # bob's position and speed, angle and its rate
    EFFORT = 0.05

    def __init__(self, configuration: Any) -> None:
        super().__init__(configuration)
        self._stands = configuration.load == "inverted_pendulum"
        self._lead = 2.0 * np.pi / find_load(configuration.load).gears[0]  # m per revolution
        self._gains: dict[float, Floats] = {}

    def actions(self, rows: Floats) -> Floats:
        """Return the change of the cart's speed as a share of the largest change."""
        configuration, lead = self.configuration, self._lead
        amplitude, speed = lead * configuration.amplitude, lead * configuration.speed
        greatest = 1.25 * configuration.ramp * speed  # m/s^2
        sign = 1.0 if self._stands else -1.0
        length = np.broadcast_to(self.parameter("load.length", configuration.task.length), len(rows))
        angle, rate = rows[:, AXIS_ENTRIES], rows[:, AXIS_ENTRIES + 1]
        wanted = speed * (rows[:, WANTED_SPEED_LATER] - rows[:, WANTED_SPEED]) / PREVIEW
        leaning = sign * wanted / GRAVITY
        state = np.stack(
            [length * leaning - amplitude * rows[:, ERROR], -speed * rows[:, SPEED_ERROR], angle - leaning, rate], 1
        )
        gains = np.stack([self._gain(round(float(one), 4), sign) for one in length])
        acceleration = wanted - np.sum(gains * state, axis=1)
        return np.asarray(acceleration / greatest)[:, None]

    def _gain(self, length: float, sign: float) -> Floats:
        """Return the regulator's gains on position [m], speed, angle [rad] and rate, for a pendulum's length [m]."""
        if length not in self._gains:
            from scipy.linalg import expm, solve_discrete_are

            model = np.zeros((5, 5))
            model[0, 1] = model[2, 3] = model[1, 4] = 1.0
            model[3, 2], model[3, 4] = sign * GRAVITY / length, -1.0 / length
            discrete = expm(model / self.configuration.rate)
            a, b = discrete[:4, :4], discrete[:4, 4:]
            bob = np.eye(4)
            bob[0, 2] = bob[1, 3] = length
            cost = solve_discrete_are(a, b, bob.T @ self.WEIGHTS @ bob, np.array([[self.EFFORT]]))
            self._gains[length] = np.linalg.solve(self.EFFORT + b.T @ cost @ b, b.T @ cost @ a)[0]
        return self._gains[length]


class SwingUp(Pendulum):
    """Pumps energy into a hanging pole (Astrom and Furuta 2000) and has the regulator catch it."""

    WEIGHTS = np.diag([100.0, 10.0, 10.0, 1.0])
    CATCH = 0.5  # rad from upright, within which the regulator acts
    PUMP, CENTRE, BRAKE, MOST = 10.0, 10.0, 4.0, 0.8  # 1/m, 1/s^2, 1/s, of the greatest acceleration

    def actions(self, rows: Floats) -> Floats:
        """Return the change of the cart's speed as a share of the largest change."""
        configuration, lead = self.configuration, self._lead
        greatest = 1.25 * configuration.ramp * lead * configuration.speed
        length = self.parameter("load.length", configuration.task.length)
        angle, rate = rows[:, AXIS_ENTRIES], rows[:, AXIS_ENTRIES + 1]
        energy = 0.5 * (length * rate) ** 2 + GRAVITY * length * (np.cos(angle) - 1.0)  # J/kg, 0 upright
        pumped = self.PUMP * energy * np.sign(rate * np.cos(angle))
        pumped = np.clip(pumped, -self.MOST * greatest, self.MOST * greatest)
        pumped -= self.CENTRE * lead * configuration.amplitude * rows[:, POSITION]
        pumped -= self.BRAKE * lead * configuration.speed * rows[:, SPEED]
        return np.where((np.abs(angle) < self.CATCH)[:, None], super().actions(rows), (pumped / greatest)[:, None])


class LeadAndFeedback(Expert):
    """Set-points of axes in csp, advanced by the cascade's lags and by a multiple of the following error.

    Feed-forward of velocity and acceleration (Lambrechts et al. 2005); its two lags were found by trial, the same for
    every machine. The feedback is chosen so that Ms stays below 2.5 on all machines (`drive-agent margins expert`).
    """

    LAG, LAG_OF_SPEED = 0.0315, 4e-4  # s, s^2
    FEEDBACK = 2.0  # lead per following error [rev/rev]

    def actions(self, rows: Floats) -> Floats:
        """Return the lead of each axis' set-point as a share of the largest lead."""
        configuration = self.configuration
        axes = rows[:, : rows.shape[1] // AXIS_ENTRIES * AXIS_ENTRIES].reshape(len(rows), -1, AXIS_ENTRIES)
        acceleration = configuration.speed * (axes[..., WANTED_SPEED_LATER] - axes[..., WANTED_SPEED]) / PREVIEW
        lead = self.LAG * configuration.speed * axes[..., WANTED_SPEED] + self.LAG_OF_SPEED * acceleration
        lead += self.FEEDBACK * configuration.amplitude * axes[..., ERROR]
        return np.asarray(lead / (1.25 * configuration.offset * configuration.amplitude))


class PayloadSchedule(Expert):
    """Gains that are scheduled by the known payload (Astrom and Wittenmark, Adaptive Control, 1995, chapter 9).

    The rule has the form of the baseline rule (drive_env/devices/gains.py). Its constants, found by trial and the same
    for every machine, give the least lag with soft dynamics.
    """

    RULE = Rule(current_hz=1000.0, speed=0.226, integration=18.0, position=0.77)

    def actions(self, rows: Floats) -> Floats:
        """Return the gains of one axis as an action."""
        configuration, motor = self.configuration, find_motor(self.configuration.motor)
        device = find_device(configuration.device)
        nominal = float(base_inertia(configuration)[0]) - motor.inertia
        inertia = self.parameter("motor.inertia", motor.inertia) + self.parameter("load.inertia", nominal)
        inertia = inertia * motor.psi_m / self.parameter("motor.psi_m", motor.psi_m)  # as a drive identifies it
        columns = device.gains.columns(configuration.chosen)
        wanted = rule_gains(device, motor, inertia, self.RULE)[:, columns]
        base = rule_gains(device, motor, base_inertia(configuration))[:, columns]
        action = np.log(wanted / base) / configuration.span
        return np.broadcast_to(action, (len(rows), action.shape[1]))


class LoadAngle(Expert):
    """A step rate that grows while the rotor lags less behind its steps than is safe at that rate, and else falls.

    The load angle as in closed-loop control (Acarnley, Stepping Motors, 4th edition, chapter 7). The safe lag grows
    with the rate, since currents lag behind voltages, and the encoder's sample is late; both numbers were found by
    trying, the same for every machine.
    """

    LAG, LAG_OF_SPEED = 0.75, 0.077  # full steps, full steps of 1 rev/s
    GAIN = 1.0  # of the greatest change of the rate, of a full step

    def actions(self, rows: Floats) -> Floats:
        """Return the change of the step rate as a share of the largest change."""
        safe = self.LAG + self.LAG_OF_SPEED * self.configuration.speed * rows[:, SPEED]
        return np.asarray(self.GAIN * (safe - rows[:, TORQUE]))[:, None]


class HighestSpeed(Expert):
    """A step rate just below the highest that each machine's pull-out torque allows.

    The policy needs the true machine (`told`); without one, as on a bus, it raises ValueError.
    """

    SHARE, GAIN = 0.96, 3.0  # of the highest; of the greatest change of the rate, of `speed`

    def actions(self, rows: Floats) -> Floats:
        """Return the change of the step rate as a share of the largest; ValueError before `told`."""
        if not self._machine:
            raise ValueError("the oracle must be told the true machine, which no bus tells; take the expert")
        speed = self.SHARE * self._highest / (2.0 * np.pi * self.configuration.speed)
        return np.asarray(self.GAIN * (speed - rows[:, SPEED]))[:, None]

    def told(self, parameters: Mapping[str, Floats], mask: Any) -> None:
        """Store the machines whose episode begins, and compute their highest speeds."""
        super().told(parameters, mask)
        device, motor = find_device(self.configuration.device), find_motor(self.configuration.motor)
        self._highest = highest_speeds(motor, amplitude(device, rated_setting(device, motor)), self._machine)


class CarriageServo(Expert):
    """A position and speed loop of the carriage, which commands its acceleration and ignores the pendulum."""

    BANDWIDTH = 10.0  # rad/s

    def actions(self, rows: Floats) -> Floats:
        """Return the change of the carriage's speed as a share of the largest change."""
        configuration = self.configuration
        wanted = configuration.speed * (rows[:, WANTED_SPEED_LATER] - rows[:, WANTED_SPEED]) / PREVIEW
        wanted = wanted + self.BANDWIDTH**2 * configuration.amplitude * rows[:, ERROR]
        wanted = wanted + 2.0 * self.BANDWIDTH * configuration.speed * rows[:, SPEED_ERROR]
        return np.asarray(wanted / (1.25 * configuration.ramp * configuration.speed))[:, None]


class TorqueCascade(ComputedTorque):
    """Position and speed loop in the master without feed-forward, for the nominal machine."""

    BANDWIDTH = 60.0

    def told(self, parameters: Mapping[str, Floats], mask: Any) -> None:
        """Ignore the machine's parameters."""

    def actions(self, rows: Floats) -> Floats:
        """Return the torque as a share of that at the current limit."""
        still = rows.copy()
        still[:, WANTED_SPEED] = still[:, WANTED_SPEED_LATER] = 0.0
        return super().actions(still)


class MarginDesign(Expert):
    """The fastest gains of a grid with which the linear models of the machine and of its variants keep the margins.

    As `drive-tune auto` designs (tuning/auto/design.py), without its trials on a model with friction and noise.
    """

    # ln over the rule's: bandwidth of the velocity loop; integration time and position gain, over that bandwidth.
    BANDWIDTHS = np.linspace(-3.0, 0.8, 13)
    INTEGRATIONS = np.log(4.0 / np.array([2.0, 4.0, 9.0]))
    POSITIONS = np.log(3.0 * np.array([0.12, 0.2, 0.32, 0.5, 0.75]))
    EACH = 3  # of a bandwidth, whose variants are looked at
    AROUND = np.array(list(product((-1.0, 0.0, 1.0), repeat=3))) * (0.12, 0.3, 0.15)  # the best of these
    SLACK = 0.05  # by which the constraints are kept, relative
    SPEED = np.array([0.4, 0.4, 0.8])  # by which ln J falls with ln of velocity P and I and position P

    def __init__(self, configuration: Any) -> None:
        super().__init__(configuration)
        self._design: Floats | None = None

    def reset(self, mask: Any = None) -> None:
        """Delete the designed gains, so that the next episode designs its own."""
        self._design = None

    def actions(self, rows: Floats) -> Floats:
        """Return ln(designed gain / rule's gain) in steps of the action; the same in each trial."""
        if self._design is None:
            self._design = self._designed(rows)
        return np.asarray(self._design / self.configuration.step)

    def _designed(self, rows: Floats) -> Floats:
        """Design gains; return ln(designed gain / rule's gain), (environments, 3)."""
        from drive_env.trials.method import new_score

        c, count = self.configuration, len(rows)
        device, motor = find_device(c.device), find_motor(c.motor)
        supply = device.supply_of(motor)
        rule = rule_gains(device, motor, 3.0 * motor.inertia * np.exp(rows[:, 0]), supply=supply)
        columns = device.gains.columns(c.gains)
        grid = np.array([(b, b + i, b + p) for b, i, p in product(self.BANDWIDTHS, self.INTEGRATIONS, self.POSITIONS)])
        with closing(new_score(c.device, c.load, motor, count, num_threads=1, dynamics=c.dynamics)) as model:
            model.set_machines(self._machine, np.full(count, supply))

            def worth(sets: Floats, nominal: bool) -> Floats:
                """Score sets of gains, (sets, environments, 3), by speed, or slack - 1e9 outside the margins."""
                raw = [device.gains.changed(rule, one, columns, device.gains.highest) for one in sets]
                slack = np.array([model.loop_slack(one, nominal=nominal) for one in raw])
                return np.where(slack > self.SLACK, sets @ self.SPEED, slack - 1e9)

            sets = np.repeat(grid[:, None], count, axis=1)
            shape = (len(self.BANDWIDTHS), -1, count)
            best = np.argsort(-worth(sets, nominal=True).reshape(shape), axis=1)[:, : self.EACH]
            sets = np.take_along_axis(sets.reshape(*shape, 3), best[..., None], axis=1).reshape(-1, count, 3)
            for around in (np.zeros((1, 3)), self.AROUND):
                sets = (sets[None] + around[:, None, None]).reshape(-1, count, 3)
                sets = sets[worth(sets, nominal=False).argmax(axis=0), np.arange(count)][None]
        return np.asarray(sets[0])
