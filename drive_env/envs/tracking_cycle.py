"""What Tracking does in each step, compiled: from actions to set-points, from samples to observation and reward."""

from __future__ import annotations

import numpy as np

from mechanics.compiled import cached, inlined

# A lane's episode: step and number of steps; latencies beyond the cycle that a bus has anyway [communication cycles];
# the pendulum's angle at the last step [rad]; whether it fell.
LANE = np.dtype([("step", "i8"), ("steps", "i8"), ("action_latency", "i8"), ("observation_latency", "i8"),
                 ("angle", "f8"), ("fallen", "i8")])  # fmt: skip

AXIS_HIGH = np.array([4.0, 4.0, 4.0, 4.0, 2.0, 2.0, 2.0, 1.0])  # of the entries of an axis, -low as well
LOAD_HIGH = np.array([np.pi, 50.0])
PREVIEW = 10  # cycles
DEPTH = 32  # cycles or steps that are remembered
LONGEST_DELAY = 10  # cycles; with as much jitter it must fit into DEPTH
LOST = 255  # the SYNC of this step is lost
COMMISSIONED_INERTIA = 3.0  # rotor inertias: what the presets were computed for

TERMS = ("tracking", "speed", "load", "effort", "smoothness", "trip")
# Where an error is worth 0.1 of a term: of amplitude, of speed, rad, of the current limit, of the action.
TRACKING_MARGIN, SPEED_MARGIN, LOAD_MARGIN, EFFORT_MARGIN, SMOOTHNESS_MARGIN = 0.25, 0.5, 0.2, 1.0, 1.0

# (mode, direct) -> how set-points are made.
DIRECT, DIRECT_POSITION, OFFSET_POSITION, OFFSET_VELOCITY, OFFSET_TORQUE = range(5)
KINDS = {("csp", True): DIRECT_POSITION, ("csv", True): DIRECT, ("cst", True): DIRECT,
         ("csp", False): OFFSET_POSITION, ("csv", False): OFFSET_VELOCITY, ("cst", False): OFFSET_TORQUE}  # fmt: skip
OPERATION_ENABLED = (0x6F, 0x27)


@inlined
def tolerance(error, margin):
    """Return 1 without an error, 0.1 at the margin, and still a slope far beyond it."""
    return 1.0 / (1.0 + 9.0 * (error / margin) ** 2)


@inlined
def limited(value, high):
    """Return a value within -high...high; what is no number is 0."""
    return min(max(value, -high), high) if value == value else 0.0


