"""The checks before a tuning on a bus; they only read: nothing is written, no state is changed.

They check everything that a run needs: which nodes answer, whether the objects exist, how fast answers come, whether
the samples fit into PDOs, whether the drive monitors its master, and whether the drive's settings agree with the
motor's data.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from drive_env import cia402
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.dictionary.entries import ObjectName
from drive_env.dictionary.roles import Role
from drive_env.drives.currents import ampere_per_limit, current_limit_roles, read_current_limit, to_counts
from drive_env.drives.interface import bus_of
from drive_env.master.ethercat.image_layout import INPUTS, OUTPUTS
from drive_env.trials.demand import COMPUTED, is_recorded

if TYPE_CHECKING:
    from tuning.target import Target

OK, NOTE, NO = "ok", "note", "no"  # a run would begin; would begin despite a remark; would not begin

READS = 50  # of the statusword, to measure how fast answers come
SLOWEST = 0.01  # s, limit of their median; a trial that watches for oscillation reads more often
AT_REST = 0.02  # of the speed limit
BY_ENCODER = 3  # 2055h
# Objects that a trial samples in addition to the envelope's, and those that it plays (gain_trial.py,
# frequency_response.py).
SAMPLED, PLAYED = (
    (cia402.POSITION_ACTUAL, cia402.POSITION_DEMAND, cia402.TORQUE_ACTUAL, cia402.STATUSWORD),
    (cia402.TARGET_POSITION,),
)


class Check(NamedTuple):
    """A check: its name, its verdict (OK, NOTE or NO), and the result, with the remedy if it is NO."""

    what: str
    verdict: str
    found: str


class Write(NamedTuple):
    """An object that a run would write.

    key: Index and sub-index of the object.
    name: Name of the object.
    values: The range of written values, or the values, as text.
    why: Purpose.
    present: Present value of each axis; None if it cannot be read.
    stays: Whether the drive has the new value after the run; all others are restored.
    """

    key: tuple[int, int]
    name: str
    values: str
    why: str
    present: tuple[int, ...] | None
    stays: bool


class Rehearsal(NamedTuple):
    """The checks, and the objects that a run would write."""

    checks: tuple[Check, ...]
    writes: tuple[Write, ...]

    @property
    def refused(self) -> list[Check]:
        """The checks that prevent a run; empty if it would start."""
        return [check for check in self.checks if check.verdict == NO]


def rehearse(target: Target, *, keep: bool = True) -> Rehearsal:
    """Check drives on a bus without writing, and list the objects that a run would write.

    Args:
        target: The drives, as `tuning.target.on_bus` opens them.
        keep: Whether the run would have the drives store the gains over a power cycle.

    Raises:
        BusError: If a node no longer answers.
    """
    checks: list[Check] = []
    for axis in range(target.num_axes):
        prefix = f"{_place(target, axis)}: " if target.num_axes > 1 else ""
        checks += [check._replace(what=prefix + check.what) for look in LOOKS for check in look(target, axis)]
    writes = []
    for name, values, why, stays in _plan(target, keep):
        entry = bus_of(target.drives).description.dictionary.find(name)
        key = entry.index, entry.sub
        try:
            present = tuple(map(int, target.drives.read(key)))
        except ObjectAccessError as error:
            present = None
            checks.append(Check(f"object {key[0]:04X}h:{key[1]:02X}", NO, f"{error}"))
        writes.append(Write(key, entry.name, values, why, present, stays))
    return Rehearsal(tuple(checks), tuple(writes))


def _read(target: Target, name: Any, axis: int) -> int:
    return int(target.drives.read(name)[axis])


def _node(target: Target, axis: int) -> int:
    """Return the address of the node that has an axis."""
    drives = bus_of(target.drives)
    return drives.nodes[axis // drives.description.num_axes]


def _place(target: Target, axis: int) -> str:
    """Return an axis' node as messages name it, with the axis' number if the node has several."""
    per_node = bus_of(target.drives).description.num_axes
    name = f"{'node' if _is_on_can(target) else 'position'} {_node(target, axis)}"
    return name if per_node == 1 else f"{name} axis {axis % per_node}"


def _is_on_can(target: Target) -> bool:
    from drive_env.master.can.can_link import CanLink

    return isinstance(bus_of(target.drives).link, CanLink)


# --- the checks -------------------------------------------------------------------------------------------------------
def _identity(target: Target, axis: int) -> Iterator[Check]:
    drives, facts = bus_of(target.drives), []
    for name, word in ((0x1008, ""), (0x1009, "hardware "), (0x100A, "software "), ((0x1018, 1), "vendor "),
                       ((0x1018, 2), "product "), ((0x1018, 3), "revision "), ((0x1018, 4), "serial ")):  # fmt: skip
        if not drives.description.has(name):
            continue
        found = drives.read(name)[axis]
        facts.append(word + (f"{found:X}h" if isinstance(name, tuple) else str(found)))
    yield Check("identity", OK, f"{_place(target, axis)} is a {target.device.name}: {', '.join(facts)}")


def _state(target: Target, axis: int) -> Iterator[Check]:
    status = _read(target, cia402.STATUSWORD, axis)
    names = ("switch on disabled", "ready to switch on", "switched on", "operation enabled", "quick stop", "fault")
    patterns = (cia402.SWITCH_ON_DISABLED, cia402.READY_TO_SWITCH_ON, cia402.SWITCHED_ON, cia402.OPERATION_ENABLED,
                cia402.QUICK_STOP_ACTIVE, cia402.FAULT)  # fmt: skip
    found = next(
        (name for name, (mask, value) in zip(names, patterns, strict=True) if status & mask == value), "between two"
    )
    text = f"{found} (statusword {status:04X}h)"
    if found == "operation enabled":
        yield Check("state", NO, f"{text}: another master controls this axis; stop it, or disable the axis")
    elif found == "fault":
        yield Check("state", NOTE, f"{text}, error register {_read(target, 0x1001, axis):02X}h: a run would reset it "
                                   "once; remove its cause first")  # fmt: skip
    else:
        yield Check("state", OK, text)
    speed = abs(_read(target, cia402.VELOCITY_ACTUAL, axis)) / target.speed_counts()[axis]
    if speed > AT_REST * target.speed:
        yield Check("standstill", NO, f"the axis turns at {speed:.3g} rad/s; bring it to rest")
    else:
        yield Check("standstill", OK, "the axis is at rest")


def _answers(target: Target, axis: int) -> Iterator[Check]:
    drives, times = bus_of(target.drives), []
    entry = drives.description.dictionary.find(cia402.STATUSWORD)
    for _ in range(READS):
        start = time.perf_counter()
        drives.read_axis(entry, axis)
        times.append(time.perf_counter() - start)
    median, worst = float(np.median(times)), max(times)
    text = f"SDO answers in {1e3 * median:.2f} ms (median of {READS}), {1e3 * worst:.2f} ms at the worst"
    if median > SLOWEST:
        yield Check("interface", NO, f"{text}; {1e3 * SLOWEST:g} ms are needed: take a faster adapter or bit rate")
    else:
        yield Check("interface", OK, text)


def _samples(target: Target, axis: int) -> Iterator[Check]:
    """Check that the sampled and played objects fit into PDOs, and that these have 11-bit identifiers."""
    if not _is_on_can(target):
        yield _images(target)
        return
    from drive_env.canopen.frames import IDENTIFIER, RPDO, TPDO
    from drive_env.master.can.pdo import INTO_DRIVE, OUT_OF_DRIVE, plan

    drives = bus_of(target.drives)
    description, watched = drives.description, []
    if drives.safety is not None:
        watched = drives.safety.watched()
    wanted = [description.dictionary.find(name) for name in SAMPLED]
    welcome = [entry for entry in watched if entry not in wanted]
    out = plan(description, [*wanted, *welcome], OUT_OF_DRIVE) or plan(description, wanted, OUT_OF_DRIVE)
    into = plan(description, [description.dictionary.find(name) for name in PLAYED], INTO_DRIVE)
    if out is None or into is None:
        yield Check("PDO", NO, f"{len(wanted)} samples do not fit into the drive's TPDOs")
        return
    texts = []
    for name, groups, communication, standard in (("TPDO", out, 0x1800, TPDO), ("RPDO", into, 0x1400, RPDO)):
        for number, group in enumerate(groups):
            cob_id = _read(target, (communication + number, 1), axis)
            identifier = cob_id & IDENTIFIER or standard[number] + _node(target, axis)
            if cob_id & 1 << 29:
                yield Check("PDO", NO, f"{name} {number + 1} has a 29-bit identifier ({cob_id:08X}h in "
                                       f"{communication + number:04X}h:01); give it an 11-bit one")  # fmt: skip
                return
            objects = ", ".join(f"{entry.index:04X}h" for entry in group)
            texts.append(f"{name} {number + 1} ({identifier:03X}h) would carry {objects}")
    yield Check("PDO", OK, "; ".join(texts))


def _images(target: Target) -> Check:
    """Check that the process images of a slave can carry the sampled and played objects."""
    drives = bus_of(target.drives)
    find = drives.description.dictionary.find
    try:
        drives.link.process.check_played([find(name) for name in PLAYED])
    except ObjectAccessError as error:
        return Check("image", NO, f"{error}")
    demand = is_recorded(drives)
    sampled = [name for name in SAMPLED if demand or name != cia402.POSITION_DEMAND]
    if not drives.can_record(sampled):
        names = ", ".join(find(name).label for name in sampled)
        return Check("image", NO, f"no process image of this drive has {names} together")
    objects = ", ".join(f"{find(name).index:04X}h" for name in sampled)
    text = f"the process images would carry {objects}"
    return Check("image", OK, text) if demand else Check("image", NOTE, f"{text}; {COMPUTED}")


def _error_control(target: Target, axis: int) -> Iterator[Check]:
    """Check by which error control the drive would stop if this process died."""
    drives, description = bus_of(target.drives), bus_of(target.drives).description
    silence = None if drives.safety is None else drives.safety.limits.silence
    if silence is None:
        yield Check("heartbeat", NOTE, "the drive would not stop if this process ended without stopping it")
    elif not _is_on_can(target):
        yield Check("watchdog", OK, "the slave can monitor its master by the watchdog of its process data: in real "
                                    f"time 0420h would be set to {1e3 * silence:.0f} ms")  # fmt: skip
    elif description.has((0x1016, 1)):
        value = _read(target, (0x1016, 1), axis)
        now = f"node {value >> 16 & 0x7F}, {value & 0xFFFF} ms" if value else "no node"
        yield Check("heartbeat", OK, f"the drive can monitor its master by heartbeat: 1016h, now {now}; in real time "
                                     f"it "
                                     f"would be set to {1e3 * silence:.0f} ms")  # fmt: skip
    elif description.has((0x100C, 0)) and description.has((0x100D, 0)):
        yield Check(
            "heartbeat",
            OK,
            "the drive can monitor its master by life guarding: 100Ch and 100Dh would be set in real time",
        )
    else:
        yield Check(
            "heartbeat", NO, "the drive would not stop by itself if this process ended: it has neither 1016h nor 100Ch"
        )


def _motor(target: Target, axis: int) -> Iterator[Check]:
    motor, kind = target.motor, _read(target, Role.MOTOR_TYPE, axis)
    if kind == 0:
        yield Check(
            "motor",
            NO,
            "the drive is not commissioned for a motor (its motor type is 0): commission it first (drive-env "
            "commission)",
        )
        return
    rows = [("encoder counts", Role.ENCODER_STEPS, motor.encoder_counts)]
    if motor.kind != "dc":
        rows += [
            ("pole pairs", Role.POLE_PAIRS, motor.n_p),
            ("commutation by the encoder", Role.COMMUTATION, BY_ENCODER),
        ]
    wrong = []
    for what, key, wanted in rows:
        if (has := _read(target, key, axis)) != wanted:
            index, sub = target.device.roles[key]
            wrong.append(f"{index:04X}h:{sub:02X} ({what}) is {has}, and {wanted} is needed for {motor.name}")
    if wrong:
        yield Check(
            "motor", NO, f"{'; '.join(wrong)}: give the connected motor by --motor, or commission the drive for it"
        )
    else:
        facts = ", ".join(f"{what} {wanted}" if wanted > BY_ENCODER else what for what, _, wanted in rows)
        yield Check("motor", OK, f"the drive is set up for {motor.name}: {facts}")


def _supply(target: Target, axis: int) -> Iterator[Check]:
    volts = float(target.supply[axis])
    text = f"{volts:g} V entered; the drive cannot measure it: measure it yourself, since the gains scale with it"
    # A drive without chopper objects controls its chopper itself.
    chops = Role.BRAKE_CHOPPER in target.device.roles and _read(target, Role.BRAKE_CHOPPER, axis) != 0
    chopper = _read(target, Role.BRAKE_CHOPPER_VOLTAGE, axis) * 0.1 if chops else np.inf
    if chopper <= volts:
        yield Check("supply", NO, f"{volts:g} V entered, and the brake chopper acts from {chopper:g} V on: it would "
                                  "overheat; correct one of them")  # fmt: skip
    else:
        yield Check("supply", OK, text)


def _travel(target: Target, axis: int) -> Iterator[Check]:
    here, scale = _read(target, cia402.POSITION_ACTUAL, axis), target.increments()[axis]
    low, high = target.low[axis], target.high[axis]
    if not np.isfinite([low, high]).all():
        yield Check("travel", OK, "free to both sides")
        return
    ends = round(here + low * scale), round(here + high * scale)
    text = f"{low:.3g} to {high:.3g} rad from here: 6064h from {ends[0]} to {ends[1]}, now {here}"
    own = _read(target, (cia402.POSITION_LIMITS, 1), axis), _read(target, (cia402.POSITION_LIMITS, 2), axis)
    if own[0] < own[1] and (ends[0] < own[0] or ends[1] > own[1]):
        yield Check("travel", NO, f"{text}; the drive's own limits 607Dh are {own[0]} to {own[1]}: give less --travel")
    else:
        yield Check("travel", OK, text)


def _envelope(target: Target, axis: int) -> Iterator[Check]:
    """Report the limits of the envelope that would stop the drives during a run."""
    if target.drives.safety is None:
        yield Check("envelope", NO, "there is none: open the drives with a safety envelope")
        return
    limits = target.drives.safety.limits
    reasons = [] if limits.position is None else [f"a position beyond {limits.position[0]} to {limits.position[1]}"]
    reasons += ["a current that oscillates"] if limits.oscillation else []
    reasons += [] if limits.stall is None else [f"{limits.stall:g} s without a call while an axis is enabled"]
    yield Check("envelope", OK, f"a quick stop for {', '.join(reasons)}, and beyond the drive's own limits")


def _limits(target: Target, axis: int) -> Iterator[Check]:
    amperes, (index, _) = read_current_limit(target.drives)[axis], target.device.roles[Role.CURRENT_LIMIT]
    text = f"at most {target.speed:.4g} rad/s and {target.current:.3g} A are commanded during identification"
    if amperes <= 0.0:
        yield Check("limits", NO, f"{text}; the drive's limit {index:04X}h is 0 A: set it to the motor's peak current")
    else:
        yield Check("limits", OK, f"{text}; trials may take the drive's own limit, {index:04X}h, {amperes:.3g} A")
    window = _read(target, cia402.FOLLOWING_WINDOW, axis)
    yield Check("following error", OK, f"window 6065h is {window} inc; it is widened during the frequency response")


def _gains(target: Target, axis: int) -> Iterator[Check]:
    from drive_env.drives.raw_gains import read_gains
    from tuning.search.trial_bench import first_gains

    now = read_gains(target.drives)[axis]
    has, begins = (_named(target, gains) for gains in (now, first_gains(target)[axis]))
    fresh = "" if now.any() else " (factory-fresh)"
    yield Check("gains", OK, f"now {has}{fresh}; a run begins with {begins}, from the motor's data sheet")


def _named(target: Target, gains: Any) -> str:
    return ", ".join(f"{name} {value}" for name, value in zip(target.device.gains.titles, gains, strict=True))


LOOKS = (_identity, _state, _answers, _samples, _error_control, _motor, _supply, _travel, _envelope, _limits, _gains)


# --- what would be written --------------------------------------------------------------------------------------------
def _plan(target: Target, keep: bool) -> Iterator[tuple[ObjectName, str, str, bool]]:
    """Yield the objects that a run writes: name, range of values, purpose, and whether the value stays afterwards."""
    from tuning.identify.wiring import FINDINGS

    turn = target.increments()
    speed = round(float(np.max(target.speed * target.speed_counts())))
    ends = target.low * turn, target.high * turn
    here = target.drives.read(cia402.POSITION_ACTUAL)
    finite = all(np.isfinite(end).all() for end in ends)
    way = f"{round(float(np.min(here + ends[0])))}...{round(float(np.max(here + ends[1])))}" if finite else "any"
    amperes = int(np.max(to_counts(target.drives, target.current)))
    limit = int(np.max(np.rint(target.current / ampere_per_limit(target.drives))))
    for gain in target.device.gains.rows:
        yield gain.key, f"1...{gain.highest}", f"gain on trial, {gain.title}", True
    yield (cia402.CONTROLWORD, 0), "0, 2, 6, 7, Fh, 1Fh, 80h", "enable, start moves, stop, reset a fault", False
    yield (cia402.MODE, 0), "0, 1, 8, 9, 10", "pp for moves, csp, csv and cst for identification", False
    yield (cia402.TARGET_POSITION, 0), way, "moves", False
    yield (cia402.TARGET_VELOCITY, 0), f"{-speed}...{speed}", "speed during the frequency response, in csv", False
    yield (cia402.TARGET_TORQUE, 0), f"{-amperes}...{amperes}", "current pulses and excitation, in cst", False
    for index in (cia402.VELOCITY_OFFSET, cia402.TORQUE_OFFSET):
        if bus_of(target.drives).description.has((index, 0)):
            yield (index, 0), "0", "no speed or current of before, once the gains are put back", False
    yield (cia402.PROFILE_VELOCITY, 0), f"1...{speed}", "speed of the moves", False
    for index in (cia402.PROFILE_ACCELERATION, cia402.PROFILE_DECELERATION, cia402.QUICK_STOP_DECELERATION):
        yield (index, 0), "above 0", "ramps of the moves and of a stop", False
    for role in current_limit_roles(target.drives):
        yield role, f"up to {limit}", "current limit during identification", False
    yield Role.OPEN_LOOP_CURRENT, f"0...{amperes}", "current of the encoder's check", False
    for role, wrong in FINDINGS.items():
        if role in target.device.roles:
            yield role, "0, 1", f"if the check finds it wrong: {wrong}", True
    yield Role.COMMUTATION, "1, 3", "open loop for the encoder's check, then the encoder again", False
    yield (cia402.FOLLOWING_WINDOW, 0), "up to 100 turns", "following error during the frequency response", False
    for sub, value in ((1, "1"), (2, "-3")):
        yield (cia402.INTERPOLATION_PERIOD, sub), value, "interpolation period of csv and cst, 1 ms", False
    yield from _communication(target)
    if keep and bus_of(target.drives).description.has((0x1010, 1)):
        yield (0x1010, 1), "65766173h", '"save": the gains are stored', True


def _communication(target: Target) -> Iterator[tuple[ObjectName, str, str, bool]]:
    """Yield the writes that map samples to PDOs and have the drive monitor its master."""
    if _is_on_can(target):
        yield from _pdos(target)
    else:
        for index in (OUTPUTS, INPUTS):
            for sub in (0, 1):
                yield (index, sub), "", "which process image is carried, chosen in Pre-Op", False
    yield from _safeguards(target)


def _pdos(target: Target) -> Iterator[tuple[ObjectName, str, str, bool]]:
    """Yield the writes to PDOs."""
    from drive_env.master.can.pdo import OUT_OF_DRIVE, slots

    known = bus_of(target.drives).description.dictionary
    for name, communication, mapping, pdos in (("RPDO", 0x1400, 0x1600, 1), ("TPDO", 0x1800, 0x1A00, 2)):
        for number in range(pdos):
            for entry in known:
                if entry.index == mapping + number or (entry.index == communication + number and entry.sub in (1, 2)):
                    why = f"{name} {number + 1} off, mapped as above, on again, with SYNC"
                    yield (entry.index, entry.sub), "", why, False
    for number in slots(bus_of(target.drives).description, OUT_OF_DRIVE, 0).numbers[2:]:
        yield (0x1800 + number, 1), "", f"TPDO {number + 1} off during the run, if it is sent with SYNC", False


def _safeguards(target: Target) -> Iterator[tuple[ObjectName, str, str, bool]]:
    """Yield the writes of limits and monitoring by which the drive stops by itself."""
    if np.isfinite(target.low).all() and np.isfinite(target.high).all():
        for sub, end in ((1, "lower"), (2, "upper")):
            if bus_of(target.drives).description.has((cia402.POSITION_LIMITS, sub)):
                yield (
                    (cia402.POSITION_LIMITS, sub),
                    "the travel",
                    f"{end} software limit, set in the drive during the run",
                    False,
                )
    if bus_of(target.drives).description.has(cia402.QUICK_STOP_OPTION):
        yield (
            (cia402.QUICK_STOP_OPTION, 0),
            "5, 6",
            "an axis that is stopped is held at first, in case of a hanging load",
            False,
        )
    if not _is_on_can(target):
        return
    if target.drives.time_waits and bus_of(target.drives).description.has(0x1017):
        yield (0x1017, 0), "1", "for a hundredth of a second: to check that time waits for SYNC", False
    in_real_time = (
        ((0x1016, 1), "this process, 500 ms", "the node that the drive monitors, in real time"),
        ((0x1029, 1), "0", "reaction to a missing heartbeat, where it was 1"),
    )
    for key, values, why in in_real_time:
        if bus_of(target.drives).description.has(key):
            yield key, values, why, False
