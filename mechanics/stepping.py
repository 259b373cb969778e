"""One physics step of a packed model, called from compiled code.

Time is staggered (leapfrog): qvel is that at step ends, qpos that at step middles. MuJoCo's semi-implicit step then is
the leapfrog scheme, of second order, at the price of one force evaluation. Damping is of second order because MuJoCo
applies half of it at the step's end, and the applied force contains the other half, at the step's start. Springs and
their dampers are exact by modal.py's corrections.
"""

from __future__ import annotations

import numpy as np

from mechanics.friction import bristle_torque, dry_friction, limited_torque, middle_speed
from mechanics.kernels import native
from mechanics.kernels.compiled import inlined, stage
from mechanics.looking import look

# Speed of a motion held by friction that is rounding error, as a share of the effect of the break-away torque.
ROUNDING = 1e-9

# Beyond this speed [rad/s or m/s] a machine has diverged: 1e5 rad/s is a million rpm.
SPEED_LIMIT = 1e5


# The loop over copies is innermost and does little: LLVM vectorises it as long as it must distinguish at most eight
# pairs of arrays. With copies outside, the code around MuJoCo's step took up to twice as long, most for six axes. Terms
# that are 0 for all copies are left out before the loop.
@stage
def add_product(total, i, factor, rows, k):
    """Add `factor` times row k to row i of a total."""
    if factor != 0.0:
        for copy in range(total.shape[1]):
            total[i, copy] += factor * rows[k, copy]


@stage
def see_motion(lane, v, other, motion, share, e, speed, total):
    """Write into rows `v` and `other` of `lane` the speed of motion e and the force on it."""
    D, copies = speed.shape
    for copy in range(copies):
        lane[v, copy] = 0.0
        lane[other, copy] = 0.0
    for d in range(D):
        add_product(lane, v, motion[e, d], speed, d)
        for copy in range(copies):
            lane[other, copy] += share[e, d, copy] * total[d, copy]


@stage
def see_axis(lane, turned, axis_motion, a, share, e):
    """Write into row `turned` of `lane` the effect of a torque of axis a on motion e."""
    D, copies = axis_motion.shape[1], lane.shape[1]
    for copy in range(copies):
        lane[turned, copy] = 0.0
    for d in range(D):
        factor = axis_motion[a, d]
        if factor != 0.0:
            for copy in range(copies):
                lane[turned, copy] += share[e, d, copy] * factor


@stage
def gather(rows, array):
    """Copy one of MuJoCo's arrays, (C D,), into rows of copies, (D, C)."""
    D, copies = rows.shape
    for d in range(D):
        for copy in range(copies):
            rows[d, copy] = array[copy * D + d]


@stage
def scatter(rows, array):
    """Copy rows of copies, (D, C), into one of MuJoCo's arrays, (C D,)."""
    D, copies = rows.shape
    for d in range(D):
        for copy in range(copies):
            array[copy * D + d] = rows[d, copy]


