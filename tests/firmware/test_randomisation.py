"""Domain randomisation: laws as data, machines drawn by environment, and what a bus does to messages on their way."""

import numpy as np
import pytest

from drive_env import EmulatedDrives
from drive_env.envs.bus_delays import BusDelays
from drive_env.randomisation.random_machines import BESIDE, Distributions, Law, RandomMachines, shipped
from mechanics.loads import LOADS

DEFAULTS = {"load.inertia": 1e-5, "load.coulomb": 2e-3, "motor.R_s": 0.4, "stage.adc_offset_a": 0.02}


def generators(count, first=0):
    return [np.random.default_rng(first + k) for k in range(count)]


def defaults_of(load):
    parameters = EmulatedDrives(load=load, num_threads=1).machine.parameters
    return {name: float(values[0]) for name, values in parameters.items()}


def drawn_values(law, defaults=DEFAULTS, count=2000, stage=1.0, name="load.inertia", **table):
    laws = Distributions.load({"parameters": {name: law}, **table})
    return np.array([laws.draw(rng, defaults, stage)[name] for rng in generators(count)])


# --- laws -------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("law", "low", "high", "middle"),
    [
        ({"law": "uniform", "low": 2.0, "high": 4.0}, 2.0, 4.0, 3.0),
        ({"law": "uniform", "low": 0.5, "high": 1.5, "of": "default"}, 0.5e-5, 1.5e-5, 1e-5),
        ({"law": "loguniform", "low": 0.1, "high": 10.0, "of": "default"}, 1e-6, 1e-4, 1e-5),
        ({"law": "normal", "mean": 3.0, "deviation": 1.0, "low": 2.0, "high": 5.0}, 2.0, 5.0, 3.17),
    ],
)
def test_a_law_fills_its_range_and_no_more(law, low, high, middle):
    values = drawn_values(law)
    assert values.min() >= low * (1 - 1e-12)
    assert values.max() <= high * (1 + 1e-12)
    assert values.min() < low + 0.02 * (high - low)
    assert np.median(values) == pytest.approx(middle, rel=0.1)


def test_a_normal_law_has_its_mean_and_deviation():
    values = drawn_values({"law": "normal", "mean": 10.0, "deviation": 2.0})
    assert values.mean() == pytest.approx(10.0, abs=0.15)
    assert values.std() == pytest.approx(2.0, rel=0.05)


def test_a_choice_keeps_to_its_weights():
    values = drawn_values({"law": "choice", "values": [1, 5], "weights": [3, 1]})
    assert set(values) == {1.0, 5.0}
    assert np.mean(values == 5.0) == pytest.approx(0.25, abs=0.03)


def test_the_same_generator_draws_the_same_machine():
    laws = Distributions.load("two_mass")
    defaults = defaults_of("two_mass")
    first, second, other = (laws.draw(np.random.default_rng(seed), defaults) for seed in (3, 3, 4))
    assert first == second
    assert all(first[name] != other[name] for name in ("load.inertia", "motor.R_s", "stage.velocity_filter"))


def test_one_more_law_changes_no_other_parameter_and_nothing_that_is_drawn_later():
    small = {"load.inertia": {"law": "uniform", "low": 1, "high": 2}}
    large = {"motor.R_s": {"law": "normal", "mean": 1, "deviation": 1}, **small}
    results = []
    for laws in (small, large):
        rng = np.random.default_rng(5)
        drawn = Distributions.load({"parameters": laws}).draw(rng, DEFAULTS)
        results.append((drawn["load.inertia"], rng.random()))
    assert results[0] == results[1]


def test_parameters_are_drawn_independently():
    laws = Distributions.load({"parameters": {name: {"law": "uniform", "low": 0, "high": 1} for name in DEFAULTS}})
    rows = np.array([list(laws.draw(rng, DEFAULTS).values()) for rng in generators(2000)])
    off_diagonal = np.corrcoef(rows, rowvar=False) - np.eye(len(DEFAULTS))
    assert np.abs(off_diagonal).max() < 0.08


