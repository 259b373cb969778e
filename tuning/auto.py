"""One button: check, identify, compute, try, refine, verify, write and keep; or roll back and say why.

Everything acts through the Drives interface, on all axes of a target side by side, inside a transaction (snapshot.py):
the state before is in a file from the first moment on, and an axis that fails any check gets it back. Time is spent
where it is cheap: gains are searched on digital twins (twin.py), and only the best few are tried on the drives.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from drive_env import motion
from drive_env.gains import GAIN_OBJECTS, Gains, gains_from_bandwidths, rule_gains, scaled, write_gains
from drive_env.master.errors import BusError
from drive_env.positioning import POSITION, wrapped
from drive_env.safety import SafetyError
from tuning.auto_checks import unsafe_gains, wrong_wiring
from tuning.auto_result import AxisRun, Result
from tuning.brief import identify_briefly
from tuning.ladder import Ladder, Rung
from tuning.linear_model import Plant
from tuning.margins import margins
from tuning.proving import ProvingGround, Shown, shaken_on_purpose
from tuning.rules import RULES, propose
from tuning.snapshot import Transaction, restore
from tuning.target import Target, timed
from tuning.twin import Twins, known_of, search
from tuning.working_state import BOTH_ENDS, INPUTS, LIMIT_SWITCHES, cautious_bandwidth

if TYPE_CHECKING:
    from tuning.frequency_response import FrequencyResponse
    from tuning.identification import Identification
    from tuning.tuners import Outcome

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]
Progress = Callable[[str, float], None]  # what is under way, and how much of it all is done, 0...1
Identify = Callable[[Target, Mask], "list[Identification]"]  # of the axes where the mask is true

SHOWINGS, AT_THE_EDGE = 3, 0.6  # moves for the record until one passes, and the factor of the gains between them
BUDGET = 10.0  # s of drive time
RESPONSE_TIME = 2.3  # s of it that a frequency response takes
TRIAL_TIME = 0.85  # s that a trial takes, with what recovery takes
MOVE_TIME, LOOK_BACK_TIME = 0.3, 0.75  # s that a move for the record takes, and one from where a response has ended
LANES, GENERATIONS = 16, 24  # of the search on twins: sets of gains at once, and how often
LOUD = 0.06  # RMS increment of the current over the rated one, from which on slower gains are tried, not faster ones
SOFT = "margin_60"  # the rule that is tried when nothing faster passes: 60 degrees and 20 dB
# The calmest gains: of the current loop, and shares of the velocity loop of `cautious_gains` and of this one's own.
CALM_CURRENT_HZ, ROTOR_SHARE, POSITION_SHARE = 800.0, 0.6, 0.4
LEAST_WAY = 0.2  # rad between the ends of the travel: finding the poles alone turns a rotor so far
BY_TRIAL = "by a move, its reversal, and a move with 1.5 times velocity P"  # how gains are verified, at the least
LEAST_LINES = 10  # of a frequency response, that are worth a judgement
CALMED = [Gains._fields.index(name) for name in ("velocity_p", "position_p")]
SCALED = [Gains._fields.index(name) for name in ("velocity_p", "velocity_i", "position_p")]
SENSITIVITY = 4.0  # greatest |1/(1+L)| that a measured velocity loop may have: 14 degrees, 2.5 dB from instability
SOFTER = (1.0, 0.85, 0.7, 0.6, 0.5)  # factors of velocity P and position P by which a lively loop is calmed
WINDOW = 10  # following error that trips a trial, over its move: a slow loop lags by the whole of it
FREE_WINDOW = 100  # turns of following error that trip a frequency response: it means nothing there

# Objects that the trials change and that are put back, gains aside.
FOLLOWING_WINDOW, MOTOR_TYPE, MODE = 0x6065, 0x2050, 0x6060
ENCODER_INIT = "ABN Encoder Settings.Encoder Init Mode"  # presets take the encoder's offset as known; here nobody knows


def auto(
    target: Target,
    file: str | Path,
    *,
    seed: int = 0,
    keep: bool = True,
    progress: Progress | None = None,
    identify: Identify | None = None,
    budget: float = BUDGET,
) -> Result:
    """Tune the axes of a target; what fails is rolled back, and its reason is in the result.

    Args:
        target: The drives; they may have any gains, also none, and are off afterwards.
        file: Where the state before is left.
        seed: Of the search on twins.
        keep: Whether drives on a bus are told to keep the new gains over a power cycle.
        progress: Called with what is under way, and the share done.
        identify: In place of `tuning.brief.identify_briefly`.
        budget: Most time that may pass on the drives [s]; what cannot be afforded is left out, and said.

    Raises:
        BusError: If the drives cannot be reached any more: what then holds is said, and how to bring back what was.
    """
    identify = identify or identify_briefly
    say = progress or (lambda what, share: None)
    with Transaction(target, file) as transaction, timed(target) as (watched, clock):
        run = _Run(watched, seed, clock, budget)
        say("checking the drives", 0.0)
        run.begin()
        say("identifying", 0.05)
        run.identify(identify)
        run.commission()
        say("searching gains on digital twins", 0.3)
        run.compute()
        say("trying gains on the drives", 0.7)
        run.prove()
        run.show()
        say("measuring the frequency response", 0.85)
        run.measure()
        say("moving with the gains before", 0.95)
        run.look_back()
        say("writing", 0.96)
        accepted = run.write(transaction)
        kept = keep and bool(accepted.any()) and transaction.store(accepted)
        transaction.commit(accepted)
    say("done", 1.0)
    return run.result(transaction.path, kept)


def tune(target: Target, rng: np.random.Generator) -> Outcome:
    """Tune a target as `drive-tune compare` wants it."""
    from tuning.tuners import Outcome

    with tempfile.TemporaryDirectory() as folder:
        found = auto(target, Path(folder) / "before.toml", seed=int(rng.integers(2**31)), keep=False)
    return Outcome(
        np.array([axis.after for axis in found.axes], np.int64),
        found.drive_seconds,
        found.moves,
        found.aborts,
        found.violations,
        tuple(axis.reason or "; ".join(axis.notes) for axis in found.axes),
    )


class _Run:
    """The stages, in order; each takes out the axes that fail in it."""

    def __init__(self, target: Target, seed: int, clock: Any, budget: float) -> None:
        self._target, self._clock, self._budget = target, clock, budget
        self._rng = np.random.default_rng(seed)
        # Axes of one machine are shaken one after the other.
        self._response_time = RESPONSE_TIME * target.axes_per_machine
        drives = target.drives
        self._origin = drives.read(POSITION)
        self._before = np.stack([drives.read(name) for name in GAIN_OBJECTS], axis=1)
        self._axes = [AxisRun(Gains(*map(int, row)), Gains(*map(int, row))) for row in self._before]
        self._ground: ProvingGround | None = None
        self._shown: Shown | None = None
        self._earlier: Shown | None = None
        self._response: FrequencyResponse | None = None
        self._fresh = np.zeros(target.num_axes, bool)
        self._modes = drives.read(MODE)
        # Of each axis: what passed while it took part. Axes that are through wait for others at no cost of their own.
        self._spent = np.zeros(target.num_axes)
        n = target.num_axes
        self._gains, self._reference = (np.ones((n, len(Gains._fields)), np.int64) for _ in range(2))
        # What is tried when the twin's gains fail: the fitted rule's; those before, or the soft rule's; and those
        # that are slow enough for any load, with which what is stopped goes on.
        self._fallbacks = np.ones((3, n, len(Gains._fields)), np.int64)

    @property
    def going(self) -> Mask:
        """Which axes nothing has stopped, nor another axis of their machine, (num_axes,)."""
        alone = np.array([axis.accepted for axis in self._axes])
        lanes = self._target.axes_per_machine
        return np.asarray(np.repeat(alone.reshape(-1, lanes).all(axis=1), lanes))

    # --- stages ---------------------------------------------------------------------------------------------------
    def begin(self) -> None:
        """Refuse what has no way to go, and disable what is enabled: identification begins at rest."""
        drives, way = self._target.drives, self._target.high - self._target.low
        for axis in np.flatnonzero(way < LEAST_WAY):
            self._axes[axis].reason = f"the travel is too short: {way[axis]:.2g} rad, and {LEAST_WAY:g} are needed"
        mask, value = motion.OPERATION_ENABLED
        on = drives.read(0x6041) & mask == value
        if on.any():
            motion.disable(drives, where=on)

    def identify(self, identify: Identify) -> None:
        """Check the wiring and identify."""
        target = self._target
        if not self.going.any():
            return
        try:
            with self._spending(self.going), shaken_on_purpose(target.drives):
                found = identify(target, self.going)
        except (SafetyError, RuntimeError, TimeoutError) as error:
            if isinstance(error, BusError):
                raise
            self._stop(self.going, f"identification stopped: {error}")
            return
        for axis in map(int, np.flatnonzero(self.going)):
            run, identified = self._axes[axis], found[axis]
            run.identified = identified
            run.reason = wrong_wiring(target, identified)
            if not run.reason:
                try:
                    run.plant = _plant(target, axis, identified)
                except ValueError as error:
                    run.reason = str(error)
            run.notes += [
                f"{name} not identified: {estimate.reason}"
                for name, estimate in identified.estimates.items()
                if estimate.reason and name not in ("inertia",)
            ]

    def commission(self) -> None:
        """Tell a drive that is fresh from the factory which motor it has; identification looks after itself."""
        target = self._target
        self._fresh = self.going & (target.drives.read(MOTOR_TYPE) == 0)
        if not self._fresh.any():
            return
        for name, value in _commissioning(target).items():
            target.drives.write(name, value, where=self._fresh)
        # No axis is at both ends: switches that say so are not there.
        unwired = self._fresh & (target.drives.read(INPUTS) & BOTH_ENDS == BOTH_ENDS)
        target.drives.write(LIMIT_SWITCHES, BOTH_ENDS, where=unwired)
        self._note(unwired, "both limit switches were active, which no axis can be at: they are ignored (2005h)")
        for axis in np.flatnonzero(self._fresh):
            self._axes[axis].notes.append(f"fresh from the factory: commissioned for {target.motor.name} first")

    def compute(self) -> None:
        """Search gains on twins, from what the rules propose."""
        target, going = self._target, self.going
        chosen = np.flatnonzero(going)
        if not chosen.size:
            return
        room = self._room()
        reach = np.where(room[1] >= -room[0], room[1], room[0])
        known, starts = [], []
        for axis in chosen:
            plant, identified = self._axes[axis].plant, self._axes[axis].identified
            assert plant is not None and identified is not None, "an axis that goes on has both"
            known.append(known_of(plant, identified, float(reach[axis])))
            fitted = rule_gains(target.device, target.motor, plant.inertia, supply=plant.supply)[0]
            proposals = {name: propose(name, target.device, target.motor, plant) for name in RULES}
            self._fallbacks[0, axis] = fitted
            before = self._axes[axis].before
            # What the drive had may be better than what is only soft.
            trusted = not unsafe_gains(target.device, plant, before)
            self._fallbacks[1, axis] = before if trusted else proposals[SOFT].gains
            self._fallbacks[2, axis] = _calm_gains(target, plant)
            self._reference[axis] = fitted
            starts.append(np.array([fitted, *(proposal.gains for proposal in proposals.values())], np.int64))
        scaler = np.asarray(target.drives.read((0x2058, 0)), float)[chosen]
        with Twins(target.device, target.motor, known, scaler, LANES) as twins:
            found = search(twins, np.array(starts), self._rng, generations=GENERATIONS)
        self._gains[chosen] = found.gains[:, 0]
        for axis, hidden in zip(chosen, found.hidden[:, 0], strict=True):
            self._axes[axis].twin = float(hidden)

    def prove(self) -> None:
        """Try the twin's gains on the drives; slower ones until some pass, then their neighbours, the best is kept."""
        going = self.going
        if not going.any():
            return
        plants = [axis.plant for axis in self._axes]
        self._ground = ground = ProvingGround(self._target, plants, self._room(), self._fallbacks[-1], self._reference)
        self._watch_following(going)
        self._stop(going & ground.too_short(), "the travel is too short for a move that proves anything")
        ladders = [Ladder(len(self._fallbacks)) for _ in self._axes]
        n = self._target.num_axes
        best, cost, last = self._fallbacks[-1].copy(), np.full(n, np.inf), [""] * n
        while True:
            passed = np.array([ladder.passed for ladder in ladders])
            open_ = self.going & np.array([ladder.rung is not None for ladder in ladders])
            # Time for a response and a move is kept, unless there is nothing yet to make them with.
            then = np.where(passed, self._response_time + MOVE_TIME, 0.0)
            open_ &= self._affordable(TRIAL_TIME + ground.way_back() + then)
            if not open_.any():
                break
            tried = np.array([self._meant(axis, ladder.rung) for axis, ladder in enumerate(ladders)])
            with self._spending(open_):
                proof = ground.run(tried, open_)
            better = open_ & proof.passed & (proof.cost < cost)
            best, cost = np.where(better[:, None], tried, best), np.where(better, proof.cost, cost)
            for axis in map(int, np.flatnonzero(open_)):
                if not proof.passed[axis] and not ladders[axis].passed:
                    last[axis] = proof.reason[axis]
                ladders[axis].step(bool(proof.passed[axis]), bool(better[axis]), bool(proof.ripple[axis] > LOUD))
        for axis in map(int, np.flatnonzero(self.going)):
            run, ladder = self._axes[axis], ladders[axis]
            if not ladder.passed:
                why = last[axis] or "no drive time was left to try them"
                run.reason = f"no gains passed the trial: with the last ones {why}"
                continue
            run.proof, run.verified = float(cost[axis]), BY_TRIAL
            if ladder.failures:
                failed = ", ".join(rung.words for rung in ladder.failures)
                run.notes.append(f"no pass with the {failed}: the last time {last[axis]}")
        self._gains = best

    def _meant(self, axis: int, rung: Rung | None) -> Integers:
        """Return the gains that a rung means for an axis; any, if nothing is to be tried on it."""
        if rung is None:
            return np.asarray(self._fallbacks[-1, axis])
        if rung.fallback is not None:
            return np.asarray(self._fallbacks[rung.fallback, axis])
        return _scaled(self._gains[axis], rung.factor)

    def measure(self) -> None:
        """Measure the velocity loop's response with the new gains; what comes too near to instability is calmed."""
        going = self.going
        late = going & ~self._affordable(self._response_time)
        self._without_response(late, "the drive time was used up")
        going &= ~late
        if not going.any():
            return
        from tuning.frequency_response import measure

        drives = self._target.drives
        write_gains(drives, self._gains, going)
        drives.write(FOLLOWING_WINDOW, FREE_WINDOW * drives.read((0x2058, 0)), where=going)
        try:
            with self._spending(going), shaken_on_purpose(drives):
                self._response = response = measure(self._target, "velocity", where=going)
        except SafetyError as error:
            self._stop(going, f"the envelope stopped the frequency response: {error}")
            return
        except (ValueError, RuntimeError, TimeoutError) as error:
            if isinstance(error, BusError):
                raise
            self._without_response(going, str(error))
            return
        finally:
            self._watch_following(going)
        self._drop_faults("its frequency response was measured")
        assert self._ground is not None, "proving makes it"
        self._ground.begin_here(going)
        calmed = np.zeros(self._target.num_axes, bool)
        for axis in map(int, np.flatnonzero(going & self.going)):
            calmed[axis] = self._calm(axis, response)
        self._try_again(calmed & self.going)

    def _calm(self, axis: int, response: FrequencyResponse) -> bool:
        """Lower the gains of an axis whose measured loop comes too near to instability; return whether it was so.

        The loop scales with P.
        """
        run, f, L = self._axes[axis], response.f, response.open_loop[:, axis]
        trusted = response.trusted[:, axis]
        if trusted.sum() < LEAST_LINES:
            why = f"{int(trusted.sum())} of its lines are coherent, and {LEAST_LINES} are needed"
            self._without_response(_only(axis, self._target.num_axes), "; ".join([why, *response.notes[axis]]))
            return False
        for factor in SOFTER:
            found = margins(f, factor * L, trusted)
            if found.ms <= SENSITIVITY:
                break
        else:
            run.reason = (
                f"the measured loop is {found.ms:.1f} times as sensitive as an open one: {SENSITIVITY:g} is most"
            )
            return False
        run.margins = found
        run.verified = f"{BY_TRIAL}; and by the measured frequency response of the velocity loop, Ms {found.ms:.1f}"
        if factor == 1.0:
            return False
        softer = self._gains[axis].copy()
        softer[CALMED] = scaled(softer[CALMED], factor)
        self._gains[axis] = softer
        run.notes.append(
            f"calmed to {100.0 * factor:.0f} %: the measured loop came too near to instability; margins are computed "
            "from that response"
        )
        return True

    def _try_again(self, calmed: Mask) -> None:
        """Try gains that were calmed, and record a move with them; without time for a trial, that move must do."""
        where = calmed & self._affordable(TRIAL_TIME)
        self._note(calmed & ~where, "a move was the only trial of the calmed gains: the drive time was used up")
        assert self._ground is not None, "proving makes it"
        if where.any():
            with self._spending(where):
                proof = self._ground.run(self._gains, where)
            for axis in map(int, np.flatnonzero(where)):
                run = self._axes[axis]
                run.proof = float(proof.cost[axis])
                if not proof.passed[axis]:
                    run.reason = f"the calmed gains failed their trial: {proof.reason[axis]}"
        self.show(calmed & self.going)

    def _without_response(self, where: Mask, why: str) -> None:
        """Say why there is no frequency response, and what was verified instead."""
        self._note(where, f"no margins were measured: {why}; verified {BY_TRIAL} instead")

    def show(self, where: Mask | None = None) -> None:
        """Record a move with the new gains, of all axes or some; one that fails is refused."""
        going = self.going if where is None else where
        if not going.any():
            return
        assert self._ground is not None, "proving makes it"
        for attempt in range(SHOWINGS):
            try:
                with self._spending(going):
                    shown = self._ground.show(self._gains, going)
            except SafetyError as error:
                self._stop(going, f"the envelope stopped the move with the new gains: {error}")
                return
            self._shown = shown if self._shown is None else self._shown.replaced(shown)
            failed = going & np.array([bool(reason) for reason in shown.reason])
            last = attempt == SHOWINGS - 1
            for axis in map(int, np.flatnonzero(failed)):
                # What passed once and fails now is at its edge.
                self._gains[axis] = _scaled(self._gains[axis], AT_THE_EDGE)
                run, why = self._axes[axis], shown.reason[axis]
                if last or not self._affordable(MOVE_TIME)[axis]:
                    run.reason = f"the move with the new gains failed: {why}"
                else:
                    run.notes.append(f"slowed to {100.0 * AT_THE_EDGE:.0f} % after the trial: in one more move {why}")
            going = failed & self.going
            if not going.any():
                break
        self._drop_faults("it moved with the new gains")

    def look_back(self) -> None:
        """Record a move with the gains before, where they are safe by the model; it decides nothing."""
        going, n = self.going, self._target.num_axes
        for axis in map(int, np.flatnonzero(going)):
            plant = self._axes[axis].plant
            assert plant is not None, "an axis that goes on has one"
            why = unsafe_gains(self._target.device, plant, self._axes[axis].before)
            if not why and not self._affordable(LOOK_BACK_TIME)[axis]:
                why = "the drive time was used up"
            if why:
                going &= ~_only(axis, n)
                self._axes[axis].notes.append(f"no move with the gains before, for comparison: {why}")
        lanes = self._target.axes_per_machine
        going &= np.repeat(going.reshape(-1, lanes).all(axis=1), lanes)
        if not going.any():
            return
        assert self._ground is not None, "proving makes it"
        try:
            with self._spending(going):
                self._earlier = earlier = self._ground.show(self._before, going)
        except SafetyError as error:
            self._note(going, f"the envelope stopped the move with the gains before: {error}")
            return
        for axis in map(int, np.flatnonzero(going)):
            if earlier.reason[axis]:
                self._axes[axis].notes.append(f"the move with the gains before: {earlier.reason[axis]}")

    def write(self, transaction: Transaction) -> Mask:
        """Leave the accepted axes with their gains and everything else as it was; return which they are."""
        going = self.going
        for axis in np.flatnonzero(~going):
            run = self._axes[axis]
            run.reason = run.reason or "another axis of its machine was refused"
        if not going.any():
            return going
        drives = self._target.drives
        write_gains(drives, self._gains, going)
        motion.disable(drives, where=going)
        # 0, no mode, is what a drive has before its first; it cannot be written.
        other = going & (self._modes != 0) & (drives.read(MODE) != self._modes)
        if other.any():
            drives.write(MODE, self._modes, where=other)
        kept = dict(zip(((key[0], key[1]) for key in GAIN_OBJECTS), self._gains.T, strict=True))
        axes = []
        for k, values in enumerate(transaction.before.axes):
            wanted = dict(values)
            if self._fresh[k]:
                commissioned = [*_keys(self._target, _commissioning(self._target)), (LIMIT_SWITCHES, 0)]
                wanted |= {key: int(drives.read(key)[k]) for key in commissioned if key in values}
            axes.append(wanted | {key: int(column[k]) for key, column in kept.items()})
        restore(drives, _with_axes(transaction, axes), going, whole=False)
        for axis in np.flatnonzero(going):
            self._axes[axis].after = Gains(*map(int, self._gains[axis]))
        return going

    def result(self, file: Path, kept: bool) -> Result:
        """Return what was done."""
        ground, zero = self._ground, np.zeros(self._target.num_axes, np.int64)
        counts = (zero, zero, zero) if ground is None else (ground.moves, ground.aborts, ground.violations)
        return Result(tuple(self._axes), self._spent, *counts, self._shown, self._earlier, self._response, file, kept)

    # --- parts ----------------------------------------------------------------------------------------------------
    def _watch_following(self, where: Mask) -> None:
        """Have a following error trip the drive that trials cannot have."""
        assert self._ground is not None, "proving makes it"
        drives = self._target.drives
        window = WINDOW * np.abs(self._ground.move.distance) + drives.read((0x2058, 0))
        drives.write(FOLLOWING_WINDOW, window, where=where)

    def _drop_faults(self, meanwhile: str) -> None:
        """Take out axes that went into fault, and say which."""
        drives = self._target.drives
        mask, value = motion.FAULT_BIT
        faulted = self.going & (drives.read(0x6041) & mask == value)
        names: dict[int, list[str]] = {}
        for message in drives.emergencies():
            if message.code:
                names.setdefault(message.axis, []).append(message.name)
        for axis in np.flatnonzero(faulted):
            causes = ", ".join(dict.fromkeys(names.get(int(axis), []))) or "no emergency told why"
            self._axes[axis].reason = f"the drive went into fault while {meanwhile}: {causes}"

    def _room(self) -> tuple[Floats, Floats]:
        """Return how far the rotors may turn from where they are now [rad]."""
        target = self._target
        here = wrapped(target.drives.read(POSITION) - self._origin) / target.increments()
        return np.minimum(target.low - here, 0.0), np.maximum(target.high - here, 0.0)

    def _affordable(self, seconds: float | Floats) -> Mask:
        """Return which axes have so much of their drive time left."""
        return np.asarray(self._spent + seconds <= self._budget)

    @contextmanager
    def _spending(self, where: Mask) -> Iterator[None]:
        """Count what passes as drive time of some axes."""
        before = self._clock.seconds
        try:
            yield
        finally:
            self._spent[where] += self._clock.seconds - before

    def _stop(self, where: Mask, reason: str) -> None:
        for axis in np.flatnonzero(where):
            self._axes[axis].reason = self._axes[axis].reason or reason

    def _note(self, where: Mask, text: str) -> None:
        for axis in np.flatnonzero(where):
            self._axes[axis].notes.append(text)


