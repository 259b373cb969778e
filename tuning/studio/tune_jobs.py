"""The jobs of the page Tune, which run in the drives' thread."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from drive_env import cia402
from drive_env.drives import motion
from drive_env.drives.interface import CYCLE, Drives, device_of
from drive_env.drives.raw_gains import read_gains, write_gains
from drive_env.loops.dynamics import DEFAULT
from drive_env.studio.motion_jobs import disable, only, select_mode
from drive_env.studio.scope_view import channel_of
from drive_env.studio.sentences import sentence
from drive_env.trials.response import step_metrics
from mechanics.arrays import Floats, Mask
from tuning.snapshot import restore
from tuning.studio.tune_desk import AxisVerdict, StepRecording, TuneDesk, TunerSession

if TYPE_CHECKING:
    from drive_env.dictionary.entries import ObjectName
    from tuning.auto.soft_to_stiff import SoftToStiff
    from tuning.response.measured_loop import MeasuredLoop
    from tuning.target import Target


QUIET, LONGEST = 0.02, 10.0  # s at rest before a step; longest move
AFTER = 0.15  # s that are recorded after a step
SAFE_TO_STOP = 0.95  # share of a run from which it can no longer be stopped, since its results are being stored


# --- gains ------------------------------------------------------------------------------------------------------------
def look(desk: TuneDesk) -> Callable[[Drives], None]:
    """Return the job that reads the gains of every axis."""

    def job(drives: Drives) -> None:
        found = read_gains(drives)
        if desk.gains is None or not np.array_equal(found, desk.gains):
            desk.gains = found
            desk.touch()

    return job


def set_gains(desk: TuneDesk, axis: int, wanted: dict[int, int], what: str) -> Callable[[Drives], None]:
    """Return the job that writes some gains of an axis, by their columns, as one change in the history.

    Raises:
        ValueError: Raised by the job for an integer outside the gain's range; nothing is written then.
    """

    def job(drives: Drives) -> None:
        known = device_of(drives).gains
        for column, value in wanted.items():
            row = known.rows[column]
            if not 0 <= value <= row.highest:
                raise ValueError(f"{row.title} {value} must be 0 to {row.highest}")
        desk.keep_before(drives)
        before = read_gains(drives)[axis]
        try:
            for column, value in wanted.items():
                drives.write(known.keys[column], value, where=only(drives, axis))
        finally:
            desk.gains = read_gains(drives)
            desk.note(axis, before, desk.gains[axis], what)

    return job


def undo(desk: TuneDesk, axis: int) -> Callable[[Drives], str]:
    """Return the job that undoes and names the newest change of an axis' gains; ValueError without a change."""

    def job(drives: Drives) -> str:
        change = desk.last_change(axis)
        if change is None:
            raise ValueError("there is no change to take back")
        now = read_gains(drives)
        now[axis] = change.before
        try:
            write_gains(drives, now, only(drives, axis))
        finally:
            desk.gains = read_gains(drives)
        desk.changes.remove(change)
        desk.touch()
        return change.what

    return job


def restore_before(desk: TuneDesk) -> Callable[[Drives], int]:
    """Return the job that brings every axis to rest, and restores the parameters before the first change.

    The job returns the number of changed parameters.
    """

    def job(drives: Drives) -> int:
        before = desk.before
        if before is None:
            raise ValueError("this page has changed nothing yet")
        rest(drives)
        old = read_gains(drives)
        try:
            changed = restore(drives, before, whole=False)
        finally:
            desk.gains = read_gains(drives)
            for axis in range(drives.num_axes):
                desk.note(axis, old[axis], desk.gains[axis], "the state before restored")
        return sum(map(len, changed))

    return job


