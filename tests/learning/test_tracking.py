"""ServoDrive/Tracking-v0: the agent as outer controller, in many environments, alone, and over CAN."""

from __future__ import annotations

from contextlib import contextmanager

import mujoco
import numpy as np
import pytest
from rigs.chip_gains import Gains, bandwidths_from_gains
from scipy.linalg import solve_continuous_are

from drive_env import EmulatedDrives
from drive_env.devices import find_device
from drive_env.envs import tracking_cycle as cycle
from drive_env.envs.highest_speed import highest_speeds
from drive_env.envs.tracking import OBJECTS, OTHER, TASKS, TERMS, WEIGHTS, Tracking, TrackingConfig
from drive_env.envs.trajectories import TRAJECTORIES, draw
from drive_env.phase_current import amplitude, rated_setting
from mechanics.loads import LOADS as ALL_LOADS

GAIN_OBJECTS = find_device("tmcm1636").gains.keys

NAME = "ServoDrive/Tracking-v0"
LOADS = tuple(TASKS)


@contextmanager
def tracking(num_envs=1, **options):
    lanes = Tracking(num_envs, **{"num_threads": 1, **options})
    try:
        yield lanes
    finally:
        lanes.close()


def actions(steps, lanes, axes=1, seed=3):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, lanes, axes)).astype(np.float32)


def run(lanes, given, seed=0):
    """Return observations, rewards and ends of an episode and a bit more."""
    first, _ = lanes.reset(seed=seed)
    rows = [(first, np.zeros(lanes.num_envs), np.zeros(lanes.num_envs, bool), np.zeros(lanes.num_envs, bool))]
    rows += [lanes.step(action)[:4] for action in given]
    return [np.stack(column) for column in zip(*rows, strict=True)]


# --- what the page says -----------------------------------------------------------------------------------------------
def test_the_page_has_the_terms_of_the_reward_with_their_margins_and_weights():
    margins = cycle.MARGINS
    rows = {
        "tracking": f"g(position error, {margins['tracking']:g} amplitude), or the configuration's margin, as below",
        "speed": f"g(velocity error, {margins['speed']:g} speed)",
        "load": f"g(angle of the pendulum, {margins['load']:g} rad); 0 of a load without sensor",
        "carried": f"g(error of where the bob is, {margins['tracking']:g} amplitude); 0 of a load without sensor",
        "effort": "g(torque actual value, current limit)",
        "smoothness": f"g(change of the action, {margins['smoothness']:g})",
        "pace": "(velocity / its highest)² forwards, at most 1; what the highest is stands below",
        "trip": "1 in the step in which a drive tripped or the pole fell",
    }
    assert tuple(rows) == TERMS
    assert margins["effort"] == 1.0
    for name, value in rows.items():
        assert f"| {name} | {value} | {WEIGHTS[name]:g}" in Tracking.__doc__
    assert cycle.tolerance(0.3, 0.3) == pytest.approx(0.1)


def test_the_page_has_what_each_load_follows_by_default():
    said = " ".join(TrackingConfig.__doc__.split())
    for name in ("two_mass", "gantry", "cart_pendulum"):
        assert f"{name} {TASKS[name].amplitude:g} and {TASKS[name].speed:g}" in said
    assert f"every other load {OTHER.amplitude:g} and {OTHER.speed:g}" in said
    pole = TASKS["inverted_pendulum"]
    assert f"{pole.trajectory}, {pole.amplitude:g} rev and {pole.speed:g} rev/s for inverted_pendulum" in said
    assert {name for name, task in TASKS.items() if task.mode == "csv"} == {
        "gantry",
        "cart_pendulum",
        "inverted_pendulum",
    }


