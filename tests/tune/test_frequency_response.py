"""Frequency responses measured on emulated axes, in process and over a bus, against the linear model of the truth."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from rigs.known_machines import true_plant
from rigs.world_bus import served

from drive_env import EmulatedDrives, cia402, motion
from drive_env.devices import find_device
from drive_env.devices.gains import BASELINE_RULE, rule_gains
from drive_env.drives.raw_gains import read_gains, write_gains
from drive_env.loops.linear_model import Plant, position_open_loop, velocity_open_loop
from drive_env.loops.margins import margins
from drive_env.motors import find_motor
from tuning.response import excitation_run
from tuning.response.frequency_response import Signal, measure
from tuning.response.held_samples import seen_by_bus
from tuning.response.measured_loop import COHERENT, merged
from tuning.response.plant_fit import Seen, fit_plant
from tuning.target import Target, emulated

SOFT = BASELINE_RULE._replace(speed=0.1, integration=1.38, position=1.0)  # crossover at about 20 Hz
FINE = {"motor.encoder_interpolation": 16.0}  # 65,536 counts per turn
GRID = np.geomspace(5.0, 1000.0, 4000)


def tuned(load, **options):
    """Machines with gains that leave them margins, and what the machines truly are."""
    target = emulated(load=load, **options)
    plants = [true_plant(target.drives, axis) for axis in range(target.num_axes)]
    gains = rule_gains(target.device, target.motor, np.array([plant.inertia for plant in plants]), SOFT)
    write_gains(target.drives, gains)
    return target, plants, gains


class Measured(dict):
    """Axes with a load, measured once with the trace when a test asks for them: target, plants, gains, response."""

    def __missing__(self, load):
        with np.errstate(all="raise", under="ignore"):
            found = tuned(load, num_machines=2, seed=1, randomise=["load"], parameters=FINE)
            self[load] = (*found, measure(found[0], signal=Signal(high=400.0), traced=True))
        return self[load]


@pytest.fixture(scope="module")
def measured():
    return Measured()


# --- margins ----------------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("load", ["inertia", "two_mass"])
def test_measured_margins_are_those_of_the_linear_model(measured, load):
    target, plants, gains, response = measured[load]
    for axis, plant in enumerate(plants):
        expected = margins(GRID, velocity_open_loop(target.device, plant, gains[axis], GRID))
        found = response.margins(axis)
        assert found.phase_deg == pytest.approx(expected.phase_deg, abs=3.0)
        assert found.gain_db == pytest.approx(expected.gain_db, abs=1.0)
        assert found.crossover_hz == pytest.approx(expected.crossover_hz, rel=0.05)
        assert found.bandwidth_hz == pytest.approx(expected.bandwidth_hz, rel=0.08)
        assert found.ms == pytest.approx(expected.ms, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("load", ["inertia", "two_mass"])
def test_trusted_lines_lie_on_the_model_also_those_of_the_trace(measured, load):
    target, plants, gains, response = measured[load]
    for axis, plant in enumerate(plants):
        good = response.trusted[:, axis] & (response.f < 700.0)
        away = np.abs(response.f / plant.anti_resonance - 1.0) > 0.15
        ratio = response.open_loop[:, axis] / velocity_open_loop(target.device, plant, gains[axis], response.f)
        for lines in (good & away & ~response.traced, good & away & response.traced):
            assert lines.sum() >= 5
            assert np.median(np.abs(20.0 * np.log10(np.abs(ratio[lines])))) < 0.6
            assert np.median(np.abs(np.degrees(np.angle(ratio[lines])))) < 4.0


@pytest.mark.slow
def test_images_of_held_set_points_are_taken_out(measured):
    target, plants, gains, response = measured["inertia"]
    # Without that, lines at 300 to 400 Hz would be off by a tenth to a quarter.
    high = (response.f >= 300.0) & ~response.traced
    for axis, plant in enumerate(plants):
        ratio = response.open_loop[high, axis] / velocity_open_loop(target.device, plant, gains[axis], response.f[high])
        assert abs(np.mean(20.0 * np.log10(np.abs(ratio)))) < 0.5
        assert abs(np.mean(np.degrees(np.angle(ratio)))) < 3.0


def test_what_lies_above_the_frequencies_looked_at_gives_no_gain_margin():
    response = measure(tuned("inertia", parameters=FINE)[0], signal=Signal(high=150.0))
    assert math.isnan(response.margins().gain_db)
    assert math.isfinite(response.margins().phase_deg)


def test_the_position_loop_has_the_model_s_margin():
    target, plants, gains = tuned("two_mass", num_machines=2, parameters=FINE)
    response = measure(target, "position", signal=Signal(high=30.0))
    for axis, plant in enumerate(plants):
        f = np.geomspace(2.0, 400.0, 2000)
        expected = margins(f, position_open_loop(target.device, plant, gains[axis], f))
        assert response.margins(axis).phase_deg == pytest.approx(expected.phase_deg, abs=3.0)
        assert response.margins(axis).crossover_hz == pytest.approx(expected.crossover_hz, rel=0.05)
    with pytest.raises(ValueError, match="position loop does not give the axis model"):
        response.estimates()


def test_a_chirp_says_what_a_multisine_says():
    target, plants, gains = tuned("inertia", parameters=FINE)
    expected = margins(GRID, velocity_open_loop(target.device, plants[0], gains[0], GRID))
    found = measure(target, signal=Signal("chirp")).margins()
    assert found.phase_deg == pytest.approx(expected.phase_deg, abs=4.0)
    assert found.crossover_hz == pytest.approx(expected.crossover_hz, rel=0.06)


# --- what the response tells of the plant -----------------------------------------------------------------------------
def test_resonance_and_anti_resonance_come_with_intervals_that_hold_the_truth(measured):
    _, plants, _, response = measured["two_mass"]
    for axis, plant in enumerate(plants):
        found = response.estimates(axis)
        for name, near in (("resonance", 0.02), ("anti_resonance", 0.03)):
            true = getattr(plant, name)
            assert found[name].value == pytest.approx(true, rel=near)
            assert found[name].low < true < found[name].high
            assert found[name].high - found[name].low < 0.1 * true


@pytest.mark.slow
def test_on_forty_random_machines_a_resonance_is_right_or_refused():
    target, plants, _ = tuned("two_mass", num_machines=40, seed=6, randomise=True)
    response = measure(target)
    gains, f = read_gains(target.drives), np.geomspace(100.0, 500.0, 2000)
    known = inside = 0
    for axis, plant in enumerate(plants):
        if response.fits[axis] is None:  # 7 of them oscillate indeed, by the linear model of what they are
            with pytest.raises(ValueError, match="the loop oscillates at") as refusal:
                response.estimates(axis)
            L = velocity_open_loop(target.device, plant, gains[axis], f)
            crossing = int(np.flatnonzero(np.diff(np.unwrap(np.angle(L)) < -math.pi))[0])
            assert abs(L[crossing]) > 1.0, axis
            assert float(re.search(r"at (\d+) Hz", str(refusal.value))[1]) == pytest.approx(f[crossing], rel=0.05)
            continue
        found = response.estimates(axis)["resonance"]
        if found.is_known:
            known += 1
            inside += found.low < plant.resonance < found.high
            assert found.value == pytest.approx(plant.resonance, rel=0.02)
        else:
            assert found.reason
    assert known >= 20
    assert inside >= 0.9 * known


@pytest.mark.parametrize("load", ["inertia", "two_mass"])
def test_inertia_delay_and_filter_are_found(measured, load):
    _, plants, _, response = measured[load]
    for axis, plant in enumerate(plants):
        found = response.estimates(axis)
        assert found["inertia"].value == pytest.approx(plant.inertia, rel=0.06)
        assert found["velocity_filter"].value == pytest.approx(400.0, rel=0.06)
        assert found["loop_delay"].value == pytest.approx(plant.delay, abs=40e-6)


def test_a_filter_that_is_another_is_told_apart():
    target, _, _ = tuned("inertia", num_machines=2, parameters=FINE | {"stage.velocity_filter": [250.0, 600.0]})
    response = measure(target, signal=Signal(high=400.0))
    for axis, corner in enumerate((250.0, 600.0)):
        assert response.estimates(axis)["velocity_filter"].value == pytest.approx(corner, rel=0.08)


def test_a_rigid_axis_has_no_resonance_and_says_so(measured):
    response = measured["inertia"][3]
    for axis in range(2):
        for name in ("resonance", "anti_resonance"):
            assert math.isnan(response.estimates(axis)[name].value)
            assert "no resonance between 5 and 400 Hz" in response.estimates(axis)[name].reason


# --- over the bus -----------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize(("interpolation", "high"), [(16.0, 400.0), (1.0, 200.0)])
def test_over_a_bus_nine_lines_in_ten_are_coherent_in_two_seconds(interpolation, high):
    motor = find_motor("qbl4208")
    machine = {"load": "two_mass", "parameters": {"motor.encoder_interpolation": interpolation}}
    with served("calls", **machine) as drives:
        free = np.array([np.inf])
        supply = np.array([motor.voltage])
        target = Target(
            drives, find_device("tmcm1636"), motor, supply, -free, free, motor.rated_speed, motor.rated_current
        )
        response = measure(target, signal=Signal(high=high))
    assert response.f[0] == 5.0
    assert response.f[-1] == high
    assert np.mean(response.coherence[:, 0] > COHERENT) >= 0.9
    assert response.drive_time < 2.0
    assert response.peak_current[0] < 1.15 * motor.rated_current  # what is asked for; the sensor's noise comes on top
    assert not response.traced.any()
    # And it is what the emulator says without a bus, to the bit.
    own = measure(emulated(**machine), signal=Signal(high=high))
    assert np.array_equal(own.open_loop, response.open_loop)


def test_above_400_hz_there_is_only_the_trace_and_it_is_marked(measured):
    response = measured["two_mass"][3]
    assert response.traced.any()
    assert np.array_equal(response.traced, response.f > 400.0)


def test_a_bus_cannot_be_traced_nor_asked_beyond_400_hz():
    with served("calls", load="inertia") as drives:
        motor, free = find_motor("qbl4208"), np.array([np.inf])
        target = Target(drives, find_device("tmcm1636"), motor, np.array([24.0]), -free, free, 300.0, 3.0)
        with pytest.raises(ValueError, match="exists on emulated drives only; on a bus up to 400 Hz can be measured"):
            measure(target, traced=True)
        with pytest.raises(ValueError, match="450 Hz must be at most 400 Hz"):
            measure(target, signal=Signal(high=450.0))


# --- what is not truth ------------------------------------------------------------------------------------------------
def test_noise_is_not_coherent():
    noisy = {"stage.adc_noise": 3.0, "motor.cogging_torque": 0.03}
    target, _, _ = tuned("inertia", parameters=noisy, current=0.3)
    response = measure(target, signal=Signal(high=200.0))
    quiet = measure(tuned("inertia", parameters=FINE)[0], signal=Signal(high=200.0))
    assert response.trusted.mean() < 0.5
    assert quiet.trusted.mean() > 0.95
    assert np.isfinite(response.open_loop).all()


@pytest.mark.slow
def test_friction_on_a_short_way_is_told_and_is_not_coherent_either():
    # 0.3 turns: the motion reverses, and what dry friction answers depends on the wave.
    target = emulated(load="vertical_screw", travel=(-0.3 * math.pi, 0.3 * math.pi))
    response = measure(target)
    assert any("travel is too short for a steady speed" in note for note in response.notes[0])
    assert response.trusted.mean() < 0.8


@pytest.mark.parametrize(("low", "high"), [(-0.3, 0.3), (0.0, 0.5), (-0.5, 0.0)])
def test_the_travel_is_kept_and_the_axis_ends_where_it_began(low, high):
    turn = 2.0 * math.pi
    target = emulated(load="inertia", travel=(low * turn, high * turn), parameters=FINE)
    seen = []

    class Watched:
        def record(self, objects, *arguments, **options):
            trace = target.drives.record([*objects, 0x6064], *arguments, **options)
            seen.append(trace[0x6064])
            return trace

        def __getattr__(self, name):
            return getattr(target.drives, name)

    from dataclasses import replace

    measure(replace(target, drives=Watched()))
    turns = np.concatenate(seen) / 65536.0
    assert low - 1e-3 <= turns.min()
    assert turns.max() <= high + 1e-3
    assert np.ptp(turns) > 0.05
    assert abs(turns[-1, 0]) < 0.05


def test_an_axis_is_left_as_it_was_found():
    target, _, _ = tuned("inertia", num_machines=3)
    drives = target.drives
    from drive_env import motion

    motion.select_mode(drives, "pp")
    motion.select_mode(drives, "pv", where=np.array([True, False, False]))
    motion.enable(drives, where=np.array([True, False, False]))
    drives.write((0x60C2, 1), 4)
    before = [drives.read(name) for name in (0x6061, (0x60C2, 1), (0x60C2, 2))]
    measure(target, where=np.array([True, True, False]))
    assert [list(drives.read(name)) for name in (0x6061, (0x60C2, 1), (0x60C2, 2))] == [list(v) for v in before]
    on = drives.read(0x6041) & 0x6F == 0x27
    assert list(on) == [True, False, False]


def test_an_offset_of_the_user_changes_nothing():
    target, _, _ = tuned("inertia", num_machines=2, parameters=FINE)
    target.drives.write(0x60B1, np.array([0, 5 * 65536]))
    response = measure(target)
    assert response.margins(1).phase_deg == pytest.approx(response.margins(0).phase_deg, abs=3.0)
    # The drive adds it to what is played: not counted on, it would carry the axis nine turns away.
    assert np.abs(target.drives.read(0x6064)).max() < 0.5 * 65536


@pytest.mark.slow
def test_axes_of_one_machine_are_shaken_one_after_the_other():
    target = emulated(load="gantry")
    response = measure(target, signal=Signal(high=100.0))
    assert response.drive_time > 3.0
    assert np.isfinite(response.open_loop).all()
    assert all(fit is not None for fit in response.fits)


def test_only_the_chosen_axes_are_measured():
    target, _, _ = tuned("inertia", num_machines=3)
    response = measure(target, where=np.array([False, True, False]))
    assert np.isnan(response.open_loop[:, [0, 2]]).all()
    assert response.trusted[:, 1].any()
    assert not response.trusted[:, [0, 2]].any()
    assert target.drives.read(0x6064)[0] == 0


# --- confirmed by a weaker shaking ------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def looked_at():
    """What a bus would see of a two-mass axis whose resonance is moved by a factor: factor, lines -> Seen."""
    target, plants, gains = tuned("two_mass", num_threads=1)
    start = Plant.from_data_sheet(target.device, target.motor, 24.0, 3.0 * target.motor.inertia)
    rng = np.random.default_rng(7)

    def seen(factor=1.0, lines=80, noise=0.01):
        f = np.arange(1, lines + 1) * 5.0
        moved = replace(
            plants[0], anti_resonance=factor * plants[0].anti_resonance, resonance=factor * plants[0].resonance
        )

        def closed(at):
            L = velocity_open_loop(target.device, moved, gains[0], at)
            return L / (1.0 + L)

        T = seen_by_bus(target.device, f, closed)
        return Seen(f, T * (1.0 + noise * rng.standard_normal(lines)), np.full(lines, noise))

    return seen, lambda full, less: fit_plant(target.device, gains[0], *full, start, less=less), plants[0]


@pytest.mark.slow
def test_a_resonance_that_a_weaker_shaking_confirms_is_told(looked_at):
    seen, fit, plant = looked_at
    found = fit(seen(), seen(noise=0.03)).estimates["resonance"]
    assert found.value == pytest.approx(plant.resonance, rel=0.01)
    assert found.low < plant.resonance < found.high


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.85, 0.95, 1.1])
def test_a_resonance_that_moves_with_the_strength_of_the_shaking_is_refused(looked_at, factor):
    """As with backlash: neither of the two is the axis's."""
    seen, fit, plant = looked_at
    estimates = fit(seen(), seen(factor)).estimates
    for name in ("resonance", "anti_resonance", "damping"):
        assert not estimates[name].is_known
        assert "backlash" in estimates[name].reason
    weaker = re.search(r"at ([\d.]+) Hz with a weaker excitation", estimates["resonance"].reason)
    assert float(weaker[1]) == pytest.approx(factor * plant.resonance, rel=0.01)
    assert estimates["velocity_filter"].is_known


