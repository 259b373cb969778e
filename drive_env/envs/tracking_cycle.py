"""Each step of Tracking as compiled code: actions to set-points, samples to observation and reward."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numba import from_dtype, types
from numpy.typing import NDArray

from drive_env import cia402
from drive_env.envs.bus_delays import Line, pass_on
from mechanics.kernels.bundle import Bundle, Cube, Matrix, NumberCube, Vector, reader
from mechanics.kernels.compiled import cached, inlined, stage

# An environment's episode: step and number of steps; the pendulum's angle at the last step [rad]; whether it fell.
LANE = np.dtype([("step", "i8"), ("steps", "i8"), ("angle", "f8"), ("fallen", "i8")])

AXIS_HIGH = np.array([4.0, 4.0, 4.0, 4.0, 4.0, 2.0, 2.0, 1.0])  # upper limits of an axis' entries; -these are the lower
LOAD_HIGH = np.array([np.pi, 50.0])
PREVIEW = 10  # cycles
LONGEST_DELAY = 10  # cycles; jitter may add as many
COMMISSIONED_INERTIA = 3.0  # rotor inertias for which the presets were computed

# Errors worth 0.1 of a term: of amplitude, of speed, rad, of the current limit, of the action.
MARGINS = {"tracking": 0.25, "speed": 0.5, "load": 0.2, "effort": 1.0, "smoothness": 1.0}

# (mode, action) -> kind of set-points.
DIRECT, DIRECT_POSITION, OFFSET_POSITION, OFFSET_VELOCITY, OFFSET_TORQUE, RAMP, RAMP_POSITION = range(7)
KINDS = {("csp", "direct"): DIRECT_POSITION, ("csv", "direct"): DIRECT, ("cst", "direct"): DIRECT,
         ("csp", "offset"): OFFSET_POSITION, ("csv", "offset"): OFFSET_VELOCITY, ("cst", "offset"): OFFSET_TORQUE,
         ("csp", "ramp"): RAMP_POSITION, ("csv", "ramp"): RAMP, ("cst", "ramp"): RAMP}  # fmt: skip
OPERATION_ENABLED = cia402.OPERATION_ENABLED


@inlined
def tolerance(error, margin):
    """Return 1 without an error, 0.1 at the margin, and still with a slope far beyond it."""
    return 1.0 / (1.0 + 9.0 * (error / margin) ** 2)


@inlined
def limited(value, high):
    """Return a value within -high...high; NaN becomes 0."""
    return min(max(value, -high), high) if value == value else 0.0


Lanes = Annotated[NDArray[np.void], types.Array(from_dtype(LANE), 1, "C")]


@dataclass(eq=False)
class Episodes(Bundle):
    """All data of a step, for n environments with their axes; raw values are the drives' integers."""

    lanes: Lanes  # (n,)
    action: Vector  # -1...1, (axes,)
    scales: Matrix  # amplitude [inc], speed [606Ch], torque [sampled unit], full scale of the action, (axes, 4)
    origin: Vector  # position at the episode's start [inc], (axes,)
    actions: Line  # raw values on their way to the drives, one for each of an environment's axes
    observations: Line  # status, position, velocity, torque of each axis under way, and their cycle's number
    message: Matrix  # scratch, (n, entries of a message)
    target: Vector  # sum of the actions of kind RAMP, raw, (axes,)
    slope: float  # largest change of such a target in a step, of its full scale
    reference: Cube  # position [inc], velocity [inc/s], acceleration [inc/s^2], (axes, 3, cycles)
    profile_scale: Vector  # raw units of the target per unit of the reference, (axes,)
    last: Matrix  # last action and the one before, (axes, 2)
    played: NumberCube  # written: with an offset the profile's set-points, then the actions', (1 or 2, cycles, axes)
    sampled: NumberCube  # statusword, position, velocity, torque or position demand, (4, cycles, axes)
    angles: Vector  # the pendulums' [rad], (n,)
    fastest: Vector  # speed to which the pace is relative [606Ch], (axes,)
    arm: Vector  # the bob's distance from the axis at a right angle [inc], (n,)
    weights: Vector  # of the terms
    margins: Vector  # of MARGINS
    observation: Annotated[NDArray[np.float32], types.float32[:, ::1]]  # written, (n, entries)
    reward: Vector  # written, (n,)
    terms: Matrix  # written, (terms, n)
    ended: Annotated[NDArray[np.bool_], types.boolean[:, ::1]]  # written: terminated and truncated, (2, n)
    kind: int  # a row of KINDS
    lags: int  # 1: torque is the axis' lag behind its demand, as for a stepper
    fall: float  # angle that ends an episode [rad]