# --- steps ------------------------------------------------------------------------------------------------------------
def record_velocity_step(desk: TuneDesk, axis: int, rpm: float, hold: float) -> Callable[[Drives], StepRecording]:
    """Return the job that records a velocity step in both directions in csv, with the present gains.

    Args:
        desk: Stores the recording.
        axis: Number of the axis; linked axes move together.
        rpm: Height of the step.
        hold: Duration in each direction [s].
    """

    def job(drives: Drives) -> StepRecording:
        with desk.target(drives) as target:
            where = target.together(only(drives, axis))
            speed = 2.0 * np.pi / 60.0 * rpm
            direction = _direction(target, where, abs(speed) * hold, f"{rpm:g} rpm for {hold:g} s")
            counts = np.rint(target.speed_counts() * speed * direction).astype(np.int64)
            rows = [np.zeros(_cycles(QUIET)), np.ones(_cycles(hold)), -np.ones(_cycles(hold)), np.zeros(_cycles(AFTER))]
            course = np.concatenate(rows)[:, None] * np.where(where, counts, 0)
            gains = tuple(map(int, read_gains(drives)[axis]))
            names = (cia402.TARGET_VELOCITY, cia402.VELOCITY_ACTUAL, cia402.TORQUE_ACTUAL)
            with _moving(drives, where, "csv"):
                trace = drives.record(names[1:], len(course) * CYCLE, play={names[0]: course.astype(np.int64)})
            first = _cycles(QUIET)
            actual, unit = _in_unit(desk, axis, names[1], trace[names[1]][:, axis])
            demand, _ = _in_unit(desk, axis, names[0], course[:, axis])
            window = slice(0, first + _cycles(hold))
            t = np.asarray(trace.t, float) - first * CYCLE
            figures = _figures(t[window], actual[window], float(demand[first]), unit)
            current = _current(drives, axis, trace[names[2]])
            return _keep(desk, StepRecording(axis, "velocity", gains, unit, t, demand, actual, current, figures))

    return job


def record_move(desk: TuneDesk, axis: int, turns: float) -> Callable[[Drives], StepRecording]:
    """Return the job that records a move in pp with the drive's profile and the present gains, and moves back."""

    def job(drives: Drives) -> StepRecording:
        with desk.target(drives) as target:
            where = target.together(only(drives, axis))
            way = 2.0 * np.pi * turns
            direction = _direction(target, where, abs(way), f"{turns:g} turns")
            distance = np.rint(target.increments() * way * direction).astype(np.int64)
            gains = tuple(map(int, read_gains(drives)[axis]))
            names = (cia402.POSITION_DEMAND, cia402.POSITION_ACTUAL, cia402.TORQUE_ACTUAL)
            parts = []
            with _moving(drives, where, "pp"):
                origin = drives.read(cia402.POSITION_ACTUAL)
                motion.start_move(drives, origin + distance, where=where)
                for _ in range(round(LONGEST / 0.05)):
                    parts.append(drives.record(names, 0.05))
                    if np.all(cia402.matches(drives.read(cia402.STATUSWORD), cia402.TARGET_REACHED)[where]):
                        break
                parts.append(drives.record(names, AFTER))
                motion.move_to(drives, origin, where=where, timeout=LONGEST)
            rows = [np.concatenate([np.asarray(part[name])[:, axis] for part in parts]) for name in names]
            demand, unit = _in_unit(desk, axis, names[0], rows[0] - int(origin[axis]))
            actual, _ = _in_unit(desk, axis, names[1], rows[1] - int(origin[axis]))
            t = np.arange(len(rows[0]), dtype=float) * CYCLE
            figures = _figures(t, actual, float(demand[-1]), unit)
            current = _current(drives, axis, np.tile(rows[2][:, None], drives.num_axes))
            return _keep(desk, StepRecording(axis, "position", gains, unit, t, demand, actual, current, figures))

    return job


def _cycles(duration: float) -> int:
    return max(1, round(duration / CYCLE))


def _direction(target: Target, where: Mask, way: float, what: str) -> Floats:
    """Return the direction in which each axis has more room; ValueError if it is too small."""
    forwards = target.high >= -target.low
    room = np.where(forwards, target.high, -target.low)
    short = np.flatnonzero(where & (room < way))
    if short.size:
        k = int(short[0])
        raise ValueError(
            f"axis {k}: {what} takes {way / (2 * np.pi):.3g} turns, and there are {room[k] / (2 * np.pi):.3g}; make "
            "the step smaller, or move the axis away from its end first"
        )
    return np.where(forwards, 1.0, -1.0)


@contextmanager
def _moving(drives: Drives, where: Mask, mode: str) -> Iterator[None]:
    """Enable axes in a mode at rest; restore their state, off or enabled in their mode, at the end."""
    on = np.asarray(cia402.matches(drives.read(cia402.STATUSWORD), cia402.OPERATION_ENABLED)) & where
    names = {number: name for name, number in cia402.MODES.items()}
    modes = [names.get(int(number)) for number in drives.read(cia402.MODE)]
    if mode == "pp":
        drives.write(cia402.TARGET_POSITION, drives.read(cia402.POSITION_ACTUAL), where=where)
    else:
        drives.write(cia402.TARGET_VELOCITY, 0, where=where)
    motion.enable(drives, mode=mode, where=where, timeout=3.0)
    yield  # after an error the session stops the axes
    for axis in map(int, np.flatnonzero(where)):
        before = modes[axis]
        if not on[axis]:
            disable(axis)(drives)
        elif before is not None and before != mode:
            select_mode(axis, before)(drives)