@pytest.mark.slow
def test_by_what_it_moves_a_little_the_interval_is_wider(looked_at):
    seen, fit, _ = looked_at
    alike, other = (fit(seen(), seen(factor)).estimates["resonance"] for factor in (1.0, 1.015))
    assert other.high - other.low > 1.5 * (alike.high - alike.low)


@pytest.mark.slow
def test_what_cannot_be_confirmed_is_refused(looked_at):
    seen, fit, _ = looked_at
    assert "only 8 frequencies are coherent" in fit(seen(), seen(lines=8)).estimates["resonance"].reason
    assert "does not confirm it" in fit(seen(), seen(noise=1.5)).estimates["resonance"].reason


@pytest.mark.slow
@pytest.mark.parametrize("dead_time", [100e-9, 600e-9])
def test_dead_time_is_not_taken_for_a_slower_velocity_filter(dead_time):
    """A small motor, whose current loop dead time slows down: without knowing, 400 Hz look like 280."""
    known = {"stage.dead_time": dead_time, "stage.velocity_filter": 400.0}
    target, _, _ = tuned("inertia", motor="ec_i_40", num_machines=2, seed=2, parameters=known, num_threads=1)
    response = measure(target, confirmed=True)
    for axis in range(2):
        found = response.estimates(axis)["velocity_filter"]
        assert found.low < 400.0 < found.high
        assert found.value == pytest.approx(400.0, rel=0.15)