# --- the interface ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mode": "pp"}, r"mode is one of 'csp', 'csv', 'cst', not 'pp'"),
        ({"action": "gain"}, r"action is one of 'direct', 'offset', 'ramp', not 'gain'"),
        ({"rate": 250}, r"rate is one of 500, 1000, not 250"),
        ({"trajectory": "circle"}, r"'hold', 'moves', 'sines', 'run', not 'circle'"),
        ({"weights": {"speeed": 1.0}}, r"a weight's name is one of 'tracking', .*not 'speeed'"),
        ({"delay": 0}, r"delay is 1\.\.\.10 communication cycles, not 0"),
        ({"speed": 0.0}, "speed must be above 0 and finite, not 0"),
    ],
)
def test_a_wrong_value_names_the_valid_ones(options, message):
    with pytest.raises(ValueError, match=message):
        Tracking(1, **options)


def test_a_toml_file_configures(tmp_path):
    path = tmp_path / "tracking.toml"
    path.write_text('load = "gantry"\nmode = "csp"\nweights = { effort = 0.5 }\n')
    with tracking(config=path, rate=500) as lanes:
        assert (lanes.config.load, lanes.config.mode, lanes.config.rate) == ("gantry", "csp", 500)
        assert lanes.config.weights["effort"] == 0.5 and lanes.config.weights["tracking"] == 1.0


# --- one environment among many
# ----------------------------------------------------------------------------------------------
@pytest.mark.every(3)
@pytest.mark.parametrize("load", LOADS)
def test_a_lane_is_the_same_alone_and_among_others(load):
    axes = 2 if load == "gantry" else 1
    given = actions(120, 8, axes)
    options = {"load": load, "duration": 0.08, "distributions": load}  # autoreset is within
    with tracking(8, **options) as lanes:
        together = run(lanes, given, seed=range(8))
    for lane in (0, 5):
        with tracking(1, **options) as alone:
            single = run(alone, given[:, lane : lane + 1], seed=lane)
        for many, one in zip(together, single, strict=True):
            assert np.array_equal(many[:, lane], one[:, 0])


# --- ends -------------------------------------------------------------------------------------------------------------
def test_a_fallen_pole_ends_the_episode():
    with tracking(2, load="inverted_pendulum", duration=5.0, autoreset_mode="SameStep") as lanes:
        lanes.reset(seed=0)
        for _ in range(3000):
            _, _, terminated, _, info = lanes.step(np.zeros((2, 1), np.float32))
            if terminated.any():
                break
        assert terminated.all() and info["final_info"]["fault"].tolist() == ["fell", "fell"]
        angles = [row[8] for row in info["final_obs"]]
        assert np.all(np.abs(angles) > 0.6) and np.all(np.abs(angles) < 0.7)


# --- acting -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("rate", [500, 1000])
@pytest.mark.parametrize("delay", [1, 2, 3, 6])
def test_an_action_takes_effect_after_the_delay(delay, rate):
    """The current jumps at one SYNC; the first sample that can show it is one cycle later."""
    with tracking(delay=delay, rate=rate, trajectory="hold") as lanes:
        plays = []
        lanes.reset(seed=0)
        for k in range(12):
            lanes.step(np.full((1, 1), 0.5 if k >= 2 else 0.0, np.float32))
            plays.append(lanes._control.played[0, :, 0].copy())
    rows = np.concatenate(plays)
    given = 2 * lanes.config.cycles
    assert np.flatnonzero(rows)[0] == given + delay - 1 and set(rows) == {0, 3500}


