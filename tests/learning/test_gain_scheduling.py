"""GainScheduling: gains on line, a changing payload, environments that do not depend on each other, and on a bus."""

import numpy as np
import pytest

from drive_env import EmulatedDrives
from drive_env.devices.gains import rule_gains
from drive_env.drives.raw_gains import read_gains
from drive_env.envs.gain_scheduling import GainScheduling, GainSchedulingConfig
from drive_env.envs.motion_programme import EXCITATIONS, Programme, Reach
from drive_env.envs.online_margins import OnlineMargins
from drive_env.loops.dynamics import find_dynamics, loop_clearance
from drive_env.loops.sampled import CascadeGains, LoopRates
from drive_env.loops.true_plant import true_machines

NOMINAL = {"parameters": {}}
ONE_PAYLOAD = {"load": "inertia", "distributions": NOMINAL, "payload": "none"}
POSITION_P, VELOCITY_P = (0x2043, 1), (0x2042, 1)


def env(lanes=1, **options):
    return GainScheduling(lanes, num_threads=1, **options)


def run(environment, steps, seed=0, reset_seed=3, scale=1.0):
    rng = np.random.default_rng(seed)
    rows = [environment.reset(seed=reset_seed)[0]]
    rewards = []
    for _ in range(steps):
        action = scale * rng.uniform(-1.0, 1.0, environment.single_action_space.shape)
        rows.append((found := environment.step(np.tile(action, (environment.num_envs, 1))))[0])
        rewards.append(found[1])
    return np.array(rows), np.array(rewards)


# --- the interface ----------------------------------------------------------------------------------------------------


# --- gains ------------------------------------------------------------------------------------------------------------
def test_an_action_is_the_logarithm_of_each_gain_over_its_base():
    environment = env(2, distributions=NOMINAL, span=0.5, gains=("position_p", "velocity_p"))
    environment.reset(seed=0)
    base = {name: environment.drives.read(name) for name in (POSITION_P, VELOCITY_P, (0x2042, 2))}
    environment.step(np.array([[1.0, 0.0], [-1.0, 0.4]], np.float32))
    gains = {name: environment.drives.read(name) for name in base}
    assert gains[POSITION_P].tolist() == np.rint(base[POSITION_P] * np.exp([0.5, -0.5])).tolist()
    assert gains[VELOCITY_P].tolist() == np.rint(base[VELOCITY_P] * np.exp([0.0, 0.2])).tolist()
    assert np.array_equal(gains[0x2042, 2], base[0x2042, 2])


def test_the_middle_is_the_rule_for_the_mean_of_the_lightest_and_the_heaviest_machine():
    environment = env(base="middle", load="inertia", payload_low=0.2, payload_high=20.0, distributions=NOMINAL)
    motor, load = environment.drives.motor, environment.drives.machine.parameters["load.inertia"][0]
    mean = np.sqrt((motor.inertia + 0.2 * load) * (motor.inertia + 20.0 * load))
    assert environment.base_gains[0].tolist() == rule_gains(environment.drives.device, motor, mean)[0].tolist()


def test_gains_for_another_payload_break_the_margins_and_earn_less_though_they_track_as_well():
    tracked = []
    for dynamics in ("soft", None):
        environment = env(1, dynamics=dynamics, span=2.0, **ONE_PAYLOAD)  # velocity P over what this payload takes
        environment.reset(seed=1)
        terms = [environment.step(np.array([[1.0, -1.0, 0.0]]))[4]["reward_terms"]["tracking"] for _ in range(50)]
        tracked.append(np.mean(terms))
        if dynamics is not None:
            shares = environment._margins.share(read_gains(environment.drives))
    assert shares[0] == 0.0 == tracked[0]
    assert tracked[1] > 0.2


@pytest.mark.parametrize("mode", ["csp", "csv"])
def test_the_kept_margins_are_those_of_the_exact_linear_model(mode):
    with EmulatedDrives("tmcm1636", "inertia", None, 64, num_threads=1) as drives:
        rng, every = np.random.default_rng(1), np.ones(64, bool)
        inertia = drives.machine.parameters["load.inertia"] * np.exp(rng.uniform(-1.6, 2.1, 64))
        drives.machine.set_all({"load.inertia": inertia}, every)
        raw = rule_gains(drives.device, drives.motor, inertia + drives.motor.inertia)
        raw[:, 2:] = np.rint(raw[:, 2:] * np.exp(rng.uniform(-1.5, 2.2, (64, 3))))
        if mode == "csv":
            raw[:, 4] = 1  # an open position loop, nearly
        margins = OnlineMargins(drives, find_dynamics("standard"), mode)
        margins.take_in(raw, every)
        exact, _ = loop_clearance(
            find_dynamics("standard"), LoopRates.of(drives.device), true_machines(drives),
            CascadeGains.of(drives.device, raw[:, None]),
        )  # fmt: skip
        assert np.any(exact > 1.0) and np.any(exact <= 0.0)
        assert margins.share(raw) == pytest.approx(np.clip(exact, 0.0, 1.0), abs=0.05)