@pytest.mark.slow
def test_of_a_tgz_as_auto_tunes_it_the_margins_are_the_model_s_but_for_what_its_dead_time_takes():
    """Gains that count integration times. At 560 V dead time swallows small currents: some degrees at the crossover."""
    gains, lag = np.array([[3944, 2985, 13_238, 12_866, 357_034, 1000]]), []
    for dead_time in (0.0, 2e-6):
        with emulated("tgz_d", "inertia", num_threads=1, parameters={"stage.dead_time": dead_time}) as target:
            write_gains(target.drives, gains)
            plant, response = true_plant(target.drives), measure(target)
        lines = response.trusted[:, 0] & ~response.traced & (response.f > 60.0) & (response.f < 160.0)
        model = velocity_open_loop(target.device, plant, gains[0], response.f[lines])
        lag.append(np.degrees(np.angle(response.open_loop[lines, 0] / model)).mean())
        if dead_time == 0.0:
            expected = margins(GRID, velocity_open_loop(target.device, plant, gains[0], GRID))
            found = response.margins()
            assert found.phase_deg == pytest.approx(expected.phase_deg, abs=2.0)
            assert found.gain_db == pytest.approx(expected.gain_db, abs=0.5)
            assert found.ms == pytest.approx(expected.ms, rel=0.05)
    assert abs(lag[0]) < 2.5 and lag[1] < lag[0] - 3.0