@pytest.mark.parametrize("action", ["direct", "offset"])
@pytest.mark.parametrize("mode", OBJECTS)
def test_what_is_played(mode, action):
    target, offset = OBJECTS[mode]
    with tracking(mode=mode, action=action, trajectory="moves") as lanes:
        plays = []
        lanes.reset(seed=0)
        for _ in range(50):
            lanes.step(np.full((1, 1), 0.5, np.float32))
            plays.append(dict(zip(lanes._control.play, lanes._control.played.copy(), strict=True)))
        reference = lanes._episodes.reference[0]
    full = {"csp": 1.25 * 2 * 65536, "csv": 1.25 * 20 * 65536, "cst": 7000}[mode]
    if action == "direct":
        assert set(plays[0]) == {target} and plays[20][target].tolist() == [[round(0.5 * full)]]
        return
    assert list(plays[0]) == [target, offset] and plays[20][offset].tolist() == [[round(0.3 * 0.5 * full)]]
    profile = np.array([play[target][0, 0] for play in plays])
    if mode == "cst":
        motor = lanes.drives.motor
        scale = 1e3 * 3 * motor.inertia / motor.torque_constant * 2 * np.pi / 65536
        assert np.allclose(profile, np.clip(reference[2, :50] * scale, -7000, 7000), atol=0.51)
    else:
        assert np.allclose(profile, reference[0 if mode == "csp" else 1, :50], atol=0.51)


@pytest.mark.parametrize(("mode", "action"), [("csp", "offset"), ("csv", "offset"), ("csv", "direct")])
def test_a_controller_that_knows_the_reference_follows_it(mode, action):
    with tracking(4, mode=mode, action=action, trajectory="moves", speed=5.0, amplitude=1.0) as lanes:
        observation, _ = lanes.reset(seed=0)
        errors = []
        for _ in range(999):
            wanted = observation[:, 6:7] / 1.25 + 0.3 * observation[:, 0:1]
            observation, *_ = lanes.step(wanted if action == "direct" else np.zeros((4, 1), np.float32))
            errors.append(np.abs(observation[:, 0]))
        assert np.mean(errors) < (0.3 if mode == "csp" else 0.12)
        with_nothing = []
        lanes.reset(seed=0)
        if action == "direct":
            for _ in range(500):
                with_nothing.append(np.abs(lanes.step(np.zeros((4, 1), np.float32))[0][:, 0]))
            assert np.mean(with_nothing) > 2 * np.mean(errors)


BELT = 0.04  # m per turn of the motor


def pole_feedback(drives):
    """Return gains on place [m], speed [m/s], angle [rad] and rate [rad/s] of the pole's cart, for its speed [m/s].

    Those of a linear quadratic regulator. The pole from the numbers of its MJCF: l theta'' = g theta - v'; the cart as
    the velocity loop has it, T v' = u - v, T from the gains that the drive holds. Costs by Bryson's rule: 0.1 m, 1 m/s,
    0.05 rad, 0.5 rad/s and 0.5 m/s are equally bad.
    """
    model = mujoco.MjModel.from_xml_path(str(ALL_LOADS["inverted_pendulum"].mjcf))
    cart, bob = (model.body(name).id for name in ("cart", "bob"))
    mass, height = model.body_mass[bob], model.body_ipos[bob, 2]
    length = (model.body_inertia[bob, 1] + mass * height**2) / (mass * height)
    radius = BELT / (2.0 * np.pi)
    inertia = drives.motor.inertia + (model.body_mass[cart] + mass) * radius**2
    raw = Gains(*(int(drives.read(name)[0]) for name in GAIN_OBJECTS))
    T = 1.0 / (2.0 * np.pi * bandwidths_from_gains(drives.device, drives.motor, inertia, raw).velocity_hz)
    A = np.array([[0, 1, 0, 0], [0, -1 / T, 0, 0], [0, 0, 0, 1], [0, 1 / (T * length), 9.81 / length, 0]])
    B = np.array([[0.0], [1 / T], [0.0], [-1 / (T * length)]])
    Q, R = np.diag(np.array([0.1, 1.0, 0.05, 0.5]) ** -2.0), np.array([[0.5**-2.0]])
    K = np.linalg.solve(R, B.T @ solve_continuous_are(A, B, Q, R))[0]
    assert np.all(np.linalg.eigvals(A - B @ K[None]).real < -1.0)
    return K