def test_the_payload_is_observed_if_asked_for_and_the_margins_follow_it():
    options = {
        "load": "inertia",
        "distributions": NOMINAL,
        "payload_low": 0.1,
        "payload_high": 10.0,
        "payload_every": 0.1,
    }
    environment = env(8, payload_observed=True, dynamics="soft", duration=0.5, **options)
    seen, info = environment.reset(seed=2)
    assert seen[:, -1] == pytest.approx(0.0)  # the nominal one, in the middle of 1 : 100
    nominal, before = info["parameters"]["load.inertia"].copy(), environment._margins._plant.copy()
    for _ in range(30):
        seen, _, _, _, info = environment.step(np.zeros((8, 3)))
    factor = info["parameters"]["load.inertia"] / nominal
    assert seen[:, -1] == pytest.approx(np.log10(factor), abs=1e-5)
    assert np.all(np.abs(environment._margins._plant - before).max(axis=(1, 2, 3)) > 0.0)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"payload": "none", "payload_observed": True}, "the load has no payload that changes"),
        ({"dynamics": "brisk"}, "dynamics 'brisk': give soft, standard, stiff"),
        ({"device": "tmcm3313", "dynamics": "soft"}, "tmcm3313 names no cascade"),
    ],
)
def test_margins_and_payload_are_refused_where_there_are_none(options, says):
    with pytest.raises(ValueError, match=says):
        env(load="inertia", **options)


def test_present_gains_are_those_that_the_drives_hold():
    drives = EmulatedDrives(load="inertia", num_machines=2, num_threads=1)
    drives.write(POSITION_P, [77, 99])
    environment = GainScheduling(2, drives=drives, load="inertia", base="present", distributions=NOMINAL)
    environment.reset(seed=0)
    assert drives.read(POSITION_P).tolist() == [77, 99]


def test_a_stiffer_position_loop_lags_less_and_is_rewarded():
    results = []
    for action in (-1.0, 0.0):
        environment = env(4, load="inertia", distributions=NOMINAL, gains=("position_p",), payload="none")
        environment.reset(seed=1)
        terms = [environment.step(np.full((4, 1), action))[4]["reward_terms"]["tracking"] for _ in range(100)]
        results.append(np.mean(terms))
    assert results[0] < 0.7 * results[1]


# --- the programme and the payload ------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("excitation", EXCITATIONS)
def test_a_programme_stays_within_its_reach_and_is_smooth(excitation):
    reach = Reach(np.array([10.0, 4.0]), np.array([50.0, 50.0]), np.array([900.0, 900.0]))
    programme = Programme(20, 3000, 0, 0.001)
    programme.draw(excitation, reach, [np.random.default_rng(k) for k in range(20)], np.ones(20, bool))
    position, velocity, acceleration = programme.rows(np.zeros(20, int), np.arange(3001), reach)
    assert np.all(np.abs(position).reshape(3001, 20, 2) <= reach.distance + 1e-9)
    assert np.abs(velocity).max() <= 50.0 + 1e-9
    assert np.abs(acceleration).max() <= 900.0 * 1.01
    assert np.abs(velocity).max() > 20.0
    assert np.all(position[0] == 0.0)
    assert np.all(velocity[0] == 0.0)
    assert np.gradient(position, 0.001, axis=0)[1:-1] == pytest.approx(velocity[1:-1], abs=0.05)
    steady = np.abs(np.diff(acceleration, axis=0)).max(axis=1) < 50.0  # a sine begins with its acceleration
    rate = np.gradient(velocity, 0.001, axis=0)[1:-1]
    assert rate[steady[1:]] == pytest.approx(acceleration[1:-1][steady[1:]], abs=30.0)


def test_the_payload_changes_when_and_as_drawn():
    environment = env(3, distributions=NOMINAL, payload_low=0.5, payload_high=3.0, payload_every=0.5)
    _, info = environment.reset(seed=4)
    masses = [info["parameters"]["load.mass"]]
    for _ in range(200):
        info = environment.step(np.zeros((3, 3)))[4]
        masses.append(info["parameters"]["load.mass"])
        assert np.array_equal(masses[-1], environment.drives.machine.parameters["load.mass"])
    factors = np.array(masses) / masses[0]
    assert np.all(factors[0] == 1.0)
    assert np.all((factors[1:] >= 0.5) & (factors[1:] <= 3.0))
    assert [np.count_nonzero(np.diff(lane)) for lane in factors.T] == [4, 4, 4]