# --- mistakes ---------------------------------------------------------------------------------------------------------
def test_a_loop_without_gains_is_not_shaken():
    with pytest.raises(ValueError, match="a P gain is 0 on every axis and the loop is open: give the drives gains"):
        measure(emulated(load="inertia", factory_fresh=True))
    target, _, _ = tuned("inertia", num_machines=2)
    target.drives.write((0x2042, 1), np.array([0, 200]))
    response = measure(target)
    assert any("gain is 0" in note for note in response.notes[0])
    assert not response.trusted[:, 0].any()
    assert response.trusted[:, 1].any()


def test_a_loop_that_oscillates_is_told_with_its_frequency():
    """Its true gain margin is -2.4 dB at 243 Hz, by the linear model of what it is; it said "excitation too weak"."""
    with emulated(load="two_mass", randomise=True, seed=1, num_threads=1) as target:
        f = np.geomspace(2.0, 2000.0, 20_000)
        L = velocity_open_loop(target.device, true_plant(target.drives), read_gains(target.drives)[0], f)
        crossing = f[np.flatnonzero(np.diff(np.unwrap(np.angle(L)) < -math.pi))[0]]
        assert 20.0 * math.log10(abs(L[np.searchsorted(f, crossing)])) > 2.0, "it is unstable"
        response = measure(target)
    note = " ".join(response.notes[0])
    told = re.search(r"the loop oscillates at (\d+) Hz", note)
    assert told is not None, note
    assert float(told[1]) == round(response.oscillation[0]) == pytest.approx(crossing, rel=0.05)
    assert "too weak" not in note


