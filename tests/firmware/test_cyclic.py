"""csp, csv and cst: sections 9 to 11 of the TMCM-1636 manual, and what modes/cyclic.py decides beside it."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from rigs.truth import field

from drive_env import EmulatedDrives, cia402, motion

TURN = 65536  # increments
FOLLOWS, REACHED, LIMITED, FOLLOWING_ERROR = 0x1000, 0x0400, 0x0800, 0x2000  # statusword bits 12, 10, 11, 13
TARGET = {"csp": 0x607A, "csv": 0x60FF, "cst": 0x6071}
OFFSET = {"csp": 0x60B0, "csv": 0x60B1, "cst": 0x60B2}
PERIODS = [1, 2, 4, 10]  # ms
MOVE = {"csp": 20_000, "csv": 500_000, "cst": 1_500}  # inc, pps, mA


@pytest.fixture(scope="module")
def shared():
    with EmulatedDrives(load="inertia", num_machines=2, num_threads=1) as made:
        yield made


@pytest.fixture
def drives(shared):
    """Two commissioned drives in switch on disabled."""
    shared.machine.load_torque = 0.0
    shared.machine.reset()
    shared.emergencies()
    return shared


def sine(size, n, grid):
    """One and a half periods, on a grid that every interpolation divides without remainder."""
    return (np.rint(size / grid * np.sin(3.0 * np.pi * np.arange(n) / n)) * grid).astype(int)


def trapezoid(size, n, grid):
    """Up, stay, down past zero, stay, back."""
    points = np.interp(np.arange(n) / n, [0, 0.15, 0.4, 0.65, 0.85, 1], [0, 1, 1, -0.5, -0.5, 0])
    return (np.rint(size / grid * points) * grid).astype(int)


SHAPES = {"sine": sine, "trapezoid": trapezoid}


def feed(drives, name, points, period, objects):
    """Write one set-point every `period` ms, recording between them."""
    traces = []
    for point in points:
        drives.write(name, point)
        traces.append(drives.record(objects, period / 1000))
    return {key: np.concatenate([trace[key] for trace in traces]) for key in objects}


def prepare(drives, mode, period=1):
    drives.write((0x60C2, 1), period)
    motion.enable(drives, mode)


def line(first, points, period):
    """Demand in front of each millisecond: the set-points joined by straight lines, one period late."""
    t = np.arange(len(points) * period)
    knots = np.r_[first, points]
    return np.interp(t, np.arange(len(knots)) * period, knots)


# --- following --------------------------------------------------------------------------------------------------------
def response(drives, demand, k_v=None):
    """Position and speed of an axis without friction under the cascade, its current loop without delay.

    The preset's velocity loop (comment in presets/qbl4208.toml): 20 Hz for three rotors' inertia, T_i = 5 / w_v.
    With k_v [1/s] the demand is a position [inc], without a velocity [pps].
    """
    inertia = drives.motor.inertia + drives.machine.parameters["load.inertia"][0]
    w_v = 2.0 * np.pi * 20.0
    gain = w_v * 3.0 * drives.motor.inertia / inertia
    position = speed = total = 0.0
    positions, speeds = [], []
    fine = 20
    for value in demand:
        positions.append(position)
        speeds.append(speed)
        for _ in range(fine):
            error = (value if k_v is None else k_v * (value - position)) - speed
            total += error * w_v / 5.0 * 0.001 / fine
            speed += gain * (error + total) * 0.001 / fine
            position += speed * 0.001 / fine
    return np.array(positions), np.array(speeds)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("period", PERIODS)
def test_csp_demand_is_the_line_between_set_points_one_period_late_and_the_axis_follows(drives, shape, period):
    prepare(drives, "csp", period)
    k_v = field(drives, "position_p")[0]
    # From an exact 0, so that the first segment is known too.
    drives.write(0x607A, 0)
    drives.advance(0.1)
    points = SHAPES[shape](40_000, 400 // period, 20)
    trace = feed(drives, 0x607A, points, period, [0x6062, 0x6064, 0x6041])
    demand = line(0, points, period)
    for axis in range(2):
        np.testing.assert_array_equal(trace[0x6062][:, axis], demand)
        # The position loop is a P controller: the axis follows with a lag of 1 / k_v, and that of the velocity loop.
        expected, _ = response(drives, demand, k_v)
        error = trace[0x6064][:, axis] - expected
        assert np.abs(error).max() < 0.02 * 40_000
    assert (trace[0x6041] & (FOLLOWS | REACHED | FOLLOWING_ERROR) == FOLLOWS).all()


@pytest.mark.every(2)
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("period", PERIODS)
def test_csv_demand_is_the_line_between_set_points_one_period_late_and_the_axis_follows(drives, shape, period):
    prepare(drives, "csv", period)
    start = int(drives.read(0x6062)[0])
    points = SHAPES[shape](1_000_000, 400 // period, 20)
    demand = line(0, points, period)
    seen, position, speed, word = [], [], [], []
    for k in range(len(demand)):
        if k % period == 0:
            drives.write(0x60FF, points[k // period])
        seen.append(field(drives, "velocity_demand") * TURN / (2 * np.pi))
        position.append(drives.read(0x6062))
        speed.append(drives.read(0x606C))
        word.append(drives.read(0x6041))
        drives.advance(0.001)
    np.testing.assert_allclose(seen, np.stack([demand, demand], 1), rtol=1e-12, atol=1e-6)
    # 6062h is the integral of the velocity demand.
    integral = np.r_[0, np.cumsum(0.5 * (demand[1:] + demand[:-1]))] / 1000
    np.testing.assert_allclose(np.array(position)[:, 0], start + integral, atol=1.01)
    error = np.abs(np.array(speed) - response(drives, demand)[1][:, None])
    assert error.max() < 0.05 * 1_000_000
    assert (np.array(word) & (REACHED | FOLLOWING_ERROR) == 0).all()
    assert (np.array(word) & FOLLOWS != 0).all()


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("period", PERIODS)
def test_cst_hands_each_set_point_to_the_current_loop(drives, shape, period):
    """Section 11 promises no interpolation of the torque: 60C2h changes nothing."""
    prepare(drives, "cst", period)
    points = SHAPES[shape](2_000, 200 // period, 20)
    torque, demand = [], []
    for point in points:
        drives.write(0x6071, point)
        for _ in range(period):
            drives.advance(0.001)
            torque.append(drives.read(0x6077))
            demand.append(field(drives, "torque_demand") * 1000)
    wanted = np.repeat(points, period)[:, None]
    np.testing.assert_allclose(demand, np.hstack([wanted, wanted]), atol=1e-9)
    # A millisecond is several time constants of the current loop; ADC noise and gain errors remain.
    error = np.array(torque) - wanted
    assert np.sqrt(np.mean(error**2)) < 150


def test_interpolation_period_is_value_times_ten_to_the_index(drives):
    """60C2h: 2 * 10^-2 s."""
    prepare(drives, "csp", 2)
    drives.write((0x60C2, 2), -2)
    drives.write(0x607A, 0)
    drives.advance(0.05)
    drives.write(0x607A, 20_000)
    trace = drives.record([0x6062], 0.03)
    np.testing.assert_array_equal(trace[0x6062][:, 0], np.minimum(np.arange(30) * 1000, 20_000))


# --- late, missing, early and doubled set-points ----------------------------------------------------------------------
def test_a_missing_set_point_leaves_csp_at_rest_at_the_last_one_and_csv_at_the_last_velocity(drives):
    prepare(drives, "csp", 4)
    trace = feed(drives, 0x607A, [0, 400, 800], 4, [0x6062])[0x6062]
    late = drives.record([0x6062, 0x6041], 0.02)
    assert trace[-4:, 0].tolist() == [400, 500, 600, 700]
    assert (late[0x6062] == 800).all()
    assert (late[0x6041] & FOLLOWS != 0).all()
    trace = feed(drives, 0x607A, [1200, 1600], 4, [0x6062])[0x6062]
    assert trace[:, 0].tolist() == [800, 900, 1000, 1100, 1200, 1300, 1400, 1500], "late, it takes one period too"
    drives.write(0x6060, 9)
    for point in (400_000, 800_000):
        drives.write(0x60FF, point)
        drives.advance(0.004)
    for _ in range(20):
        drives.advance(0.001)
        np.testing.assert_allclose(field(drives, "velocity_demand") * TURN / (2 * np.pi), 800_000, rtol=1e-12)


def planned(start, arrivals, period, n):
    """Demand in front of each millisecond: every set-point a line of one period from where the demand is then."""
    demand = np.empty(n)
    here, target, begin, at = float(start), float(start), float(start), 0
    for k in range(n):
        if k in arrivals:
            begin, target, at = here, arrivals[k], k
        demand[k] = here
        here = begin + (target - begin) * min((k + 1 - at) / period, 1.0)
    return demand


@pytest.mark.parametrize("period", PERIODS)
def test_set_points_at_random_times_are_planned_as_documented(drives, period):
    """Early ones take over at once, late ones find the demand at rest, doubled ones are planned anew."""
    prepare(drives, "csp", period)
    drives.write(0x607A, 0)
    drives.advance(0.05)
    random = np.random.default_rng(period)
    arrivals = {}
    k, value = 0, 0
    while k < 200:
        value += 0 if random.random() < 0.3 else int(random.integers(-2000, 2000))
        arrivals[k] = value
        k += int(random.integers(1, 2 * period + 2))
    assert len(set(np.diff(list(arrivals)))) > 1
    seen = []
    for k in range(200):
        if k in arrivals:
            drives.write(0x607A, arrivals[k])
        seen.append(drives.record([0x6062], 0.001)[0x6062][0])
    oracle = planned(0, arrivals, period, 200)
    # The oracle's half increments may round either way.
    np.testing.assert_allclose(np.array(seen)[:, 0], oracle, rtol=0, atol=0.5 + 1e-6)
    np.testing.assert_array_equal(np.array(seen)[:, 0], np.array(seen)[:, 1])


def test_two_set_points_within_a_millisecond_the_last_counts(drives):
    prepare(drives, "csp", 2)
    drives.write(0x607A, 0)
    drives.advance(0.05)
    drives.write(0x607A, 9_000)
    drives.write(0x607A, 1_000)
    assert drives.record([0x6062], 0.004)[0x6062][:, 0].tolist() == [0, 500, 1000, 1000]


@pytest.mark.parametrize("mode", ["csp", "csv", "cst"])
def test_playing_and_writing_give_the_same_integers(drives, mode):
    objects = [0x6062, 0x6064, 0x606C, 0x6077, 0x6041]
    points = sine(MOVE[mode], 150, 1)
    traces = []
    for played in (True, False):
        drives.machine.reset()
        prepare(drives, mode, 1)
        if played:
            trace = drives.record(objects, 0.15, play={TARGET[mode]: points})
            traces.append({name: trace[name] for name in objects})
        else:
            traces.append(feed(drives, TARGET[mode], points, 1, objects))
    assert np.ptp(traces[0][0x6064]) > 1000
    for name in objects:
        np.testing.assert_array_equal(traces[0][name], traces[1][name])


# --- offsets ----------------------------------------------------------------------------------------------------------
def demand_of(drives, mode):
    name, unit = {
        "csp": ("position_demand", TURN / (2 * np.pi)),
        "csv": ("velocity_demand", TURN / (2 * np.pi)),
        "cst": ("torque_demand", 1000.0),
    }[mode]
    return field(drives, name) * unit


@pytest.mark.parametrize("mode", ["csp", "csv", "cst"])
def test_60b0h_60b1h_60b2h_are_added_to_the_target(drives, mode):
    prepare(drives, mode, 4)
    drives.write(TARGET[mode], MOVE[mode])
    drives.write(OFFSET[mode], [-MOVE[mode] // 4, MOVE[mode] // 2])
    drives.advance(0.004)
    np.testing.assert_allclose(demand_of(drives, mode), [0.75 * MOVE[mode], 1.5 * MOVE[mode]], rtol=1e-9)
    # An offset that changes counts without a new target.
    drives.write(OFFSET[mode], 0)
    drives.advance(0.004)
    np.testing.assert_allclose(demand_of(drives, mode), MOVE[mode], rtol=1e-9)


@pytest.mark.parametrize("mode", ["csp", "csv", "cst"])
def test_offsets_of_other_modes_change_nothing(drives, mode):
    prepare(drives, mode, 1)
    for other in OFFSET:
        if other != mode:
            drives.write(OFFSET[other], 777)
    drives.write(TARGET[mode], MOVE[mode])
    drives.advance(0.002)
    np.testing.assert_allclose(demand_of(drives, mode), MOVE[mode], rtol=1e-9)


# --- nothing of yesterday moves the axis ------------------------------------------------------------------------------
@pytest.mark.parametrize("mode", ["csp", "csv"])
def test_an_old_target_moves_nothing_after_enabling(drives, mode):
    drives.write(TARGET[mode], MOVE[mode])
    drives.write(OFFSET[mode], MOVE[mode])
    prepare(drives, mode)
    trace = drives.record([0x6062, 0x6064], 0.2)
    assert (np.abs(trace[0x6062]) <= 16).all()
    assert (np.abs(trace[0x6064]) <= 48).all()
    drives.write(TARGET[mode], MOVE[mode])
    drives.advance(0.2)
    assert (drives.read(0x6064) > 10_000).all()
    # And again after switching off in motion.
    motion.disable(drives)
    drives.advance(0.5)
    motion.enable(drives)
    before = drives.read(0x6064)
    drives.advance(0.2)
    np.testing.assert_allclose(drives.read(0x6064), before, atol=48)


@pytest.mark.parametrize("mode", ["csp", "csv"])
def test_an_old_target_moves_nothing_after_a_change_of_mode(drives, mode):
    drives.write(TARGET[mode], MOVE[mode])
    motion.enable(drives, "pp")
    drives.advance(0.05)
    motion.select_mode(drives, mode)
    trace = drives.record([0x6062, 0x6064], 0.2)
    assert (np.abs(trace[0x6062]) <= 16).all()
    assert (np.abs(trace[0x6064]) <= 48).all()


# --- statusword -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("mode", ["csp", "csv", "cst"])
def test_bit_12_tells_that_the_target_is_used_and_bit_10_is_reserved(drives, mode):
    """Tables 237, 263 and 283."""
    motion.select_mode(drives, mode)
    for word in (0x06, 0x07):
        drives.write(0x6040, word)
        drives.advance(0.002)
        assert (drives.read(0x6041) & (FOLLOWS | FOLLOWING_ERROR | REACHED) == 0).all()
    drives.write(0x6040, 0x0F)
    drives.write(TARGET[mode], MOVE[mode])
    drives.advance(0.001)
    trace = drives.record([0x6041], 0.1)
    assert (trace[0x6041] & (FOLLOWS | FOLLOWING_ERROR | REACHED) == FOLLOWS).all()
    drives.write(0x6040, 0x02)  # quick stop
    drives.advance(0.001)
    assert (drives.read(0x6041) & FOLLOWS == 0).all()


@pytest.mark.parametrize(("mode", "bit_13"), [("csp", FOLLOWING_ERROR), ("csv", 0)])
def test_bit_13_tells_a_following_error_in_csp_only(drives, mode, bit_13):
    drives.write(0x6065, 3_000)
    prepare(drives, mode)
    drives.write(TARGET[mode], {"csp": 10_000, "csv": 3_000_000}[mode])
    drives.advance(1.0)
    assert (drives.read(0x6041) & 0x4F == 0x08).all()
    assert {message.name for message in drives.emergencies()} == {"following_error"}
    assert (drives.read(0x6041) & (FOLLOWING_ERROR | FOLLOWS) == bit_13).all()
    motion.reset_fault(drives)
    assert (drives.read(0x6041) & FOLLOWING_ERROR == 0).all()


# --- limits -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("target", "end"), [(50_000, 12_000), (-50_000, -9_000), (12_000, None), (-9_000, None)])
def test_csp_is_clamped_to_607dh_corrected_by_the_home_offset_and_bit_11_tells_it(drives, target, end):
    drives.write((0x607D, 1), -8_000)
    drives.write((0x607D, 2), 13_000)
    drives.write(0x607C, 1_000)
    prepare(drives, "csp", 10)
    drives.write(0x607A, target)
    drives.advance(0.3)
    np.testing.assert_array_equal(drives.read(0x6062), target if end is None else end)
    np.testing.assert_allclose(drives.read(0x6064), target if end is None else end, atol=200)
    assert ((drives.read(0x6041) & LIMITED != 0) == (end is not None)).all()
    assert (drives.read(0x6041) & 0x6F == 0x27).all()
    drives.write(0x607A, 0)
    drives.advance(0.3)
    assert (drives.read(0x6041) & LIMITED == 0).all()
    np.testing.assert_array_equal(drives.read(0x6062), 0)


def test_the_offset_counts_for_the_limit_too(drives):
    drives.write((0x607D, 2), 10_000)
    prepare(drives, "csp", 1)
    drives.write(0x607A, 9_000)
    drives.write(0x60B0, 2_000)
    drives.advance(0.01)
    np.testing.assert_array_equal(drives.read(0x6062), 10_000)
    assert (drives.read(0x6041) & LIMITED != 0).all()


def test_csv_stops_at_the_software_limit_and_may_go_back(drives):
    drives.write((0x607D, 2), 20_000)
    prepare(drives, "csv", 1)
    drives.write(0x60FF, 300_000)
    drives.advance(0.5)
    assert (drives.read(0x6041) & 0x6F == 0x27).all()
    assert (drives.read(0x6041) & LIMITED != 0).all()
    assert (np.abs(drives.read(0x6064) - 20_000) < 3_000).all()
    assert {message.name for message in drives.emergencies()} == {"positive_software_limit"}
    drives.write(0x60FF, -300_000)
    drives.advance(0.2)
    assert (drives.read(0x6064) < 0).all()
    assert (drives.read(0x6041) & LIMITED == 0).all()


@pytest.mark.parametrize("sign", [-1, 1])
def test_2003h_limits_the_current_of_cst_offset_included(drives, sign):
    drives.write(0x2003, 1_000)
    prepare(drives, "cst")
    drives.write(0x6071, sign * 800)
    drives.write(0x60B2, sign * 800)
    drives.advance(0.005)
    np.testing.assert_allclose(field(drives, "i_q_ref"), sign * 1.0, rtol=1e-12)
    np.testing.assert_allclose(drives.record([0x6077], 0.02)[0x6077].mean(0), sign * 1_000, rtol=0.1)


# --- stop and change in motion ----------------------------------------------------------------------------------------
def run_up(drives, mode, speed=500_000):
    """Bring the axes to `speed` [pps] in a mode; return the position that the next csp set-point continues from."""
    prepare(drives, mode)
    if mode == "csp":
        ramp = np.r_[np.linspace(0, 1, 50), np.ones(250)] * speed / 1000
        drives.record([0x6064], 0.3, play={0x607A: np.rint(np.cumsum(ramp)).astype(int)})
    elif mode == "cst":
        for _ in range(300):
            drives.write(0x6071, np.clip((speed - drives.read(0x606C)) // 200 + 100, -1500, 1500))
            drives.advance(0.001)
    elif mode == "pp":
        drives.write(0x6081, speed)
        motion.start_move(drives, 10_000_000)
        drives.advance(0.3)
    else:
        drives.write(0x60FF, speed)
        drives.advance(0.3)
    np.testing.assert_allclose(drives.read(0x606C), speed, rtol=0.15)


def after_50_ms(drives, mode):
    """Speed [pps] 50 ms after 500 000 began to fall by 5 000 000 pps^2; the position loop follows 1 / k_v late."""
    if mode != "csp":
        return 250_000
    lag = 1.0 / field(drives, "position_p")[0]
    return 500_000 - 5_000_000 * (0.05 - lag * (1.0 - np.exp(-0.05 / lag)))


@pytest.mark.parametrize("mode", ["csp", "csv", "cst"])
def test_halt_brakes_with_the_deceleration_of_the_mode_and_the_old_target_stays_ignored(drives, mode):
    rate = 5_000_000
    drives.write(0x6084, rate)
    run_up(drives, mode)
    drives.write(0x6040, 0x010F)
    trace = drives.record([0x606C, 0x6041, 0x6064], 0.3)
    np.testing.assert_allclose(trace[0x606C][45:55].mean(0), after_50_ms(drives, mode), rtol=0.1)
    assert (np.abs(trace[0x606C][250:]) < 25_000).all()
    assert (trace[0x6041][1:] & FOLLOWS == 0).all(), "the target is ignored"
    assert (trace[0x6041] & 0x6F == 0x27).all()
    assert (np.diff(trace[0x6064], axis=0)[5:80] > 0).all()


@pytest.mark.parametrize("mode", ["csp", "csv", "cst"])
def test_quick_stop_brakes_with_6085h_and_ends_in_switch_on_disabled(drives, mode):
    drives.write(0x6085, 5_000_000)
    run_up(drives, mode)
    drives.write(0x6040, 0x02)
    trace = drives.record([0x606C, 0x6041], 0.4)
    np.testing.assert_allclose(trace[0x606C][45:55].mean(0), after_50_ms(drives, mode), rtol=0.1)
    assert (trace[0x6041][1:90] & 0x6F == 0x07).all()
    assert (trace[0x6041][1:90] & FOLLOWS == 0).all()
    assert (trace[0x6041][-1] & 0x4F == 0x40).all()
    assert (np.abs(trace[0x606C][-20:]) < 20_000).all()


@pytest.mark.parametrize(("before", "after"), permutations(("csp", "csv", "cst", "pp", "pv"), 2))
def test_changing_the_mode_in_motion_does_not_jump(drives, before, after):
    """The new mode's first targets continue the motion; speed, demand and current stay near what they were."""
    speed = 500_000
    run_up(drives, before, speed)
    here = drives.read(0x6062)
    drives.write(0x6060, cia402.MODES[after])
    play = {}
    if after == "csp":
        # The master continues from the demand that it reads back.
        play = {0x607A: drives.read(0x6062) + np.outer(np.arange(1, 101), [speed // 1000] * 2)}
    elif after in ("csv", "pv"):
        play = {0x60FF: np.full(100, speed)}
    elif after == "cst":
        play = {0x6071: np.full(100, 100)}
    else:
        drives.write(0x6081, speed)
        drives.write(0x607A, 10_000_000)
        drives.write(0x6040, 0x1F)
    trace = drives.record([0x606C, 0x6062, 0x6064, 0x6077], 0.1, play=play)
    # The demand may step by the following error at most, which a change between position and velocity loop forgets.
    lag = 1.2 * speed / field(drives, "position_p")[0]
    assert (np.abs(trace[0x6062][0] - here) <= lag).all()
    # Row 0 is from before the change.
    assert (np.abs(np.diff(trace[0x6062], axis=0))[0] <= lag).all()
    assert (np.abs(np.diff(trace[0x6062], axis=0))[1:] <= 1.2 * speed / 1000).all()
    assert (np.diff(trace[0x6064], axis=0) >= -16).all(), "never backwards"
    # Measured 483 000 to 513 000 pps, 250 mA; a step of the whole speed would take more than 1 A.
    np.testing.assert_allclose(trace[0x606C], speed, rtol=0.06)
    assert np.abs(trace[0x6077]).max() < 500