episodes_at = reader(Episodes)


@cached(allocates=False)
def act(address, first, count):
    """Convert actions of some axes to the rows of set-points in this step's cycles."""
    own = episodes_at(address)
    lanes, scales, origin, actions, message = own.lanes, own.scales, own.origin, own.actions, own.message
    action, last, reference, profile_scale, played = own.action, own.last, own.reference, own.profile_scale, own.played
    kind = own.kind
    raw = played[played.shape[0] - 1]
    cycles, axes = raw.shape[0], raw.shape[1] // lanes.shape[0]
    held, length = actions.held, reference.shape[2]
    for k in range(first // axes, (first + count) // axes):
        step = lanes[k].step
        for a in range(axes):
            axis = k * axes + a
            given = limited(action[axis], 1.0)
            full = scales[axis, 3]
            if kind >= RAMP:
                own.target[axis] = limited(own.target[axis] + given * own.slope * full, full)
                value = np.rint(own.target[axis])
            else:
                value = np.rint(given * full)
            if kind in (DIRECT_POSITION, RAMP_POSITION):
                value += origin[axis]
            message[k, a] = value
            last[axis, 1] = last[axis, 0]
            last[axis, 0] = given
        for c in range(cycles):
            pass_on(actions, k, message[k, :axes], True)
            now = min(step * cycles + c, length - 1)
            for a in range(axes):
                axis = k * axes + a
                raw[c, axis] = np.int64(held[k, a])
                if kind == OFFSET_POSITION:
                    played[0, c, axis] = np.int64(np.rint(origin[axis] + reference[axis, 0, now]))
                elif kind == OFFSET_VELOCITY:
                    played[0, c, axis] = np.int64(np.rint(reference[axis, 1, now]))
                elif kind == OFFSET_TORQUE:
                    wanted = reference[axis, 2, now] * profile_scale[axis]
                    played[0, c, axis] = np.int64(np.rint(limited(wanted, scales[axis, 2])))
    return 0


@inlined
def position_error(reference, position, origin):
    """Return reference - position from the origin [inc], also across the 32-bit counter's wrap."""
    error = reference - (position - origin)
    return error - 4294967296.0 * np.floor((error + 2147483648.0) / 4294967296.0)


@inlined
def within_a_turn(angle):
    """Return an angle [rad] wrapped to -pi...pi."""
    return angle - 2.0 * np.pi * np.floor((angle + np.pi) / (2.0 * np.pi))


@inlined
def torque(lags, fourth, position):
    """Return the signal of the torque: torque actual value, or demand minus position [inc]."""
    return position_error(fourth, position, 0.0) if lags == 1 else float(fourth)


@stage
def describe(own, k):
    """Write the observation of environment k, from the samples received so far."""
    reference, held, scales, origin = own.reference, own.observations.held, own.scales, own.origin
    angles, observation, last = own.angles, own.observation, own.last
    lane = own.lanes[k]
    cycles, axes = own.played.shape[1], scales.shape[0] // own.lanes.shape[0]
    at = min(max(np.int64(held[k, 4 * axes]), 0), reference.shape[2] - 1)
    soon = min(at + PREVIEW, reference.shape[2] - 1)
    for a in range(axes):
        axis = k * axes + a
        amplitude, speed = scales[axis, 0], scales[axis, 1]
        error = position_error(reference[axis, 0, at], held[k, 4 * a + 1], origin[axis])
        velocity, felt = held[k, 4 * a + 2], held[k, 4 * a + 3]
        row = 8 * a
        observation[k, row] = limited(error / amplitude, AXIS_HIGH[0])
        observation[k, row + 1] = limited((reference[axis, 1, at] - velocity) / speed, AXIS_HIGH[1])
        observation[k, row + 2] = limited((reference[axis, 0, at] - error) / amplitude, AXIS_HIGH[2])
        observation[k, row + 3] = limited(velocity / speed, AXIS_HIGH[3])
        observation[k, row + 4] = limited(felt / scales[axis, 2], AXIS_HIGH[4])
        observation[k, row + 5] = limited(reference[axis, 1, at] / speed, AXIS_HIGH[5])
        observation[k, row + 6] = limited(reference[axis, 1, soon] / speed, AXIS_HIGH[6])
        observation[k, row + 7] = last[axis, 0]
    if observation.shape[1] > 8 * axes:
        rate = (angles[k] - lane.angle) / (cycles * 1e-3)
        observation[k, 8 * axes] = within_a_turn(angles[k])
        observation[k, 8 * axes + 1] = limited(rate, LOAD_HIGH[1])
        lane.angle = angles[k]


@cached(allocates=False)
def describe_lanes(address, where):
    """Write the observations of the environments where the mask is true."""
    own = episodes_at(address)
    for k in range(where.shape[0]):
        if where[k]:
            describe(own, k)


@cached(allocates=False)
def observe(address, first, count):
    """Process some axes' samples; write observations, rewards and their terms, and which environments have ended."""
    own = episodes_at(address)
    lanes, sampled, reference, observations = own.lanes, own.sampled, own.reference, own.observations
    scales, origin, last, angles, weights = own.scales, own.origin, own.last, own.angles, own.weights
    reward, terms, ended, message, margins = own.reward, own.terms, own.ended, own.message, own.margins
    cycles, axes = sampled.shape[1], sampled.shape[2] // lanes.shape[0]
    length, width = reference.shape[2], 4 * axes + 1
    has_angle = own.observation.shape[1] > 8 * axes
    for k in range(first // axes, (first + count) // axes):
        lane = lanes[k]
        begun = lane.step * cycles
        tripped = False
        tracking, slow, carried, effort, smooth, pace = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        at = min(begun + cycles - 1, length - 1)
        for c in range(cycles):
            for a in range(axes):
                axis = k * axes + a
                for sample in range(3):
                    message[k, 4 * a + sample] = sampled[sample, c, axis]
                message[k, 4 * a + 3] = torque(own.lags, sampled[3, c, axis], sampled[1, c, axis])
            message[k, 4 * axes] = begun + c
            pass_on(observations, k, message[k, :width], True)
        c = cycles - 1
        for axis in range(k * axes, (k + 1) * axes):
            status, position, velocity = sampled[0, c, axis], sampled[1, c, axis], sampled[2, c, axis]
            tripped |= status & OPERATION_ENABLED[0] != OPERATION_ENABLED[1]
            error = position_error(reference[axis, 0, at], float(position), origin[axis])
            tracking += tolerance(error / scales[axis, 0], margins[0])
            carried += tolerance((error - own.arm[k] * np.sin(angles[k])) / scales[axis, 0], margins[0])
            slow += tolerance((reference[axis, 1, at] - velocity) / scales[axis, 1], margins[1])
            felt = torque(own.lags, sampled[3, c, axis], sampled[1, c, axis])
            effort += tolerance(felt / scales[axis, 2], margins[3])
            smooth += tolerance(last[axis, 0] - last[axis, 1], margins[4])
            pace += min(max(velocity / own.fastest[axis], 0.0), 1.0) ** 2
        fallen = abs(angles[k]) > own.fall
        lane.fallen = 1 if fallen else 0
        terms[0, k] = tracking / axes
        terms[1, k] = slow / axes
        terms[2, k] = tolerance(within_a_turn(angles[k]), margins[2]) if has_angle else 0.0
        terms[3, k] = carried / axes if has_angle else 0.0
        terms[4, k] = effort / axes
        terms[5, k] = smooth / axes
        terms[6, k] = pace / axes
        terms[7, k] = 1.0 if tripped or fallen else 0.0
        total = 0.0
        for term in range(terms.shape[0] - 1):
            total += weights[term] * terms[term, k]
        reward[k] = total - weights[7] * terms[7, k]
        lane.step += 1
        ended[0, k] = tripped or fallen
        ended[1, k] = lane.step >= lane.steps
        describe(own, k)
    return 0