@stage
def drive(plant, torque, moment, h):
    """Begin `applied`: motor torque (C A,), load torque, springs, half of the damping, over one step of h [s].

    `total` becomes the whole force on each degree of freedom, including MuJoCo's.
    """
    D, copies = plant.damping.shape
    axis_motion, disturbance, load_torque = plant.axis_motion, plant.disturbance, plant.load_torque
    A = axis_motion.shape[0]
    position, speed, applied, total = plant.position, plant.speed, plant.applied, plant.total
    bias, damping, diverged, lane = plant.bias, plant.damping, plant.diverged, plant.lane
    if plant.profile_at.shape[0] > 0:
        follow_profile(plant, h)
    profile_now = plant.profile_now
    for copy in range(copies):
        lane[0, copy] = load_torque[copy] + profile_now[copy]
        if not abs(lane[0, copy]) < 1e9:  # also true of nan
            diverged[copy] = 1
    for a in range(A):
        for copy in range(copies):
            if not abs(torque[copy * A + a]) < 1e9:
                diverged[copy] = 1
    for d in range(D):
        for copy in range(copies):
            applied[d, copy] = disturbance[d, copy] * lane[0, copy]
        for a in range(A):
            factor = axis_motion[a, d]
            if factor != 0.0:
                for copy in range(copies):
                    applied[d, copy] += factor * torque[copy * A + a]
    if plant.elastic:
        held, stiffness, held_moment, spring_zero = plant.held, plant.stiffness, plant.held_moment, plant.spring_zero
        damper = plant.damper
        for d in range(D):
            for copy in range(copies):
                total[d, copy] = applied[d, copy] - bias[d, copy]
        for d in range(D):
            for k in range(D):
                zero = spring_zero[k]
                for copy in range(copies):
                    applied[d, copy] += held[d, k, copy] * total[k, copy]
                for copy in range(copies):
                    applied[d, copy] -= stiffness[d, k, copy] * (position[k, copy] - zero)
                for copy in range(copies):
                    applied[d, copy] -= damper[d, k, copy] * speed[k, copy]
        for a in range(A):
            for copy in range(copies):
                lane[0, copy] = moment[copy * A + a]
            for d in range(D):
                for copy in range(copies):
                    applied[d, copy] += held_moment[d, a, copy] * lane[0, copy]
    half = 0.5 if plant.staggered else 0.0
    given = 0.0 if plant.looking else half
    ahead = plant.ahead
    for d in range(D):
        # MuJoCo's half was computed at the speed ahead in `look`.
        for copy in range(copies):
            applied[d, copy] -= half * damping[d, copy] * (speed[d, copy] - ahead[copy * D + d])
        for copy in range(copies):
            total[d, copy] = applied[d, copy] - bias[d, copy] - given * damping[d, copy] * speed[d, copy]
    if plant.constant:
        # The part that the first half of MuJoCo's step would have computed.
        passive = plant.qfrc_passive
        for d in range(D):
            for copy in range(copies):
                passive[copy * D + d] = -half * damping[d, copy] * speed[d, copy]


@stage
def follow_profile(plant, h):
    """Interpolate the table of torque at the middle of this step."""
    D, copies = plant.damping.shape
    at, profile = plant.profile_at, plant.profile
    for copy in range(copies):
        x = 0.0
        if plant.profile_of_position:
            for d in range(D):
                x += plant.axis_position[0, d] * plant.qpos[copy * D + d]
        else:
            x = plant.clock[copy] + 0.5 * h
            plant.clock[copy] += h
        if plant.profile_period > 0.0:
            x = at[0] + (x - at[0]) % plant.profile_period
        k = np.searchsorted(at, x)
        if k == 0:
            plant.profile_now[copy] = profile[copy, 0]
        elif k == at.shape[0]:
            plant.profile_now[copy] = profile[copy, k - 1]
        else:
            share = (x - at[k - 1]) / (at[k] - at[k - 1])
            plant.profile_now[copy] = profile[copy, k - 1] + share * (profile[copy, k] - profile[copy, k - 1])


