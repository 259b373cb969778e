"""Winding resistance from readings at rest: with any dead time, and over a bus whose time goes on while it is read."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rigs.world_bus import served
from scipy import stats

from drive_env import cia402
from drive_env.dictionary.roles import Role
from drive_env.loops.true_plant import terminal_resistance
from tuning.identify import standstill as module
from tuning.identify.identification import identify
from tuning.identify.standstill import standstill_resistances
from tuning.identify.working_state import working_state
from tuning.target import Target, emulated


def at_rest(target):
    with working_state(target) as working:
        return standstill_resistances(working)


def test_dead_time_of_any_kind_is_in_the_interval():
    """The ends of what a bridge may have: 100 and 700 ns, that fade below 0.1 and 0.8 A."""
    ends = [(dead, fades) for dead in (100e-9, 700e-9) for fades in (0.1, 0.8)]
    machines = {"stage.dead_time": [dead for dead, _ in ends], "stage.dead_time_current": [fades for _, fades in ends]}
    target = emulated(load="inertia", num_machines=4, parameters=machines, num_threads=1)
    for found, true in zip(at_rest(target), terminal_resistance(target.drives.machine.parameters, "pmsm"), strict=True):
        assert found.low < true < found.high
        assert found.value == pytest.approx(true, rel=0.03)
        assert found.high - found.low < 0.1 * true


def test_drives_are_left_as_they_were_and_nothing_has_turned_far():
    target = emulated(load="inertia", num_threads=1)
    before = [int(target.drives.read(name)[0]) for name in (Role.COMMUTATION, Role.OPEN_LOOP_CURRENT)]
    at_rest(target)
    assert [int(target.drives.read(name)[0]) for name in (Role.COMMUTATION, Role.OPEN_LOOP_CURRENT)] == before
    # The field pulls the rotor to itself, half an electrical turn at most, and swings.
    assert abs(float(target.drives.machine.rotor_angle[0])) < 1.5 * np.pi / target.motor.n_p


def test_a_rotor_that_slips_says_nothing():
    target = emulated(load="inertia", num_threads=1)
    target.drives.machine.load_torque = 0.7 * target.current * target.motor.torque_constant
    assert "slipped" in at_rest(target)[0].reason or "switched off" in at_rest(target)[0].reason


@pytest.mark.parametrize("current", [0.5, 2.0])
def test_currents_that_dead_time_swallows_are_too_weak(current):
    """Without what dead time may be in the interval, R would be told a third too high here."""
    ends = {"stage.dead_time": [100e-9, 700e-9], "stage.dead_time_current": [0.1, 0.8]}
    target = emulated(load="inertia", current=current, num_machines=2, parameters=ends, num_threads=1)
    assert all("too weak" in found.reason for found in at_rest(target))


def test_a_brushed_motor_would_turn():
    target = emulated(load="inertia", motor="re_35", num_threads=1)
    assert "a brushed motor turns with its current" in at_rest(target)[0].reason


class Uneven:
    """Drives in real time: a read takes now one, now two, now three cycles, and the clock of `winding` sees it."""

    time_waits = False

    def __init__(self, drives):
        self._drives, self.reads, self.now = drives, 0, 0.0

    def read(self, name):
        self.reads += 1
        self._drives.advance(0.001 * (1 + self.reads % 3))
        return self._drives.read(name)

    def record(self, objects, duration, *arguments, **options):
        self.now += duration + 0.002
        return self._drives.record(objects, duration, *arguments, **options)

    def perf_counter(self):
        return self.now

    def __getattr__(self, name):
        return getattr(self._drives, name)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 4])
def test_over_a_bus_in_real_time_resistance_is_told_and_inductance_refused(monkeypatch, seed):
    """R within 10 % over the bus; L is seen in step with the drive alone."""
    with served("calls", load="inertia", seed=seed, randomise=["stage", "motor"]) as bus:
        own = emulated(load="inertia", seed=seed, randomise=["stage", "motor"], num_threads=1)
        drives = Uneven(bus)
        monkeypatch.setattr("tuning.identify.winding.time", drives)
        target = Target(drives, own.device, own.motor, own.supply, own.low, own.high, own.speed, own.current)
        found = identify(replace(target))[0]
        true = float(terminal_resistance(own.drives.machine.parameters, own.motor.kind)[0])
    resistance = found.estimates["resistance"]
    assert resistance.value == pytest.approx(true, rel=0.1)
    assert resistance.low < true < resistance.high
    assert not found.estimates["inductance"].is_known
    assert "can only be read by SDO" in found.estimates["inductance"].reason


# --- what the readings say, of drives whose winding a test knows ------------------------------------------------------
R, SUPPLY, LINE = 0.8, 24.0, 0.1  # ohm, V, ohm of the supply's line


def range_of(low, high=None, default=0.0):
    return SimpleNamespace(low=low, high=low if high is None else high, default=default)


STAGE = {
    "dead_time": range_of(0.0), "dead_time_current": range_of(0.4), "supply_resistance": range_of(0.0, 0.2, LINE),
    "adc_gain_error_a": range_of(-0.02, 0.01),
}  # fmt: skip


class Windings:
    """Two axes at rest: what their regulators hold for the current of 2004h, in mA; `more` is added to the duty."""

    num_axes = 2

    def __init__(self, resistance=R, more=lambda row: 0.0, error=0.0, angle=lambda row: 0.0, field=0):
        self.resistance, self.more, self.error, self.angle, self.field = resistance, more, error, angle, field
        self.log, self.raw, self.row = [], np.zeros(2), -1

    def write(self, name, value, *, where):
        self.log.append((name, np.broadcast_to(value, 2).tolist(), where.tolist()))
        if name is Role.OPEN_LOOP_CURRENT and np.any(value):
            self.raw, self.row = np.asarray(value, float), self.row + 1

    def advance(self, seconds):
        self.log.append(seconds)

    def duty(self):
        """R i = link duty, and the link sags by what it feeds: a quadratic equation."""
        i, r = self.raw * 1e-3, self.resistance
        a, b = 1.5 * LINE * i, SUPPLY - 0.1 * LINE
        return 2.0 * r * i / (b + np.sqrt(b * b - 4.0 * a * r * i)) + self.more(self.row)

    def read(self, name):
        return {
            Role.COMMUTATION: np.array([3, 2]), Role.FLUX_ERROR_SUM: self.duty() * 32768.0 * 256.0,
            Role.FLUX_ERROR: self.error * self.raw, Role.FIELD_ANGLE: np.full(2, self.field),
            cia402.POSITION_ACTUAL: np.full(2, self.angle(self.row)), cia402.STATUSWORD: np.zeros(2, int),
        }[name]  # fmt: skip


@pytest.fixture
def measured(monkeypatch):
    """Measure windings; return the estimates, and what the drives were told."""

    def measure(windings, *, able=(True, True), alive=(True, True), stage=STAGE, current=4.0):
        log = windings.log
        monkeypatch.setattr(module, "able", lambda working: (np.array(able), ["", "no current"]))
        monkeypatch.setattr(module, "ampere_per_count", lambda drives: 1e-3)
        monkeypatch.setattr(module, "to_counts", lambda drives, current: np.rint(current * 1e3).astype(int))
        monkeypatch.setattr(module, "enable", lambda working, mode, where: log.append((mode, where.tolist())))
        monkeypatch.setattr(module, "stay_inside", lambda working, where: log.append("inside"))
        monkeypatch.setattr(module, "still_enabled", lambda status: np.array(alive))
        monkeypatch.setattr(module, "switch_off", lambda drives, where: log.append(("off", where.tolist())))
        monkeypatch.setattr(module, "stop_causes", lambda drives: ["one", "overcurrent (2310h)"])
        motor = SimpleNamespace(kind="pmsm", n_p=4)
        device = SimpleNamespace(stage=stage, current_rate=25_000.0)
        target = SimpleNamespace(drives=windings, num_axes=2, motor=motor, device=device, supply=np.full(2, SUPPLY))
        working = SimpleNamespace(target=target, current=np.full(2, current), angle=lambda position: position)
        return standstill_resistances(working), log

    return measure


def test_currents_go_down_up_and_down_again_and_are_read_when_they_stand(measured):
    """Nine tenths, seven and five of what may be asked for; 60 ms until one stands, and eight readings 3 ms apart."""
    found, log = measured(Windings(), able=(True, False))
    yes = [True, False]
    expected = [
        (Role.COMMUTATION, [1, 1], yes), (Role.OPEN_LOOP_CURRENT, [0, 0], yes), ("csv", yes),
    ]  # fmt: skip
    for current in (3600, 2800, 2000, 2000, 2800, 3600, 3600, 2800, 2000):
        expected += [(Role.OPEN_LOOP_CURRENT, [current] * 2, yes), 0.06, "inside", *[0.003] * 8]
    expected += [("off", yes), (Role.OPEN_LOOP_CURRENT, [0, 0], yes), (Role.COMMUTATION, [3, 2], yes)]
    assert log == [pytest.approx(entry) if isinstance(entry, float) else entry for entry in expected]
    assert found[0].value == pytest.approx(R) and (found[1].is_known, found[1].reason) == (False, "no current")


def test_an_axis_of_which_none_can_be_measured_is_not_switched_on(measured):
    found, log = measured(Windings(), able=(False, False))
    assert log == [] and [one.reason for one in found] == ["", "no current"]


def test_drives_are_switched_off_and_given_back_what_they_had_whatever_happens(measured, monkeypatch):
    windings = Windings(angle=lambda row: 1 // (2 - row))  # it fails at the third current
    with pytest.raises(ZeroDivisionError):
        measured(windings)
    both = [True, True]
    assert windings.log[-3:] == [
        ("off", both), (Role.OPEN_LOOP_CURRENT, [0, 0], both), (Role.COMMUTATION, [3, 2], both)
    ]  # fmt: skip


def test_resistance_is_the_slope_of_the_voltage_over_the_current(measured):
    """With nothing in the way its interval is the sensor's gain and 1.3 % that are left out."""
    (found, _), _ = measured(Windings())
    assert found.value == pytest.approx(R, rel=1e-9) and found.unit == "ohm"
    half = R * np.hypot(0.95 * 0.02, 0.013)
    assert (found.low, found.high) == (pytest.approx(R - half), pytest.approx(R + half))