def _in_unit(desk: TuneDesk, axis: int, name: ObjectName, raw: Any) -> tuple[Floats, str]:
    entry = desk.session.description.dictionary.find(name)
    channel = channel_of(entry, axis, desk.session.scales[axis], several=False)
    return np.asarray(raw, float) * channel.factor, channel.unit


def _current(drives: Drives, axis: int, raw: Any) -> Floats:
    from drive_env.drives.currents import ampere_per_count

    return np.asarray((np.asarray(raw, float) * ampere_per_count(drives))[:, axis])


def _figures(t: Floats, actual: Floats, final: float, unit: str) -> str:
    try:
        found = step_metrics(t, actual, final, t_step=0.0, initial=float(actual[0]) if t[0] >= 0.0 else None)
    except ValueError as error:
        return f"no figures: {error}"

    def text(value: Any, factor: float, what: str) -> str:
        return f"{factor * float(value):.4g} {what}" if np.isfinite(value) else "none"

    return (
        f"step of {final:.4g} {unit}: rise {text(found.rise_time, 1e3, 'ms')}, overshoot "
        f"{text(found.overshoot, 100.0, '%')}, settling (2 %) {text(found.settling_time, 1e3, 'ms')}"
        f"{', oscillates' if bool(found.oscillating) else ''}"
    )


def _keep(desk: TuneDesk, step: StepRecording) -> StepRecording:
    desk.steps.append(step)
    desk.touch()
    return step


# --- response, identification, rules ----------------------------------------------------------------------------------
def measure_response(desk: TuneDesk, axis: int, loop: str) -> Callable[[Drives], MeasuredLoop]:
    """Return the job that measures a loop's frequency response with the present gains.

    From a velocity loop it also designs gains from soft to stiff, without writing them.
    """

    def job(drives: Drives) -> MeasuredLoop:
        from tuning.response.frequency_response import measure

        rest(drives)
        with desk.target(drives) as target:
            found = measure(target, loop, where=only(drives, axis), progress=progress_of(desk, "shaking"))
        desk.responses[loop, axis] = found
        desk.gains = read_gains(drives)
        if loop == "velocity":
            _fill_slider(desk, target, axis)
        desk.touch()
        return found

    return job


def _fill_slider(desk: TuneDesk, target: Target, axis: int) -> None:
    """Design the gains of the slider from the response of an axis' velocity loop; a stop removes them."""
    desk.soft_to_stiff[axis] = "Gains from soft to stiff are being designed by this response."
    desk.touch()
    try:
        desk.soft_to_stiff[axis] = _soft_to_stiff(desk, target, desk.responses["velocity", axis], axis)
    except BaseException:
        del desk.soft_to_stiff[axis]
        raise
    finally:
        desk.touch()


def _soft_to_stiff(desk: TuneDesk, target: Target, measured: MeasuredLoop, axis: int) -> SoftToStiff | str:
    """Return gains of an axis from soft to stiff by its response, or the reason why none could be designed."""
    from tuning.auto.soft_to_stiff import soft_to_stiff

    if target.linked:
        return "Axes that drive one part have no gains by the response of one of them: run auto."
    try:
        return soft_to_stiff(measured, target.motor, axis, progress_of(desk, "designing gains from soft to stiff"))
    except ValueError as error:
        return f"There are no gains from soft to stiff: {error}."


def identify_axes(desk: TuneDesk) -> Callable[[Drives], None]:
    """Return the job that identifies every axis, and has the rules propose gains for each."""

    def job(drives: Drives) -> None:
        from tuning.compare.side_by_side import AxisRules, identified_plants, proposals
        from tuning.rules.rules_by_name import RULES

        rest(drives)
        with desk.target(drives) as target:
            found, plants = identified_plants(target, lambda what, share: progress_of(desk, what)(share))
            rules = [
                AxisRules(plant, {} if isinstance(plant, str) else proposals(target, plant, list(RULES)))
                for plant in plants
            ]
        desk.identified, desk.rules = found, rules
        desk.touch()

    return job


def rest(drives: Drives) -> None:
    """Bring every axis to rest and switch it off, as experiments require."""
    for axis in range(drives.num_axes):
        if cia402.is_live(int(drives.read(cia402.STATUSWORD)[axis])):
            disable(axis)(drives)


def progress_of(desk: TuneDesk, what: str) -> Callable[[float], None]:
    """Return a callback for the share that is done: the page shows it, and a stopped job ends in it."""

    def tell(share: float) -> None:
        desk.session.tell(what, share)
        if share < SAFE_TO_STOP:
            desk.session.check()

    return tell