# --- curriculum -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("law", [
    {"law": "uniform", "low": 0.5, "high": 3.0, "of": "default"},
    {"law": "loguniform", "low": 0.2, "high": 5.0, "of": "default"},
    {"law": "normal", "mean": 1.2, "deviation": 0.3, "of": "default"},
    {"law": "choice", "values": [0.5, 4.0], "of": "default"},
])  # fmt: skip
def test_a_curriculum_widens_from_the_default_machine(law):
    assert np.all(drawn_values(law, stage=0.0, count=50) == 1e-5)
    half, whole = (drawn_values(law, stage=stage, count=500) for stage in (0.5, 1.0))
    assert 0.0 < np.abs(half - 1e-5).mean() < 0.8 * np.abs(whole - 1e-5).mean()


def test_a_group_opens_in_its_part_of_the_curriculum():
    law = {"law": "uniform", "low": 0.5, "high": 1.5, "of": "default"}
    opens = {"curriculum": {"opens": {"load": [0.5, 1.0]}}}
    assert np.all(drawn_values(law, stage=0.5, count=20, **opens) == 1e-5)
    assert np.ptp(drawn_values(law, stage=0.75, count=500, **opens)) == pytest.approx(0.5e-5, rel=0.05)
    assert np.all(drawn_values(law, name="load.coulomb", stage=0.25, count=20, **opens) == 2e-3)


def test_the_stage_follows_the_training_steps():
    curriculum = Distributions.load({"curriculum": {"steps": [0, 1000, 3000], "stage": [0.2, 0.6, 1.0]}}).curriculum
    assert [curriculum.stage_at(steps) for steps in (0, 500, 2000, 9000)] == pytest.approx([0.2, 0.4, 0.8, 1.0])


# --- the shipped sets -------------------------------------------------------------------------------------------------
def test_every_load_has_a_set():
    assert set(LOADS) < set(shipped())


@pytest.mark.parametrize("load", sorted(LOADS))
def test_a_load_s_set_varies_all_that_a_real_machine_varies_in(load):
    laws = Distributions.load(load).laws
    wanted = {
        "motor.R_s", "motor.psi_m", "motor.inertia", "motor.coulomb",  # motor, friction
        "motor.encoder_line_error", "stage.adc_noise", "stage.velocity_filter",  # sensors
        "supply.voltage", "start.winding",  # supply, temperature
        "bus.action_latency", "bus.observation_latency", "bus.jitter", "bus.lost_sync",  # delay
    }  # fmt: skip
    backlash = {name for name in ("load.backlash",) if name in defaults_of(load)}
    assert wanted | backlash <= set(laws)


@pytest.mark.every(4)
@pytest.mark.parametrize("load", sorted(LOADS))
def test_a_load_s_set_draws_machines_within_the_row_that_can_run(load):
    drives = EmulatedDrives(load=load, num_machines=8, num_threads=1)
    defaults = drives.machine.parameters
    laws = Distributions.load(load)
    assert {f"load.{p.name}" for p in LOADS[load].parameters} <= set(laws.laws)
    machines = RandomMachines(drives, laws)
    machines.redraw(generators(8))
    for p in LOADS[load].parameters:
        name = f"load.{p.name}"
        factor = drives.machine.parameters[name] / np.where(defaults[name] == 0.0, 1.0, defaults[name])
        assert np.all((factor >= p.low * (1 - 1e-9)) & (factor <= p.high * (1 + 1e-9))), name
    drives.advance(0.01)
    assert not drives.machine.diverged.any()


# --- machines ---------------------------------------------------------------------------------------------------------
def test_a_lane_s_machine_follows_from_its_generator_alone():
    one = EmulatedDrives(load="two_mass", num_machines=1, num_threads=1)
    many = EmulatedDrives(load="two_mass", num_machines=5, seed=9, num_threads=1)
    traces = []
    for drives, lane in ((one, 0), (many, 3)):
        machines = RandomMachines(drives, Distributions.load("two_mass"))
        machines.redraw(generators(drives.num_machines, 7 - lane))
        if drives is many:
            drives.advance(0.02)
            rngs = generators(5, 100)
            rngs[3] = np.random.default_rng(7)
            machines.redraw(rngs, np.arange(5) == 3)
        drives.write(0x6060, 9, where=np.arange(drives.num_axes) == lane)
        for word in (6, 7, 15):
            drives.write(0x6040, word)
        trace = drives.record([0x606C, 0x6077], 0.1, play={0x60FF: np.full(100, 500_000)})
        traces.append((trace[0x606C][:, lane], trace[0x6077][:, lane]))
    assert np.array_equal(traces[0], traces[1])
    assert np.abs(traces[0][0]).max() > 100_000