@pytest.mark.every(3)
@pytest.mark.parametrize("options", [{}, {"rate": 500}, {"delay": 3}, {"distributions": "inverted_pendulum"}], ids=str)
def test_a_state_feedback_keeps_the_pole_up(options):
    """That the task can be done with what is observed, also on machines that the feedback was not made for."""
    with tracking(4, load="inverted_pendulum", duration=2.0, **options) as lanes:
        K = pole_feedback(lanes.drives)
        amplitude, speed = lanes.config.amplitude * BELT, lanes.config.speed * BELT
        observation, _ = lanes.reset(seed=0)
        for _ in range(lanes.config.steps - 1):
            state = observation[:, [2, 3, 8, 9]] * [amplitude, speed, 1.0, 1.0]
            action = np.clip(-state @ K / (1.25 * speed), -1, 1)[:, None].astype(np.float32)
            observation, _, terminated, *_ = lanes.step(action)
            assert not terminated.any()
        assert np.abs(observation[:, 8]).max() < 0.05
        assert np.abs(observation[:, 2] * amplitude).max() < 0.1


def test_bus_imperfections_are_drawn_and_late():
    laws = {
        "parameters": {
            "bus.action_latency": {"law": "choice", "values": [3]},
            "bus.observation_latency": {"law": "choice", "values": [2]},
            "bus.lost_sync": {"law": "choice", "values": [0.2]},
        }
    }
    with tracking(64, distributions=laws) as lanes:
        lanes.reset(seed=0)
        bus = lanes._bus
        assert set(bus.actions.latency) == {3} and set(bus.observations.latency) == {2}
        first = None
        for k in range(12):
            observation, *_ = lanes.step(np.ones((64, 1), np.float32))
            moving = np.abs(observation[:, 4]) > 0.2
            first = k if first is None and moving.any() else first
        assert first == 1 + 3 + 2
        for _ in range(200):
            lanes.step(np.ones((64, 1), np.float32))
        # A lost SYNC leaves the samples of the last one standing: they are a cycle older then.
        ages = 211 - bus.observations.held[:, -1]
        assert set(ages) >= {2.0, 3.0} and 0.05 < np.mean(ages > 2.0) < 0.5


# --- ramps, tilts, bobs -----------------------------------------------------------------------------------------------
def test_ramped_actions_add_up_to_the_target_within_the_full_scale():
    with tracking(load="inertia", mode="csv", action="ramp", ramp=10.0, speed=8.0) as lanes:
        lanes.reset(seed=0)
        full = 1.25 * lanes._episodes.scales[0, 1]
        for step, (given, sum_of_ramps) in enumerate(((0.5, 0.005), (1.0, 0.015), (-1.0, 0.005), (0.0, 0.005))):
            lanes.step(np.array([[given]], np.float32))
            sent = lanes._episodes.actions.held[0, 0]
            assert sent == pytest.approx(sum_of_ramps * full, abs=0.51), step
        for _ in range(150):
            lanes.step(np.array([[1.0]], np.float32))
        assert lanes._episodes.target[0] == full


def test_a_pole_begins_at_the_angle_that_is_drawn_and_falls_as_a_free_one_does():
    with tracking(16, load="inverted_pendulum", mode="cst", tilt=(-0.2, 0.2), duration=0.3) as lanes:
        first, _ = lanes.reset(seed=4)
        angles = first[:, 8].astype(float)
        assert np.abs(angles).max() <= 0.2 and np.ptp(angles) > 0.2 and not first[:, 9].any()
        for _ in range(50):
            seen, *_ = lanes.step(np.zeros((16, 1), np.float32))
        # The cart is held by its rotor: theta grows as cosh(sqrt(m g l / (m l^2 + I)) t).
        rate = np.sqrt(0.08 * 9.81 * 0.3 / (0.08 * 0.3**2 + 5e-5))
        wide = np.abs(angles) > 0.05
        assert np.allclose(seen[wide, 8] / angles[wide], np.cosh(rate * 0.050), rtol=0.05)