@stage
def press(plant, moment, h):
    """Add the force of contacts: a spring and a damper beyond the gap, which push and never pull."""
    D, copies = plant.damping.shape
    contact, carried, axis_motion, lane = plant.contact, plant.carried, plant.axis_motion, plant.lane
    position, speed, applied, total = plant.position, plant.speed, plant.applied, plant.total
    motion, share, mass = plant.motion, plant.share, plant.mass
    A, F = axis_motion.shape[0], plant.friction.shape[0]
    # Rows of `lane`.
    pressed, v, other, correction, force, turned = 0, 1, 2, 3, 4, 5
    for b in range(contact.shape[0]):
        e = F + b
        for copy in range(copies):
            lane[5, copy] = 0.0
        for d in range(D):
            add_product(lane, 5, motion[e, d], position, d)
        touching = 0
        for copy in range(copies):
            x, low, high = lane[5, copy], contact[b, 0, copy], contact[b, 1, copy]
            lane[pressed, copy] = max(low - x, 0.0) + min(high - x, 0.0)
        for copy in range(copies):
            touching += 1 if lane[pressed, copy] != 0.0 else 0
            carried[copy, b] = 0.0
        if touching == 0:
            continue
        see_motion(lane, v, other, motion, share, e, speed, total)
        for copy in range(copies):
            lane[correction, copy] = contact[b, 4, copy] * lane[other, copy]
        for a in range(A):
            see_axis(lane, turned, axis_motion, a, share, e)
            for copy in range(copies):
                lane[correction, copy] += contact[b, 5, copy] * lane[turned, copy] * moment[copy * A + a]
        for copy in range(copies):
            spring, damping = contact[b, 2, copy] * lane[pressed, copy], contact[b, 3, copy]
            # The damper at the step's mean speed, which it reduces itself: stable for any damping.
            half = 0.5 * h / mass[e, copy]
            middle = lane[v, copy] + half * (lane[other, copy] + lane[correction, copy] + spring)
            lane[force, copy] = spring - damping * middle / (1.0 + half * damping)
        for copy in range(copies):
            pushes = lane[force, copy] * lane[pressed, copy] > 0.0
            lane[force, copy] = lane[force, copy] if pushes else 0.0
            lane[correction, copy] = lane[correction, copy] if pushes else 0.0
        for copy in range(copies):
            lane[force, copy] += lane[correction, copy]
        # With the correction it is the transmitted force, mean over the step.
        for copy in range(copies):
            carried[copy, b] = lane[force, copy]
        for d in range(D):
            add_product(applied, d, motion[e, d], lane, force)
            add_product(total, d, motion[e, d], lane, force)


@stage
def rub(plant, h):
    """Add friction motion by motion: each depends on all other forces, for later frictions on the previous step's."""
    D, copies = plant.damping.shape
    friction, brake, carries, carried = plant.friction, plant.brake, plant.carries, plant.carried
    speed, applied, total, diverged = plant.speed, plant.applied, plant.total, plant.diverged
    motion, share, mass, bristle, stuck = plant.motion, plant.share, plant.mass, plant.bristle, plant.stuck
    holding, lane = plant.holding, plant.lane
    F = friction.shape[0]
    # Rows of `lane`.
    v, other, coulomb, breakaway, limit = 0, 1, 2, 3, 4
    for f in range(1, F):
        for d in range(D):
            add_product(total, d, motion[f, d], holding, f)
    for f in range(F):
        if f > 0:
            for d in range(D):
                add_product(total, d, -motion[f, d], holding, f)
        see_motion(lane, v, other, motion, share, f, speed, total)
        for copy in range(copies):
            if not abs(h * lane[other, copy]) < SPEED_LIMIT * mass[f, copy]:
                # Checked before MuJoCo's own check, which would write a log file.
                diverged[copy] = 1
        # Holding torque besides the row's own: a brake, or a screw under force.
        for copy in range(copies):
            lane[limit, copy] = brake[f, copy]
        if carries[f] >= 0:
            for copy in range(copies):
                lane[limit, copy] += friction[f, 7, copy] * abs(carried[copy, carries[f]])
        for copy in range(copies):
            lane[coulomb, copy] = friction[f, 0, copy] + lane[limit, copy]
        for copy in range(copies):
            lane[breakaway, copy] = friction[f, 1, copy] + lane[limit, copy]
        for copy in range(copies):
            lane[limit, copy] = middle_speed(lane[v, copy], lane[other, copy], mass[f, copy], h)
        for copy in range(copies):
            lane[limit, copy] = dry_friction(
                lane[limit, copy], lane[coulomb, copy], lane[breakaway, copy], friction[f, 2, copy]
            )
        for copy in range(copies):
            holding[f, copy] = limited_torque(
                lane[v, copy], lane[other, copy], mass[f, copy], h,
                lane[limit, copy], friction[f, 3, copy], friction[f, 4, copy],
            )  # fmt: skip
        for copy in range(copies):
            rest = abs(mass[f, copy] * lane[v, copy] + h * (lane[other, copy] + holding[f, copy]))
            stuck[f, copy] = 1 if rest < ROUNDING * h * lane[breakaway, copy] else 0
        for copy in range(copies):
            if friction[f, 5, copy] > 0.0 and not diverged[copy]:
                stuck[f, copy] = 0
                holding[f, copy], bristle[copy, f] = bristle_torque(
                    lane[v, copy], lane[other, copy], mass[f, copy], h, bristle[copy, f],
                    friction[f, 5, copy], friction[f, 6, copy], lane[coulomb, copy], lane[breakaway, copy],
                    friction[f, 2, copy], friction[f, 3, copy], friction[f, 4, copy],
                )  # fmt: skip
        for d in range(D):
            add_product(applied, d, motion[f, d], holding, f)
            add_product(total, d, motion[f, d], holding, f)