# --- tuners -----------------------------------------------------------------------------------------------------------
def run_tuner(
    desk: TuneDesk, run: TunerSession, work: Callable[[Target, TunerSession, Callable[[str, float], None]], Any]
) -> Callable[[Drives], None]:
    """Return the job of a tuner: brings the axes to rest, tunes, and stores the verdict, or restores the state before.

    Args:
        desk: Stores the gains.
        run: Stores messages and verdict.
        work: Tunes a target; called with target, run and progress, it returns a result with `axes`.
    """

    def job(drives: Drives) -> None:
        desk.run = run
        desk.touch()
        is_back = False
        try:
            desk.keep_before(drives)
            rest(drives)
            old = read_gains(drives)
            try:
                with desk.target(drives) as target:
                    result = work(target, run, _progress(desk, run))
                    measured = _keep_measured(desk, target, result, run.title)
                run.verdicts = verdicts(result)
            finally:
                desk.gains = read_gains(drives)
                is_back = np.array_equal(old, desk.gains)
                for axis in range(drives.num_axes):
                    desk.note(axis, old[axis], desk.gains[axis], run.title)
            run.share = 1.0
        except BaseException as error:
            job_now = desk.session.job
            stopped = "" if job_now is None else job_now.stopped
            told = f"stopped: {stopped}" if stopped else sentence(error)
            run.failure = f"{told}; the gains from before are back" if is_back else told
            raise
        finally:
            run.is_over = True
            desk.touch()
        # The run has its verdict: a stop from here on only leaves the slider without gains.
        for axis in measured:
            _fill_slider(desk, target, axis)

    return job


def _progress(desk: TuneDesk, run: TunerSession) -> Callable[[str, float], None]:
    def tell(what: str, share: float) -> None:
        run.share = max(run.share, share)
        if not run.lines or run.lines[-1] != what:
            run.lines.append(what)
        desk.touch()
        progress_of(desk, what)(share)

    return tell


def _keep_measured(desk: TuneDesk, target: Target, result: Any, title: str) -> list[int]:
    """Store auto's recordings, with the present gains' moves last, and responses; return the axes with a response."""
    from tuning.auto.certify import recorded_moves
    from tuning.auto.stages import Result

    if not isinstance(result, Result):
        return []  # the result of a stepper's commissioning has no recordings
    increments, kept = target.increments(), []
    for k, axis in enumerate(result.axes):
        # If the axis was rejected, the gains of the new move are no longer in the drive.
        moves = [(one, (axis.after if axis.accepted else ()) if one.tuned else axis.before)
                 for one in recorded_moves(result, k)]  # fmt: skip
        for one, gains in moves if axis.accepted else reversed(moves):
            scaled = (
                _in_unit(desk, k, cia402.POSITION_ACTUAL, row * increments[k]) for row in (one.reference, one.actual)
            )
            (demand, unit), (actual, _) = scaled
            figures = _figures(one.t, actual, float(demand[-1]), unit)
            _keep(desk, StepRecording(k, "position", gains, unit, one.t, demand, actual, one.current, figures, title))
        if result.response is not None and np.isfinite(result.response.open_loop[:, k]).any():
            desk.responses["velocity", k] = result.response
            desk.soft_to_stiff.pop(k, None)
            kept.append(k)
    return kept


def verdicts(result: Any) -> tuple[AxisVerdict, ...]:
    """Return the verdicts of a result on its axes, for auto and for a stepper's commissioning."""
    return tuple(
        AxisVerdict(
            k, axis.verdict, axis.reason, tuple(axis.reservations), tuple(getattr(axis, "notes", ())),
            _integers(axis.before), _integers(axis.after),
        )
        for k, axis in enumerate(result.axes)
    )  # fmt: skip


def _integers(gains: Any) -> tuple[int, ...]:
    values = gains.values() if isinstance(gains, dict) else gains
    return tuple(int(value) for value in values)


def auto(store: bool, dynamics: str = DEFAULT) -> Callable[[Target, TunerSession, Callable[[str, float], None]], Any]:
    """Return the function that runs auto as `drive-tune auto` does, with its files in the run's folder."""

    def work(target: Target, run: TunerSession, progress: Callable[[str, float], None]) -> Any:
        from tuning.auto_to_files import auto_to_files, commission_to_files

        if target.device.gains.is_open_loop:
            return commission_to_files(target, run.folder, progress, keep=store)
        return auto_to_files(target, run.folder, progress, keep=store, dynamics=dynamics)

    return work