def test_the_carried_term_is_the_error_of_where_the_bob_is():
    with tracking(1, load="cart_pendulum", distributions="cart_pendulum", weights={"carried": 1.0}) as lanes:
        lanes.reset(seed=2)
        for _ in range(300):
            *_, info = lanes.step(np.array([[0.2]], np.float32))
        machine = lanes.drives.machine
        reference = lanes._episodes.reference[0, 0, 299]
        cart = lanes.drives.read((0x6064, 0))[0] - lanes._episodes.origin[0]
        lead = 0.04 / lanes._per_turn[0]  # m per increment
        bob = cart * lead + machine.parameters["load.length"][0] * np.sin(lanes._episodes.angles[0])
        error = (reference * lead - bob) / (lanes.config.amplitude * 0.04)
        assert info["reward_terms"]["carried"][0] == pytest.approx(1 / (1 + 9 * (error / 0.25) ** 2), rel=0.02)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"load": "inertia", "tilt": (0.1, 0.2)}, "tilt is of a pendulum, and load 'inertia' has none"),
        ({"load": "inverted_pendulum", "tilt": (0.2, 0.1)}, r"tilt is \[low, high\] within a turn, in order"),
        ({"load": "inverted_pendulum", "tilt": (0.0, 0.7)}, "must be beyond the greatest tilt, 0.7 rad"),
        ({"margins": {"traking": 1.0}}, "a margin's name is one of 'tracking', .* not 'traking'"),
        ({"margins": {"tracking": 0.0}}, "the margin of tracking must be above 0 and finite, not 0"),
        ({"action": "ramp", "ramp": 0.0}, "ramp must be above 0 and finite, not 0"),
    ],
)
def test_wrong_tilts_margins_and_ramps_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        TrackingConfig(**options)


def test_a_weight_that_makes_no_reward_is_refused():
    with pytest.raises(ValueError, match="weights must be a table of finite numbers"):
        Tracking(1, weights={"tracking": np.nan})


# --- trajectories -----------------------------------------------------------------------------------------------------
def test_every_joint_of_an_arm_follows_a_trajectory_of_its_own_that_meets_no_end_stop():
    with tracking(2, load="robot", mode="csp", amplitude=1000.0, speed=2000.0, duration=2.0) as lanes:
        lanes.reset(seed=0)
        way = lanes._episodes.reference[:, 0].reshape(2, 6, -1) / lanes._per_turn[0] * 2.0 * np.pi  # rad of the rotors
        load = ALL_LOADS["robot"]
        ends = np.array([min(-low, high) for low, high in load.travel]) * np.array(load.gears)
        assert np.all(np.abs(way).max(axis=2) <= 0.8 * ends + 1e-6)
        assert np.all(np.abs(way).max(axis=2) > 0.2 * ends)
        assert len(np.unique(np.round(way[0] / ends[:, None], 6), axis=0)) == 6


def test_a_run_goes_on_at_its_speed_from_the_first_moment():
    position, velocity, acceleration = draw("run", np.random.default_rng(0), 1500, 1e-3, 2.0, 10.0)
    assert np.allclose(position, 0.01 * np.arange(1500)) and np.all(velocity == 10.0) and not acceleration.any()


@pytest.mark.parametrize("kind", [kind for kind in TRAJECTORIES if kind != "run"])
def test_trajectories_keep_to_their_limits_and_are_smooth(kind):
    for seed in range(30):
        position, velocity, acceleration = draw(kind, np.random.default_rng(seed), 1500, 1e-3, 2.0, 10.0)
        assert np.abs(position).max() <= 2.0 and np.abs(velocity).max() <= 10.0 * (1 + 1e-9)
        assert position[0] == 0.0 and abs(velocity[0]) < 0.01
        assert np.allclose(np.gradient(position, 1e-3)[1:-1], velocity[1:-1], atol=0.2)
        assert np.allclose(np.cumsum(acceleration)[:-2] * 1e-3, velocity[1:-1], atol=1.0)
        assert kind == "hold" or np.ptp(position) > 0.05