@stage
def freeze(plant):
    """Hold diverged copies at rest, so that they do not disturb others or overflow."""
    D, copies = plant.damping.shape
    diverged = plant.diverged
    found = 0
    for copy in range(copies):
        found += diverged[copy]
    if found == 0:
        return
    for copy in range(copies):
        if diverged[copy]:
            for d in range(D):
                k = copy * D + d
                plant.qpos[k] = 0.0
                plant.qvel[k] = 0.0
                plant.qvel_before[k] = 0.0
                plant.qfrc_applied[k] = 0.0
                plant.qfrc_passive[k] = 0.0
                plant.bias[d, copy] = 0.0
            for f in range(plant.holding.shape[0]):
                plant.holding[f, copy] = 0.0
            plant.load_torque[copy] = 0.0


@stage
def report(plant, torque, moment, h, theta, omega, reaction, position):
    """Write the axes' values at the step's end; correct MuJoCo's positions for when within the step torque acted."""
    D, copies = plant.damping.shape
    place, before, speed, lane, diverged = plant.position, plant.speed, plant.reached, plant.lane, plant.diverged
    axis_motion, axis_position, axis_start = plant.axis_motion, plant.axis_position, plant.axis_start
    stuck, motion, share, mass = plant.stuck, plant.motion, plant.share, plant.mass
    kick, ends, ends_of_speed, spring_zero = plant.axis_kick, plant.ends, plant.ends_of_speed, plant.spring_zero
    A = axis_motion.shape[0]
    gather(place, plant.qpos)
    for f in range(stuck.shape[0]):
        held = 0
        for copy in range(copies):
            held += stuck[f, copy]
            lane[0, copy] = 0.0
        if held == 0:
            continue
        for d in range(D):
            add_product(lane, 0, motion[f, d], speed, d)
        for copy in range(copies):
            lane[0, copy] = lane[0, copy] if stuck[f, copy] else 0.0
        for d in range(D):
            for copy in range(copies):
                speed[d, copy] -= share[f, d, copy] * lane[0, copy]
    if plant.staggered:
        for a in range(A):
            for copy in range(copies):
                lane[0, copy] = moment[copy * A + a] * h
            for d in range(D):
                for copy in range(copies):
                    place[d, copy] -= kick[a, d, copy] * lane[0, copy]
    # From the step's middle to its end: motions without a spring are uniform after their impulse in the middle.
    back = 0.5 * h if plant.staggered else 0.0
    rate = 1.0 / h
    # Rows of `lane`.
    angle, w, acceleration, at = 0, 1, 2, 3
    for a in range(A):
        for row in range(4):
            for copy in range(copies):
                lane[row, copy] = 0.0
        for d in range(D):
            add_product(lane, angle, axis_motion[a, d], place, d)
            add_product(lane, w, axis_motion[a, d], speed, d)
            add_product(lane, acceleration, axis_motion[a, d], before, d)
            factor = axis_position[a, d]
            if factor != 0.0:
                for copy in range(copies):
                    lane[at, copy] += factor * (place[d, copy] - back * speed[d, copy])
        if plant.elastic:
            for d in range(D):
                zero = spring_zero[d]
                for copy in range(copies):
                    lane[angle, copy] += ends[a, d, copy] * (place[d, copy] - back * speed[d, copy] - zero)
                for copy in range(copies):
                    lane[angle, copy] += ends_of_speed[a, d, copy] * speed[d, copy]
        start = axis_start[a]
        for copy in range(copies):
            lane[acceleration, copy] = (lane[w, copy] - lane[acceleration, copy]) * rate
        for copy in range(copies):
            theta[copy * A + a] = lane[angle, copy] - start - back * lane[w, copy]
        for copy in range(copies):
            omega[copy * A + a] = lane[w, copy]
        for copy in range(copies):
            reaction[copy * A + a] = torque[copy * A + a] - mass[a, copy] * lane[acceleration, copy]
        for copy in range(copies):
            position[copy * A + a] = lane[at, copy]
    if plant.contact.shape[0] > 0 and plant.staggered:
        report_contacts(plant, back, theta)
    scatter(place, plant.qpos)
    scatter(speed, plant.qvel)
    for copy in range(copies):
        if diverged[copy]:
            for axis in range(copy * A, copy * A + A):
                theta[axis], omega[axis], reaction[axis], position[axis] = 0.0, 0.0, 0.0, 0.0


