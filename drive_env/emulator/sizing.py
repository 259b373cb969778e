"""Motor and gears for the joints of a model: the smallest motor of a list that moves them all, with the margins."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from drive_env.devices import Device
from drive_env.devices.gains import BASELINE_RULE, VELOCITY_FILTER_DAMPING, small_time_constants
from drive_env.emulator.inertia_check import MAX_INERTIA_RATIO
from drive_env.motors import Motor
from mechanics.joint_loads import JointLoad

# Usual ratios of planetary gearheads of one and two stages and of strain-wave gears; 1: without.
RATIOS = (1, 3, 4, 5, 7, 8, 10, 12, 15, 16, 20, 25, 30, 35, 40, 50, 60, 70, 80, 100, 120, 160)
# Usual travel of a slide per turn of its ball screw or toothed-belt pulley [mm].
LEADS = (200, 160, 120, 100, 80, 60, 50, 40, 32, 25, 20, 16, 10, 5, 4, 2.5, 2)
MARGIN = 1.25  # least margin of torque and of speed: a quarter in reserve
SPAN = {"hinge": 2.0 * math.pi, "slide": 1.0}  # rad and m: the longest move considered


class Demand(NamedTuple):
    """A move over a joint's range, in thirds: constant acceleration, constant speed, constant deceleration."""

    speed: float  # rad/s or m/s
    acceleration: float  # rad/s^2 or m/s^2


class AxisProposal(NamedTuple):
    """A gear between a motor and a joint, and its margins.

    Attributes:
        gear: Rotor angle per unit of the joint [1 or rad/m].
        inertia: Largest load inertia at the rotor over all poses [kg*m^2], without the rotor's own.
        inertia_ratio: That over the rotor's inertia.
        torque_margin: The motor's rated torque, limited by the drive's current, over the largest torque of the move.
        speed_margin: The motor's rated speed on the drive's supply over the speed of the move.
        encoder_margin: As `encoder_margin`.
    """

    gear: float
    inertia: float
    inertia_ratio: float
    torque_margin: float
    speed_margin: float
    encoder_margin: float

    @property
    def least_margin(self) -> float:
        """The least of the three margins and of the largest allowed inertia ratio over this one."""
        inertia = MARGIN * MAX_INERTIA_RATIO / self.inertia_ratio
        return min(self.torque_margin, self.speed_margin, self.encoder_margin, inertia)


class DriveProposal(NamedTuple):
    """A motor, the same for all joints of a machine, and the gear of each joint."""

    motor: Motor
    axes: tuple[AxisProposal, ...]

    @property
    def fits(self) -> bool:
        """Whether every axis has its margins, and not more inertia than can be tuned."""
        return all(axis.least_margin >= MARGIN for axis in self.axes)


def demand(joint: JointLoad, move_time: float) -> Demand:
    """Return speed and acceleration of a move over the range of a joint, at most `SPAN`, in a time [s]."""
    way = min(joint.travel.high - joint.travel.low, SPAN[joint.kind])
    return Demand(1.5 * way / move_time, 4.5 * way / move_time**2)


def encoder_margin(device: Device, motor: Motor, inertia: float) -> float:
    """Return the rated torque over the torque with which the velocity loop answers one encoder count.

    A count of angle q comes out of the velocity filter, a second-order low-pass of corner w, as a speed of up to q w
    exp(-d acos(d) / sqrt(1 - d^2)), and the loop answers it with J w_v times that, w_v by the baseline rule. Below 1
    gains are noisy, or too slow to overcome friction: `drive-tune auto` tuned a disc on three motors with 2,048 and
    4,096 counts wherever this was 1.05 or more, and on one of them below, at 0.68.

    Args:
        device: The drive.
        motor: The motor.
        inertia: Total inertia at the rotor [kg*m^2].
    """
    corner, d = device.stage["velocity_filter"].default, VELOCITY_FILTER_DAMPING
    peak = 2.0 * math.pi * corner * math.exp(-d * math.acos(d) / math.sqrt(1.0 - d * d))
    count = 2.0 * math.pi / motor.encoder_counts * peak
    bandwidth = BASELINE_RULE.speed / float(small_time_constants(device, corner, BASELINE_RULE.current_hz))
    return device.torque_of(motor) / (inertia * bandwidth * count)


def axis_proposal(joint: JointLoad, device: Device, motor: Motor, gear: float, move_time: float) -> AxisProposal:
    """Return the margins of a gear between a motor and a joint in a move over the joint's range.

    Torque at the rotor: ((J a + holding + dry friction + d w) / gear) + J_rotor gear a, each at its maximum.
    """
    speed, acceleration = demand(joint, move_time)
    holding = max(abs(joint.holding.low), abs(joint.holding.high))
    load = joint.inertia.high * acceleration + holding + joint.friction + joint.damping * speed
    torque = load / gear + motor.inertia * gear * acceleration + motor.coulomb + motor.viscous * gear * speed
    rated_speed = motor.rated_speed * device.supply_of(motor) / motor.voltage
    inertia = joint.inertia.high / gear**2
    return AxisProposal(
        gear, inertia, inertia / motor.inertia, device.torque_of(motor) / torque, rated_speed / (gear * speed),
        encoder_margin(device, motor, inertia + motor.inertia),
    )  # fmt: skip


def propose_drives(
    joints: Sequence[JointLoad], device: Device, motors: Iterable[Motor], move_time: float
) -> DriveProposal:
    """Return the motor of least rated power with sufficient margins at every joint; otherwise the closest one.

    Args:
        joints: The driven joints, one or more.
        device: The drives.
        motors: The candidates, one or more.
        move_time: Time in which each joint moves over its range [s].
    """
    best: DriveProposal | None = None
    for motor in sorted(motors, key=lambda one: one.rated_torque * one.rated_speed):
        axes = []
        for joint in joints:
            gears = RATIOS if joint.kind == "hinge" else [2.0 * math.pi / (1e-3 * lead) for lead in LEADS]
            choice = [axis_proposal(joint, device, motor, float(gear), move_time) for gear in gears]
            axes.append(max(choice, key=lambda axis: axis.least_margin))
        found = DriveProposal(motor, tuple(axes))
        if found.fits:
            return found
        if best is None or min(a.least_margin for a in axes) > min(a.least_margin for a in best.axes):
            best = found
    assert best is not None
    return best