def test_a_redraw_touches_no_other_machine():
    drives = EmulatedDrives(load="two_mass", num_machines=4, num_threads=1)
    machines = RandomMachines(drives, Distributions.load("two_mass"))
    machines.redraw(generators(4))
    before = drives.machine.parameters | {"supply": drives.machine.supply, "warm": drives.machine.temperatures[0]}
    machines.redraw(generators(4, 50), np.array([False, True, False, False]))
    after = drives.machine.parameters | {"supply": drives.machine.supply, "warm": drives.machine.temperatures[0]}
    others = [0, 2, 3]
    assert all(np.array_equal(before[name][others], after[name][others]) for name in before)
    assert before["load.inertia"][1] != after["load.inertia"][1]
    assert before["supply"][1] != after["supply"][1]
    assert before["warm"][1] != after["warm"][1]


def test_values_are_what_the_machine_has():
    drives = EmulatedDrives(load="gantry", num_machines=3, num_threads=1)
    machines = RandomMachines(drives, Distributions.load("gantry"))
    machines.redraw(generators(3))
    for name, values in drives.machine.parameters.items():
        assert np.array_equal(machines.values[name], values), name
    assert np.array_equal(drives.machine.supply, np.repeat(machines.values["supply.voltage"], 2))
    winding, stage = drives.machine.temperatures
    assert np.array_equal(winding, np.repeat(machines.values["start.winding"], 2))
    assert np.array_equal(stage, np.repeat(machines.values["start.stage"], 2))


def test_a_machine_that_cannot_be_stepped_is_drawn_again():
    laws = {"parameters": {"load.stiffness": {"law": "choice", "values": [1.0, 1e6], "of": "default"}}}
    drives = EmulatedDrives(load="two_mass", num_machines=6, num_threads=1)
    default = drives.machine.parameters["load.stiffness"][0]
    machines = RandomMachines(drives, Distributions.load(laws))
    machines.redraw(generators(6))
    assert np.all(machines.values["load.stiffness"] == default)
    laws["parameters"]["load.stiffness"]["values"] = [1e6]
    with pytest.raises(ValueError, match=r"20 draws gave .*resonates at.*narrow the distributions"):
        RandomMachines(drives, Distributions.load(laws)).redraw(generators(6))
    assert np.all(drives.machine.parameters["load.stiffness"] == default)


def test_set_all_asks_for_the_machine_that_results():
    """A stiff shaft needs a heavy load: one after the other the first is refused, together they are one machine."""
    drives = EmulatedDrives(load="two_mass", num_machines=2, num_threads=1)
    machine = drives.machine
    stiff = {"load.stiffness": machine.parameters["load.stiffness"] * 30.0}
    heavy = {"load.inertia": machine.parameters["load.inertia"] * 200.0, "motor.inertia": np.full(2, 1e-3)}
    before = machine.parameters
    with pytest.raises(ValueError, match="resonates at"):
        machine.set_all(stiff | {"motor.R_s": np.full(2, 0.1)})
    assert all(np.array_equal(values, before[name]) for name, values in machine.parameters.items())
    machine.set_all(stiff | heavy, np.array([False, True]))
    assert machine.parameters["load.stiffness"][1] == 30.0 * machine.parameters["load.stiffness"][0]