# --- on a bus ---------------------------------------------------------------------------------------------------------
class Bare:
    """Emulated drives that show what a bus shows."""

    machine = None

    def __init__(self, drives):
        self._drives = drives

    def __getattr__(self, name):
        return getattr(self._drives, name)


@pytest.mark.parametrize(("load", "mode"), [("two_mass", "csp"), ("gantry", "csp"), ("two_mass", "cst")])
def test_on_a_bus_an_axis_left_in_haste_is_taken_back_at_once(load, mode):
    """The last leap of a target in csp is at 35 turns per ms: as the speed that pp begins with it would run away."""
    axes = 2 if load == "gantry" else 1
    with EmulatedDrives(load=load, num_threads=1) as drives:
        lanes = Tracking(1, drives=Bare(drives), load=load, mode=mode, duration=0.06, autoreset_mode="Disabled")
        went_back = []
        go_back = lanes._go_back
        lanes._go_back = lambda moving: went_back.append(drives.read(0x6064)) or go_back(moving)
        for seed in range(4):
            lanes.reset(seed=seed)
            assert np.abs(drives.read(0x6064)).max() < 0.02 * 65536 * lanes.config.amplitude
            drives.emergencies()
            for action in actions(60, 1, axes, seed):
                *_, terminated, _, _ = lanes.step(action)
                assert not terminated.any()
        assert drives.emergencies() == []
        assert len(went_back) == 4  # no second try
        lanes.close()


def test_on_a_bus_what_needs_a_machine_is_refused():
    with EmulatedDrives(load="cart_pendulum", num_threads=1) as emulated:
        drives = Bare(emulated)
        with pytest.raises(ValueError, match="give sensor="):
            Tracking(1, drives=drives, load="cart_pendulum")
        with pytest.raises(ValueError, match="distributions are of emulated machines"):
            Tracking(1, drives=drives, load="cart_pendulum", distributions="cart_pendulum", sensor=lambda: [0.0])
        lanes = Tracking(1, drives=drives, load="cart_pendulum", sensor=lambda: [0.25])
        assert lanes.reset(seed=0)[0][0, 8] == 0.25
        with pytest.raises(ValueError, match="1 axes cannot be shared by 2 environments"):
            Tracking(2, drives=drives)


# --- long and with others ---------------------------------------------------------------------------------------------
def test_a_configuration_takes_the_loads_own_task():
    assert TrackingConfig(load="cart_pendulum").mode == "csv"
    assert TrackingConfig(load="cart_pendulum", mode="cst").mode == "cst"
    assert TrackingConfig(load="fan").task.joint is None


# --- steppers ---------------------------------------------------------------------------------------------------------
STILL = {"inertia": 1, "belt": 1, "portal": 3}


@pytest.mark.every(6)
@pytest.mark.parametrize("load", STILL)
@pytest.mark.parametrize("device", ["tmcm6212", "tmcm3313"])
@pytest.mark.parametrize(("mode", "action"), [("csp", "offset"), ("csv", "offset"), ("csp", "direct")])
def test_steppers_follow_and_tell_their_load_by_the_deviation(device, load, mode, action):
    axes = STILL[load]
    options = {"device": device, "load": load, "mode": mode, "action": action, "duration": 0.2, "speed": 1.0}
    with tracking(2, **options) as lanes:
        assert lanes.config.motor == "qsh4218_51"
        assert lanes.single_action_space.shape == (axes,)
        seen, _ = lanes.reset(seed=2)
        for _ in range(200):
            seen, reward, terminated, _, info = lanes.step(np.zeros((2, axes), np.float32))
            if action == "offset":
                assert not terminated.any(), info
            if terminated.any():
                break
        assert np.isfinite(seen).all() and np.isfinite(reward).all()
        drives = lanes.drives
        assert (drives.read(0x606A) == 0).all()
        if action == "offset":
            lag = (drives.read(0x6062) - drives.read(0x6064)).reshape(2, axes) / 256.0  # full steps
            np.testing.assert_allclose(seen[:, 4 : 8 * axes : 8], lag, atol=0.02)  # the sample is a cycle old
            assert info["reward_terms"]["tracking"].min() > 0.9
            assert 0.0 < np.abs(lag).max() < 1.0