@cached()
def act(lanes, action, scales, origin, pending, bus, reference, profile_scale, last, raw, target, kind):
    """Turn actions into the rows of set-points that act in this step's cycles.

    Args:
        lanes: LANE, shape (n,).
        action: -1...1, shape (axes,).
        scales: Amplitude [inc], speed [inc/s], current limit [mA], full scale of the action [raw], shape (axes, 4).
        origin: Position at the episode's start [inc], shape (axes,).
        pending: Raw values of the last steps, shape (axes, DEPTH).
        bus: Cycles that each step's action is late besides, or LOST, shape (n, steps).
        reference: Position [inc], velocity [inc/s], acceleration [inc/s^2], shape (n, 3, cycles).
        profile_scale: Raw units of the target per unit of the reference, shape (axes,).
        last: Last action and the one before, written, shape (axes, 2).
        raw: Set-points that are the actions', written, shape (cycles, axes).
        target: Set-points of the profile, written, shape (cycles, axes).
        kind: A row of KINDS.
    """
    cycles = raw.shape[0]
    axes = raw.shape[1] // lanes.shape[0]
    for axis in range(raw.shape[1]):
        lane = lanes[axis // axes]
        step = lane.step
        given = limited(float(action[axis]), 1.0)
        value = np.rint(given * scales[axis, 3])
        if kind == DIRECT_POSITION:
            value += origin[axis]
        late = bus[axis // axes, min(step, bus.shape[1] - 1)]
        pending[axis, step % DEPTH] = pending[axis, (step - 1) % DEPTH] if late == LOST else np.int64(value)
        last[axis, 1] = last[axis, 0]
        last[axis, 0] = given
        latency = lane.action_latency + (0 if late == LOST else np.int64(late))
        for c in range(cycles):
            back = 0 if latency <= c else (latency - c + cycles - 1) // cycles
            raw[c, axis] = pending[axis, (step - min(back, DEPTH - 1)) % DEPTH]
            now = min(step * cycles + c, reference.shape[2] - 1)
            if kind == OFFSET_POSITION:
                target[c, axis] = np.int64(np.rint(origin[axis] + reference[axis // axes, 0, now]))
            elif kind == OFFSET_VELOCITY:
                target[c, axis] = np.int64(np.rint(reference[axis // axes, 1, now]))
            elif kind == OFFSET_TORQUE:
                wanted = reference[axis // axes, 2, now] * profile_scale[axis]
                target[c, axis] = np.int64(np.rint(limited(wanted, scales[axis, 2])))


@inlined
def position_error(reference, position, origin):
    """Return reference - position from the origin [inc], across the end of the counter of 32 bits too."""
    error = reference - (position - origin)
    return error - 4294967296.0 * np.floor((error + 2147483648.0) / 4294967296.0)


@cached()
def describe(lanes, history, reference, scales, origin, last, angles, observation, cycles, where):
    """Write the observations of the lanes where the mask is true, from the samples that each has by now.

    `history` has the samples of the last cycles, cycle modulo DEPTH, shape (DEPTH, objects, axes); `angles` [rad] are
    the pendulums', shape (n,); `observation`, shape (n, entries), is written. The others are those of `act`.
    """
    axes = history.shape[2] // lanes.shape[0]
    for k in range(lanes.shape[0]):
        if not where[k]:
            continue
        lane = lanes[k]
        # After step s the last sample is of cycle s * cycles - 1.
        newest = lane.step * cycles - 1
        now = newest - lane.observation_latency
        at = min(max(now, 0), reference.shape[2] - 1)
        soon = min(at + PREVIEW, reference.shape[2] - 1)
        for a in range(axes):
            axis = k * axes + a
            sample = history[now % DEPTH]
            amplitude, speed = scales[axis, 0], scales[axis, 1]
            error = position_error(reference[k, 0, at], float(sample[1, axis]), origin[axis])
            first = 8 * a
            observation[k, first] = limited(error / amplitude, AXIS_HIGH[0])
            observation[k, first + 1] = limited((reference[k, 1, at] - sample[2, axis]) / speed, AXIS_HIGH[1])
            observation[k, first + 2] = limited((reference[k, 0, at] - error) / amplitude, AXIS_HIGH[2])
            observation[k, first + 3] = limited(sample[2, axis] / speed, AXIS_HIGH[3])
            observation[k, first + 4] = limited(sample[3, axis] / scales[axis, 2], AXIS_HIGH[4])
            observation[k, first + 5] = limited(reference[k, 1, at] / speed, AXIS_HIGH[5])
            observation[k, first + 6] = limited(reference[k, 1, soon] / speed, AXIS_HIGH[6])
            observation[k, first + 7] = last[axis, 0]
        if observation.shape[1] > 8 * axes:
            rate = (angles[k] - lane.angle) / (cycles * 1e-3)
            observation[k, 8 * axes] = limited(angles[k], LOAD_HIGH[0])
            observation[k, 8 * axes + 1] = limited(rate, LOAD_HIGH[1])
            lane.angle = angles[k]


@cached()
def observe(
    lanes, status, position, velocity, torque, history, reference, scales, origin, last, angles, weights, bus, fall,
    everywhere, observation, reward, terms, ended,
):  # fmt: skip
    """Take a step's samples in; write observation, reward and its terms; say whether a drive tripped.

    The samples have shape (cycles, axes), `weights` are those of TERMS, `fall` is the angle that ends an episode [rad].
    Written are `reward`, shape (n,), `terms`, shape (terms, n), and `ended`: terminated and truncated, shape (2, n).
    The others are those of `act` and `describe`.
    """
    cycles = status.shape[0]
    axes = status.shape[1] // lanes.shape[0]
    some = False
    for k in range(lanes.shape[0]):
        lane = lanes[k]
        begun = lane.step * cycles
        lost = bus[k, min(lane.step, bus.shape[1] - 1)] == LOST
        tripped = False
        tracking, slow, effort, smooth = 0.0, 0.0, 0.0, 0.0
        at = min(begun + cycles - 1, reference.shape[2] - 1)
        for a in range(axes):
            axis = k * axes + a
            for c in range(cycles):
                slot = (begun + c) % DEPTH
                before = (begun + c - 1) % DEPTH
                # A master that missed the SYNC still has the samples of the last one.
                history[slot, 0, axis] = history[before, 0, axis] if lost else status[c, axis]
                history[slot, 1, axis] = history[before, 1, axis] if lost else position[c, axis]
                history[slot, 2, axis] = history[before, 2, axis] if lost else velocity[c, axis]
                history[slot, 3, axis] = history[before, 3, axis] if lost else torque[c, axis]
            c = cycles - 1
            tripped = tripped or status[c, axis] & OPERATION_ENABLED[0] != OPERATION_ENABLED[1]
            error = position_error(reference[k, 0, at], float(position[c, axis]), origin[axis])
            tracking += tolerance(error / scales[axis, 0], TRACKING_MARGIN)
            slow += tolerance((reference[k, 1, at] - velocity[c, axis]) / scales[axis, 1], SPEED_MARGIN)
            effort += tolerance(torque[c, axis] / scales[axis, 2], EFFORT_MARGIN)
            smooth += tolerance(last[axis, 0] - last[axis, 1], SMOOTHNESS_MARGIN)
        fallen = abs(angles[k]) > fall
        lane.fallen = 1 if fallen else 0
        terms[0, k] = tracking / axes
        terms[1, k] = slow / axes
        terms[2, k] = tolerance(angles[k], LOAD_MARGIN) if observation.shape[1] > 8 * axes else 0.0
        terms[3, k] = effort / axes
        terms[4, k] = smooth / axes
        terms[5, k] = 1.0 if tripped or fallen else 0.0
        total = 0.0
        for term in range(terms.shape[0] - 1):
            total += weights[term] * terms[term, k]
        reward[k] = total - weights[5] * terms[5, k]
        lane.step += 1
        ended[0, k] = tripped or fallen
        ended[1, k] = lane.step >= lane.steps
        some = some or tripped or fallen
    describe(lanes, history, reference, scales, origin, last, angles, observation, cycles, everywhere)
    return some