def test_its_scatter_is_that_of_a_regression(measured):
    """Against SciPy's: slope and its error, times Student's quantile for seven degrees of freedom."""
    noise = 1e-4 * np.random.default_rng(2).normal(size=9)
    windings = Windings(more=lambda row: noise[row])
    (found, _), _ = measured(windings)
    current = np.array([3.6, 2.8, 2.0, 2.0, 2.8, 3.6, 3.6, 2.8, 2.0])
    plain = Windings()
    duty = []
    for row, amps in enumerate(current):
        plain.raw = np.full(2, amps * 1e3)
        duty.append(plain.duty()[0] + noise[row])
    duty = np.array(duty)
    line = stats.linregress(current, (SUPPLY - LINE * (1.5 * duty * current + 0.1)) * duty)
    assert found.value == pytest.approx(line.slope)
    scatter = stats.t.ppf(0.975, 7) * line.stderr
    assert found.high - found.value == pytest.approx(
        np.sqrt(scatter**2 + (line.slope * np.hypot(0.95 * 0.02, 0.013)) ** 2)
    )


@pytest.mark.parametrize("field", [0, 65536 // 6, -65536 // 3])
def test_dead_time_that_half_currents_do_not_saturate_looks_like_resistance(measured, field):
    """Along phase a: all of i and half of it in the others, which fades below s = 2 A: V t f (1 + i/2s) 2/3."""
    stage = STAGE | {"dead_time": range_of(200e-9, 600e-9), "dead_time_current": range_of(2.0)}
    (found, _), _ = measured(Windings(field=field), stage=stage)
    apparent = SUPPLY * 25_000.0 / (3.0 * 2.0)  # ohm per second of dead time
    assert found.value == pytest.approx(R - 400e-9 * apparent)
    spread = 1.96 * 400e-9 * apparent * np.sqrt(2.0) / 4.0  # of five values, evenly
    half = np.hypot(spread, found.value * np.hypot(0.95 * 0.02, 0.013))
    assert found.high - found.value == pytest.approx(half)


def test_dead_time_fades_below_one_current_of_several_evenly_by_its_logarithm(measured):
    stage = STAGE | {"dead_time": range_of(400e-9), "dead_time_current": range_of(2.0, 32.0)}
    (found, _), _ = measured(Windings(), stage=stage)
    # From 4 A on all of i fades, too: a slope of 1/s, of 2 A only the halves': a third of that.
    slopes = [1.0 / 6.0, 1.0 / 4.0, 1.0 / 8.0, 1.0 / 16.0, 1.0 / 32.0]
    assert found.value == pytest.approx(R - 400e-9 * 25_000.0 * SUPPLY * np.mean(slopes))


@pytest.mark.parametrize(
    ("windings", "reason"),
    [
        ({"angle": lambda row: 0.049 * (row == 4)}, ""),
        ({"angle": lambda row: 0.051 * (row == 4)}, "the rotor did not stay at the angle of its current: it slipped"),
        ({"angle": lambda row: -0.051 * (row == 4)}, "the rotor did not stay"),
        ({"error": 0.049}, ""),
        ({"error": 0.051}, "the current did not settle: check whether the supply voltage is high enough"),
        ({"error": -0.051}, "the current did not settle"),
    ],
)
def test_what_turns_or_does_not_settle_says_nothing(measured, windings, reason):
    """0.2 rad electrical of 4 pole pairs, and a twentieth of the current."""
    (found, _), _ = measured(Windings(**windings))
    assert found.reason.startswith(reason) and found.is_known == (reason == "")


def test_a_drive_that_switched_itself_off_is_told_with_its_cause(measured):
    found, _ = measured(Windings(angle=lambda row: row), alive=(True, False))
    assert "it slipped" in found[0].reason
    assert found[1].reason == (
        "the drive switched off during the measurement with a constant current: overcurrent (2310h)"
    )


@pytest.mark.parametrize("resistance", [-0.8, 0.0])
def test_a_resistance_that_is_none_is_refused_with_its_figures(measured, resistance):
    (found, _), _ = measured(Windings(resistance=resistance))
    assert not found.is_known
    assert found.reason.startswith("excitation too weak: currents of 2 to 3.6 A leave an interval of ")


@pytest.mark.parametrize(("share", "known"), [(0.7, True), (1.1, False)])
def test_an_interval_of_more_than_a_tenth_is_no_identification(measured, share, known):
    """Dead time of 0 to so much leaves the interval that much wider."""
    apparent = SUPPLY * 25_000.0 / 6.0
    most = share * 0.1 * R / (1.96 * apparent * np.sqrt(2.0) / 4.0)
    stage = STAGE | {"dead_time": range_of(0.0, most), "dead_time_current": range_of(2.0)}
    (found, _), _ = measured(Windings(R + 0.5 * most * apparent), stage=stage)
    assert found.is_known == known
    if not known:
        assert f"leave an interval of {0.1 * R * np.hypot(1.1, 0.23):.2g} ohm around 0.8 ohm; allow" in found.reason