def test_a_stepper_that_loses_its_steps_ends_the_episode():
    with tracking(2, device="tmcm6212", load="inertia", action="offset", speed=1.0) as lanes:
        lanes.reset(seed=2)
        for k in range(200):
            if k == 20:
                lanes.drives.machine.load_torque = np.array([0.0, -2.0])
            _, _, terminated, _, info = lanes.step(np.zeros((2, 1), np.float32))
            if terminated.any():
                break
        assert terminated.tolist() == [False, True]
        assert info["fault"][1] == "following_error"


def test_steppers_that_lose_their_steps_one_after_the_other_each_tell_their_own_fault():
    """A drive's message may come a step before its statusword: another's end must not take it away."""
    run_up = {"mode": "csv", "action": "ramp", "ramp": 6.75, "trajectory": "run", "amplitude": 20.0, "speed": 16.0}
    found = []
    with tracking(64, device="tmcm6212", load="inertia", distributions="inertia", **run_up) as lanes:
        lanes.reset(seed=3)
        for _ in range(180):
            *_, info = lanes.step(np.full((64, 1), 0.9, np.float32))
            found += [info["fault"][lane] for lane in np.flatnonzero(info.get("_fault", []))]
    assert len(found) >= 20
    assert set(found) == {"following_error"}


def test_a_stepper_has_the_modes_and_speeds_that_suit_it():
    config = TrackingConfig(device="tmcm3313", load="two_mass")
    assert (config.mode, config.speed, config.motor) == ("csp", 5.0, "qsh4218_51")
    assert TrackingConfig(load="two_mass").motor == "qbl4208"


def test_the_pace_is_the_share_of_each_machine_s_own_highest_speed_squared():
    run_up = {"mode": "csv", "action": "ramp", "trajectory": "run", "amplitude": 20.0, "speed": 14.0}
    weights = dict.fromkeys(WEIGHTS, 0.0) | {"pace": 1.0}
    with tracking(
        4, device="tmcm6212", load="inertia", distributions="stepper_run", weights=weights, **run_up
    ) as lanes:
        _, info = lanes.reset(seed=5)
        device, motor = lanes.drives.device, lanes.drives.motor
        highest = highest_speeds(motor, amplitude(device, rated_setting(device, motor)), info["parameters"])
        for k in range(100):
            push = 0.1 if k else 0.0
            _, reward, _, _, info = lanes.step(np.full((4, 1), push, np.float32))
            speed = np.maximum(lanes._control.sampled[2, -1], 0) / 51_200.0  # 606Ch in the step's last cycle
            np.testing.assert_allclose(reward, (speed * 2.0 * np.pi / highest) ** 2, rtol=1e-9)
            np.testing.assert_array_equal(info["reward_terms"]["pace"], reward)
        assert np.ptp(highest) > 5.0 and np.all(reward > 0.0)
        for _ in range(120):
            _, reward, _, _, _ = lanes.step(np.full((4, 1), -0.2, np.float32))
        assert np.all(lanes.drives.read(0x606C) < 0) and np.all(reward == 0.0)


def test_the_pace_of_a_machine_without_a_highest_speed_is_the_share_of_the_configured_one():
    with tracking(1, load="inertia", mode="csv", speed=5.0, amplitude=5.0, weights={"pace": 1.0}) as lanes:
        lanes.reset(seed=0)
        for _ in range(300):
            seen, _, _, _, info = lanes.step(np.full((1, 1), 0.4, np.float32))
        assert seen[0, 3] == pytest.approx(0.5, abs=0.1)  # 0.4 of 1.25 times the speed
        assert info["reward_terms"]["pace"][0] == pytest.approx(seen[0, 3] ** 2, rel=0.05)