def test_set_all_is_set_one_by_one():
    traces = []
    values = {
        "load.inertia": 2e-5,
        "motor.R_s": 0.3,
        "motor.coulomb": 3e-3,
        "motor.inertia": 6e-6,
        "load.damping": 2e-4,
    }
    for together in (True, False):
        drives = EmulatedDrives(load="two_mass", num_machines=3, num_threads=1)
        mask = np.array([True, False, True])
        if together:
            drives.machine.set_all(values, mask)
        else:
            for name, value in values.items():
                drives.machine.set(name, value, mask)
        drives.write(0x6060, 10)
        for word in (6, 7, 15):
            drives.write(0x6040, word)
        traces.append(drives.record([0x6064, 0x6077], 0.05, play={0x6071: np.full(50, 1500)}))
    for name in (0x6064, 0x6077):
        assert np.array_equal(traces[0][name], traces[1][name])


# --- the bus ----------------------------------------------------------------------------------------------------------
def bus_of(lanes, action=0, observation=0, jitter=0, lost=0.0, seeds=None):
    bus = BusDelays(lanes)
    values = {"bus.action_latency": action, "bus.observation_latency": observation, "bus.jitter": jitter,
              "bus.lost_sync": lost}  # fmt: skip
    rows = {name: np.broadcast_to(np.asarray(value, float), (lanes,)) for name, value in values.items()}
    rngs = generators(lanes) if seeds is None else [np.random.default_rng(seed) for seed in seeds]
    bus.reset(rows, rngs, np.full((lanes, 1), -1), np.full((lanes, 1), -2))
    return bus


def sent(line, lanes, cycles=40):
    return line(np.broadcast_to(np.arange(cycles)[:, None, None], (cycles, lanes, 1)))[:, :, 0]


@pytest.mark.parametrize("latency", [0, 1, 3])
def test_latency_is_whole_cycles(latency):
    bus = bus_of(1, action=latency, observation=latency)
    assert sent(bus.act, 1, 8)[:, 0].tolist() == [-1] * latency + list(range(8 - latency))
    assert sent(bus.observe, 1, 8)[:, 0].tolist() == [-2] * latency + list(range(8 - latency))


def test_every_lane_has_its_own_latency():
    arrived = sent(bus_of(3, action=[0, 2, 1]).act, 3, 6)
    assert arrived[-1].tolist() == [5, 3, 4]


def test_jitter_delays_by_up_to_its_cycles_and_messages_never_overtake():
    arrived = sent(bus_of(4, action=1, jitter=2).act, 4, 400)[10:]
    late = np.arange(10, 400)[:, None] - arrived
    assert set(np.unique(late)) == {1, 2, 3}
    assert np.all(np.diff(arrived, axis=0) >= 0)
    # One cycle late: this one took 1 of 1, 2, 3 cycles, and the one before it not 3: it would have blocked the way.
    assert np.mean(late == 1) == pytest.approx(1 / 3 * 2 / 3, abs=0.04)


def test_without_sync_the_last_action_goes_on_and_the_last_measurement_stands():
    bus = bus_of(2, lost=[0.3, 0.0])
    acted, seen = sent(bus.act, 2, 1000), sent(bus.observe, 2, 1000)
    assert np.array_equal(acted[:, 1], np.arange(1000))
    repeated = np.diff(acted[:, 0]) == 0
    assert repeated.mean() == pytest.approx(0.3, abs=0.05)
    assert np.array_equal(repeated, np.diff(seen[:, 0]) == 0)  # the same SYNC latches and samples
    fresh = np.flatnonzero(~repeated) + 1
    assert np.array_equal(acted[fresh, 0], fresh)  # after a lost SYNC the newest counts


def test_what_needs_no_sync_is_not_held_up_by_a_lost_one():
    assert sent(bus_of(1, lost=1.0).act_unlatched, 1, 5)[:, 0].tolist() == [0, 1, 2, 3, 4]
    assert sent(bus_of(1, lost=1.0).act, 1, 5)[:, 0].tolist() == [-1] * 5


def test_a_lane_s_bus_follows_from_its_generator_alone():
    alone = sent(bus_of(1, action=1, jitter=2, lost=0.1, seeds=[7]).act, 1, 200)
    among = sent(bus_of(3, action=[3, 1, 0], jitter=2, lost=0.1, seeds=[1, 7, 2]).act, 3, 200)
    assert np.array_equal(alone[:, 0], among[:, 1])