def test_a_loop_that_oscillates_is_no_response():
    target = emulated(load="two_mass")
    write_gains(target.drives, np.full((1, 5), 32767))
    response = measure(target)
    assert not response.trusted.any()
    assert any("the loop oscillates at 2" in note for note in response.notes[0])  # 227 Hz
    assert not any("too weak" in note for note in response.notes[0])
    assert math.isnan(response.margins().phase_deg)
    first = replace(response, oscillation=np.zeros(1), notes=((),))
    both = merged([first, response])
    assert both.oscillation == response.oscillation > 0.0 and both.notes == response.notes, "also of a later axis"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"loop": "current"}, "no loop is named 'current'; there are velocity, position"),
        ({"signal": Signal("noise")}, "no excitation is named 'noise'; there are multisine, chirp"),
        ({"signal": Signal(resolution=3.3)}, "must divide 1000 Hz"),
        ({"where": np.array([False])}, "no axis is chosen"),
    ],
)
def test_what_cannot_be_measured_is_refused_before_anything_moves(arguments, message):
    target = emulated(load="inertia")
    with pytest.raises(ValueError, match=message):
        measure(target, **arguments)
    assert target.drives.read(0x6041)[0] & 0x6F != 0x27


def test_an_axis_that_goes_on_after_an_excitation_has_both_of_its_modes():
    """A mode of operation alone would leave the D-Mode of the excitation, with which the axis ignores its master."""
    with EmulatedDrives("tgz_d", "inertia", num_machines=2, num_threads=1) as drives:
        motion.enable(drives, mode="pp")
        modes = drives.read(cia402.MODE)
        motion.enable(drives, mode="csv")
        excitation_run._give_modes_back(drives, modes, np.array([True, True]))
        drives.advance(0.02)
        assert drives.read(cia402.MODE).tolist() == [1, 1] and drives.read(0x2303).tolist() == [7, 7]
        words = drives.read(cia402.STATUSWORD)
        assert cia402.matches(words, cia402.OPERATION_ENABLED).all() and (words & cia402.REMOTE.mask).all()