def _scaled(gains: Integers, factor: float) -> Integers:
    result = gains.copy()
    result[SCALED] = scaled(gains[SCALED], factor)
    return result


def _commissioning(target: Target) -> dict[str, int]:
    """Return what a drive must be told of its motor; how its encoder finds its angle is left as it is."""
    preset = target.device.preset(target.motor.name)
    return {name: value for name, value in preset.items() if name != ENCODER_INIT}


def _keys(target: Target, names: Iterable[Any]) -> list[tuple[int, int]]:
    """Return the index and sub-index of objects by name."""
    dictionary = target.device.new_dictionary()
    return [(entry.index, entry.sub) for entry in map(dictionary.find, names)]


def _with_axes(transaction: Transaction, axes: Sequence[dict[Any, int]]) -> Any:
    from dataclasses import replace

    return replace(transaction.before, axes=tuple(axes))


def _plant(target: Target, axis: int, identified: Identification) -> Plant:
    return Plant.from_identification(target.device, target.motor, float(target.supply[axis]), identified)


def _calm_gains(target: Target, plant: Plant) -> Gains:
    """Return gains that suit the rotor alone, too: within backlash, and above a resonance, it has no load."""
    velocity_hz = cautious_bandwidth(target.motor, plant.inertia) * ROTOR_SHARE
    return gains_from_bandwidths(
        target.device, target.motor, plant.inertia, current_hz=CALM_CURRENT_HZ, velocity_hz=velocity_hz,
        position_hz=POSITION_SHARE * velocity_hz, supply=plant.supply,
    )  # fmt: skip


def _only(axis: int, count: int) -> Mask:
    return np.asarray(np.arange(count) == axis)