def test_a_bus_without_faults_hands_on_what_it_is_given():
    bus = bus_of(2)
    message = np.ones((1, 2, 1))
    assert not bus.is_there
    assert bus.act(message) is message


# --- mistakes ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("three_masses", r"no set .* 'three_masses'; there are arm, .*two_mass"),
        ("nowhere.toml", r"no file nowhere\.toml"),
        ({"parameter": {}}, r"key 'parameter' is unknown; there are include, parameters, curriculum"),
        ({"include": ["belts"]}, r"no set is named 'belts'; there are arm"),
        ({"parameters": {"load.mass": {"law": "gauss"}}}, r"law = 'gauss' is unknown; there are uniform, loguniform"),
        ({"parameters": {"load.mass": {"law": "uniform", "low": 1}}}, r"law = 'uniform' needs 'high'"),
        ({"parameters": {"load.mass": {"law": "uniform", "low": 2, "high": 1}}}, r"low 2 is above high 1"),
        ({"parameters": {"load.mass": {"law": "uniform", "low": 1, "top": 2}}}, r"key 'top' is unknown; there are low"),
        ({"parameters": {"load.mass": {"law": "loguniform", "low": 0, "high": 1}}}, r"needs a low above 0, not 0"),
        ({"parameters": {"load.mass": {"law": "uniform", "low": "a", "high": 1}}}, r"low must be a finite number"),
        ({"parameters": {"load.mass": {"law": "choice", "values": []}}}, r"at least one value"),
        ({"parameters": {"load.mass": {"law": "choice", "values": [1], "weights": [1, 2]}}}, r"weights must be 1"),
        (
            {"parameters": {"bus.delay": {"law": "uniform", "low": 0, "high": 1}}},
            r"a bus has no 'bus.delay'; it has bus",
        ),
        ({"curriculum": {"steps": [0, 0], "stage": [0, 1]}}, r"steps must increase"),
        ({"curriculum": {"steps": [0, 1], "stage": [0, 2]}}, r"stage must lie in 0\.\.\.1"),
        ({"curriculum": {"opens": {"bus": [0.5, 0.2]}}}, r"must be \[from, to\]"),
    ],
)
def test_a_mistake_is_told_with_its_remedy(source, message):
    with pytest.raises(ValueError, match=message):
        Distributions.load(source)


def test_a_parameter_that_the_machine_does_not_have_is_named():
    drives = EmulatedDrives(load="inertia", num_threads=1)
    with pytest.raises(ValueError, match=r"load.stiffness: 'inertia' has no such parameter; it has motor.R_s, "):
        RandomMachines(drives, Distributions.load("two_mass"))
    with pytest.raises(ValueError, match=r"stage of the curriculum must lie in 0\.\.\.1, not 2"):
        Distributions.load("inertia").draw(np.random.default_rng(0), DEFAULTS, stage=2.0)


def test_delays_deeper_than_the_line_are_refused():
    with pytest.raises(ValueError, match=r"0\.\.\.8 communication cycles here, not 10"):
        bus_of(1, action=8, jitter=2)


# --- files ------------------------------------------------------------------------------------------------------------
def test_a_set_survives_its_file(tmp_path):
    laws = Distributions.load("winder")
    path = tmp_path / "mine.toml"
    path.write_text(laws.to_toml(), encoding="utf-8")
    again = Distributions.load(path)
    assert again.laws == laws.laws
    assert again.curriculum == laws.curriculum


def test_a_set_includes_another_and_changes_it():
    laws = Distributions.load({
        "include": "two_mass",
        "parameters": {"load.inertia": {"law": "uniform", "low": 1, "high": 2}, "bus.jitter": False},
    }).laws  # fmt: skip
    assert laws["load.inertia"] == Law("uniform", low=1.0, high=2.0)
    assert "bus.jitter" not in laws
    assert "motor.R_s" in laws


def test_what_is_drawn_beside_is_left_out_where_it_has_no_default():
    drawn = Distributions.load("inertia").draw(np.random.default_rng(0), defaults_of("inertia"))
    assert not set(drawn) & set(BESIDE)