@stage
def report_contacts(plant, back, theta):
    """Correct the axes' angles at the step's end for the springs of contacts, as `ends` does for joints."""
    D, copies = plant.damping.shape
    place, speed, lane, contact = plant.position, plant.reached, plant.lane, plant.contact
    axis_motion, motion, share, carried = plant.axis_motion, plant.motion, plant.share, plant.carried
    A, F = axis_motion.shape[0], plant.friction.shape[0]
    # Rows of `lane`.
    x, pressed, turned = 0, 1, 2
    for b in range(contact.shape[0]):
        e = F + b
        touching = 0
        for copy in range(copies):
            touching += 1 if carried[copy, b] != 0.0 else 0
        if touching == 0:
            continue
        for copy in range(copies):
            lane[x, copy] = 0.0
        for d in range(D):
            add_product(lane, x, motion[e, d], place, d)
            add_product(lane, x, -back * motion[e, d], speed, d)
        for copy in range(copies):
            low, high = contact[b, 0, copy], contact[b, 1, copy]
            deep = max(low - lane[x, copy], 0.0) + min(high - lane[x, copy], 0.0)
            # By this copy's own force: contacts of other copies must not change anything here.
            lane[pressed, copy] = deep if carried[copy, b] != 0.0 else 0.0
        for a in range(A):
            see_axis(lane, turned, axis_motion, a, share, e)
            for copy in range(copies):
                theta[copy * A + a] -= contact[b, 6, copy] * lane[turned, copy] * lane[pressed, copy]


@inlined
def step(plant, torque, moment, h, theta, omega, reaction, position):
    """Advance every copy by h [s].

    Args:
        plant: The packed model.
        torque: Mean motor torque over the step [N*m], shape (C A,).
        moment: Mean of torque times (time minus the step's middle) [N*m*s], shape (C A,): torque that comes late in
            the step has moved the rotor less by the next.
        h: Step [s].
        theta: Rotor angle at the step's end [rad], written, shape (C A,).
        omega: Rotor speed at the step's end [rad/s], written, shape (C A,).
        reaction: Mean torque of the load against the rotor over the step [N*m], written, shape (C A,).
        position: Of what presses the axis's switches, at the step's end [rad or m], written, shape (C A,).
    """
    D, copies = plant.damping.shape
    reached, diverged = plant.reached, plant.diverged
    if plant.varying:
        look(plant)
    gather(plant.position, plant.qpos)
    gather(plant.speed, plant.qvel)
    drive(plant, torque, moment, h)
    if plant.contact.shape[0] > 0:
        press(plant, moment, h)
    rub(plant, h)
    scatter(plant.applied, plant.qfrc_applied)
    freeze(plant)
    if plant.constant or (plant.looking and plant.staggered):
        native.step2(plant.model_address, plant.data_address)
    else:
        native.step(plant.model_address, plant.data_address)
    gather(reached, plant.qvel)
    for d in range(D):
        for copy in range(copies):
            if not abs(reached[d, copy]) < SPEED_LIMIT:
                diverged[copy] = 1
    freeze(plant)
    report(plant, torque, moment, h, theta, omega, reaction, position)