def test_a_payload_that_cannot_be_keeps_the_last_one():
    environment = env(2, load="two_mass", distributions=NOMINAL, payload_low=1e-6, payload_high=1e-6)
    _, info = environment.reset(seed=4)
    before = info["parameters"]["load.inertia"]
    for _ in range(200):
        info = environment.step(np.zeros((2, 3)))[4]
    assert np.array_equal(info["parameters"]["load.inertia"], before)


def test_a_heavier_payload_needs_more_current():
    currents = []
    for factor in (0.3, 4.0):
        environment = env(
            1, load="inertia", mode="csv", distributions=NOMINAL, payload_low=factor, payload_high=factor,
            payload_every=0.01, excitation="sine",
        )  # fmt: skip
        environment.reset(seed=2)
        environment._payload_changes.at[:] = 0
        reach = [np.ptp([environment.step(np.zeros((1, 3)))[0][0, 8] for _ in range(100)])]
        currents.append(reach[0] / environment.reach.acceleration[0])
    assert currents[1] > 3.0 * currents[0]


def test_latency_delays_gains_and_measurements():
    """Three cycles late: of a step of 10 ms the new gains act in the last seven."""
    slow = {"parameters": {"bus.action_latency": {"law": "choice", "values": [3]}}}
    environment = env(1, distributions=slow)
    environment.reset(seed=0)
    played = []
    record = environment.drives.record
    environment.drives.record = lambda objects, duration, play: (
        played.extend(play[POSITION_P][:, 0].tolist()), record(objects, duration, play=play))[1]  # fmt: skip
    environment.step(np.full((1, 3), 0.5))
    before = int(environment.base_gains[0, 4])
    assert [value != before for value in played] == [False] * 3 + [True] * 7
    assert environment.drives.read(POSITION_P).tolist() == played[-1:]


# --- configuration ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mode": "pp"}, "mode is one of 'csp', 'csv', not 'pp'"),
        ({"excitation": "step"}, "excitation is one of 'moves', 'sine', not 'step'"),
        ({"base": "best"}, "base is one of 'rule', 'middle', 'present', not 'best'"),
        ({"gains": ("torque_p",)}, "a gain is one of 'velocity_p', 'velocity_i', 'position_p', not 'torque_p'"),
        ({"gains": ()}, "gains must be different ones of velocity_p"),
        ({"payload": "load.weight"}, "payload is one of 'auto', 'none', 'load.mass', .*not 'load.weight'"),
        ({"payload_low": 3.0, "payload_high": 1.0}, "in order, not 3 and 1"),
        ({"step": 0.003}, r"step must be 0\.005\.\.\.0\.02 s in whole milliseconds, not 0\.003 s"),
        ({"step": 0.0105}, "whole milliseconds"),
        ({"weights": {"effort": 1.0}}, "a weight's name is one of 'tracking', 'smoothness', 'trip', not 'effort'"),
        ({"duration": 0.001}, "at least one step"),
    ],
)
def test_a_wrong_value_names_the_valid_ones(options, message):
    with pytest.raises(ValueError, match=message):
        env(1, **options)


def test_a_file_configures(tmp_path):
    path = tmp_path / "scheduling.toml"
    path.write_text('load = "arm"\nmode = "csv"\ngains = ["velocity_p"]\n[weights]\ntrip = 5\n', encoding="utf-8")
    config = GainScheduling(1, config=path, num_threads=1).config
    assert (config.load, config.mode, config.gains) == ("arm", "csv", ("velocity_p",))
    assert config.weights == {"tracking": 1.0, "smoothness": 0.3, "trip": 5}
    assert isinstance(config, GainSchedulingConfig)


def test_drives_that_do_not_fit_are_refused():
    drives = EmulatedDrives(load="gantry", num_machines=2, num_threads=1)
    with pytest.raises(ValueError, match="3 environments of load 'gantry' with 2 axes each need 6 drives, not 4"):
        GainScheduling(3, drives=drives, load="gantry")


def test_who_looks_changes_nothing():
    """A picture looks at every cycle of a step; what the agent sees is the same."""

    class Look:
        looks = 0
        is_looking = True

        def begin(self, lanes):
            self.looks = 0

        def look(self):
            self.looks += 1

        def close(self):
            pass

    watched = env(2)
    watched._pictures = Look()
    assert np.array_equal(run(watched, 20)[0], run(env(2), 20)[0])
    assert watched._pictures.looks == 20 * 10
