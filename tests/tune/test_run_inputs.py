"""Files of one's own in a run: kept by content, known by hash, sent with the work, and never taken for one another."""

from __future__ import annotations

import csv
import json
import os
import pickle
import re
import shutil
import subprocess
import sys
import tomllib
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from rigs import ROOT, TESTS
from rigs.commands import drive_tune
from rigs.shards import FILES, GRID, PATIENCE, contents
from rigs.trainings import tiny

from agents.evaluation.evaluation import evaluate
from agents.evaluation.evaluation_shards import Written, evaluate_elsewhere
from agents.evaluation.open_policy import open_policy
from agents.policies.agent_file import AgentFile
from agents.policies.policy import policy_of
from agents.training.train import run_to_resume, train
from drive_env import motors
from drive_env.devices import find_device
from drive_env.motors import find_motor
from mechanics.loads import MODELS, find_load
from tuning.compare.comparison import compare
from tuning.compare.suite import load_suite, suite_input
from tuning.runs import inputs, sweep
from tuning.runs.experiment import ExperimentError, load_experiment
from tuning.runs.inputs import Input, InputError, found_again, hashes, taken, write_inputs
from tuning.runs.pools import open_pool
from tuning.runs.sweep_files import save_sweep
from tuning.runs.unfinished import shard_log
from tuning.search import searches
from tuning.search.optimise import Settings

pytestmark = pytest.mark.usefixtures("files_read_here")
MOTOR = (motors.FOLDER / "qbl4208.toml").read_text(encoding="utf-8")
RESISTANCE = re.compile(r"(resistance_\w+ = \[)([0-9.]+)")
INVENTED = TESTS / "invented_drive"
SMALL = GRID.replace("count = 48", "count = 3")


def resistance(text, factor):
    """Return a motor's file with another resistance."""
    return RESISTANCE.sub(lambda found: f"{found[1]}{factor * float(found[2]):g}", text)


def write_own(folder, factor=1.0, mass=0.1):
    """Write a motor, a load that includes a file and has a mesh, a device, a variant, distributions and a suite."""
    (folder / "arm" / "parts").mkdir(parents=True)
    (folder / "arm" / "meshes").mkdir()
    (folder / "mine.toml").write_text(resistance(MOTOR, factor), encoding="utf-8")
    body = (MODELS / "inertia.xml").read_text(encoding="utf-8").replace('mass="0.1"', f'mass="{mass}"')
    bodies = body[body.index("<body") : body.index("</worldbody>")]
    disc = '<geom type="mesh" mesh="disc" contype="0" conaffinity="0" mass="0"/></body>'
    (folder / "arm" / "parts" / "body.xml").write_text(f"<mujoco>{bodies.replace('</body>', disc)}</mujoco>")
    (folder / "arm" / "arm.xml").write_text(
        '<mujoco model="arm"><compiler meshdir="meshes"/><asset><mesh name="disc" file="disc.obj"/></asset>'
        '<worldbody><include file="parts/body.xml"/></worldbody></mujoco>'
    )
    corners = [(0, 0, 0), (0.01, 0, 0), (0, 0.01, 0), (0, 0, 0.01)]
    faces = ["1 3 2", "1 2 4", "1 4 3", "2 3 4"]
    (folder / "arm" / "meshes" / "disc.obj").write_text(
        "".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "".join(f"f {face}\n" for face in faces)
    )
    shutil.copytree(INVENTED, folder / "invented")
    (folder / "smaller.toml").write_text('variant_of = "tmcm1636"\n[current]\nnominal = 5.0\n')
    spread = '"motor.R_s" = { law = "uniform", low = 0.9, high = 1.1, of = "default" }'
    (folder / "spread.toml").write_text(f"[parameters]\n{spread}\n")
    (folder / "machines.toml").write_text(
        'device = "tmcm1636"\n[[group]]\nload = "arm/arm.xml"\nmotor = "mine.toml"\nsupply = [24]\n[group.parameters]\n'
    )
    return folder


@pytest.fixture
def own(tmp_path, monkeypatch):
    """The present folder, with files of one's own."""
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return write_own(folder)


@pytest.fixture
def decoys(tmp_path):
    """A folder with other files of the same names, under `inputs/` too."""
    folder = tmp_path / "elsewhere"
    for place in (folder, folder / "inputs" / "motor", folder / "inputs" / "load"):
        place.mkdir(parents=True, exist_ok=True)
        write_own(place, factor=3.0, mass=0.5)
    return folder


def edit(path):
    """Change a file so that it still is one of its kind."""
    text = path.read_text(encoding="utf-8")
    changed = resistance(text, 2.0)
    if path.name == "body.xml":
        changed = text.replace('mass="0.1"', 'mass="0.2"')
    elif path.name == "disc.obj":
        changed = text.replace("0.01", "0.02")
    elif path.suffix == ".xml":
        changed = text + "\n"
    elif changed == text:
        changed = text + "\n# edited\n" * (path.suffix == ".toml") + "\n"
    assert changed != text
    path.write_text(changed, encoding="utf-8")


# --- what is kept -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("what", "name", "files"), [
    ("motor", "mine.toml", ["mine.toml"]),
    ("load", "arm/arm.xml", ["arm.xml", "meshes/disc.obj", "parts/body.xml"]),
    ("device", "smaller.toml", ["smaller.toml"]),
    ("device", "invented", [f"invented/{name}" for name in (
        "bindings.toml", "device.toml", "gains.toml", "invented.eds", "presets/qbl4208.toml", "roles.toml")]),
    ("distributions", "spread.toml", ["spread.toml"]),
    ("suite", "machines.toml", ["arm/arm.xml", "arm/meshes/disc.obj", "arm/parts/body.xml", "machines.toml",
                                "mine.toml"]),
])  # fmt: skip
def test_an_input_is_all_that_is_read_of_it_and_its_hash_shows_a_change_of_any(own, what, name, files):
    take = suite_input if what == "suite" else partial(taken, what)
    found = take(name)
    assert sorted(found.files) == files
    assert Path(found).exists() and not Path(found).is_relative_to(own)
    assert found.kept == f"inputs/{what}/{Path(name).name}"
    (own / "unrelated.txt").write_text("x")
    (own / "invented" / "notes.txt").write_text("x")
    assert take(str(own / name)).hash == found.hash  # by its whole path, too
    top = (own / name).parent
    seen = {found.hash}
    for file in files:
        edit(top / file if not file.startswith("arm/") else own / file)
        seen.add(take(name).hash)
    assert len(seen) == 1 + len(files)


@pytest.mark.parametrize(("what", "name"), [
    ("motor", "qbl4208"), ("load", "inertia"), ("device", "tmcm1636"), ("distributions", "inertia"), ("motor", None),
    ("suite", "public"),
])  # fmt: skip
def test_what_ships_is_no_input_whatever_lies_in_the_present_folder(own, what, name):
    shutil.copytree(INVENTED, own / "tmcm1636")
    assert taken(what, name) is name


def test_an_input_that_is_pickled_is_its_content(own, decoys, monkeypatch):
    packed = pickle.dumps([taken("motor", "mine.toml"), taken("load", "arm/arm.xml"), taken("device", "invented")])
    shutil.rmtree(own / "arm")
    program = (
        "import pickle, sys; from drive_env.motors import find_motor; from mechanics.loads import find_load\n"
        "from mechanics.model import read_model; from drive_env.devices import find_device\n"
        "motor, load, device = pickle.loads(sys.stdin.buffer.read())\n"
        "print(find_motor(motor).R_s, read_model(find_load(load)).body_mass[1], find_device(device).num_axes)\n"
        "from tuning.runs import inputs; print(inputs._COPIES[0][1])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], input=packed, capture_output=True, cwd=decoys, check=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    figures, folder = done.stdout.decode().splitlines()
    expected = find_motor("qbl4208").R_s, 0.1, find_device(str(INVENTED)).num_axes
    assert [float(one) for one in figures.split()] == pytest.approx(expected)
    assert not Path(folder).exists()  # nothing is left behind


def test_a_load_that_names_a_file_by_its_whole_path_cannot_be_kept(own):
    model = own / "arm" / "arm.xml"
    model.write_text(model.read_text().replace("disc.obj", str(own / "arm" / "meshes" / "disc.obj")))
    with pytest.raises(InputError, match=r"arm\.xml names .*disc\.obj by its whole path.*name it relative to"):
        taken("load", "arm/arm.xml")


def test_an_input_that_is_too_large_or_gone_is_told(own, monkeypatch):
    monkeypatch.setattr(inputs, "MOST_BYTES", 1000)
    with pytest.raises(InputError, match=r"^mine\.toml: .* A motor has 0 MB at most"):
        taken("motor", "mine.toml")
    with pytest.raises(ValueError, match=r"none\.toml cannot be read"):
        taken("motor", "none.toml")


@pytest.mark.parametrize("name", ["inputs/../../mine.toml", "/etc/passwd", "inputs/motor/../x.toml", "mine.toml"])
def test_settings_name_inputs_in_their_own_folder_alone(own, name):
    with pytest.raises(InputError, match="is no place of an input"):
        found_again(name, {name: "0"}, own)


# --- sweeps -----------------------------------------------------------------------------------------------------------
def own_grid(text=SMALL, **names):
    for what, name in (names or {"motor": "mine.toml"}).items():
        text = re.sub(rf"^{what} = .*$", f'{what} = "{name}"', text, flags=re.MULTILINE)
    return text


def begin(out, config):
    """Leave an unfinished run of an experiment with a shard that is done."""
    from tuning.runs import provenance

    experiment = load_experiment(config).with_inputs()
    settings = provenance.HEADER + experiment.to_toml(provenance.versions())
    with shard_log(out, settings, resume=False, inputs=experiment.inputs()) as log:
        log.append(0, {"score": np.zeros(1)})
    return (out.with_name(f"{out.name}.unfinished") / "shards").read_bytes()


@pytest.mark.every(3)
@pytest.mark.parametrize(("names", "changed", "told"), [
    ({"motor": "mine.toml"}, "mine.toml", r"mine\.toml \(motor\)"),
    ({"load": "arm/arm.xml"}, "arm/arm.xml", r"arm/arm\.xml \(load\)"),
    ({"load": "arm/arm.xml"}, "arm/parts/body.xml", r"parts/body\.xml of arm/arm\.xml \(load\)"),
    ({"load": "arm/arm.xml"}, "arm/meshes/disc.obj", r"meshes/disc\.obj of arm/arm\.xml \(load\)"),
    ({"device": "smaller.toml"}, "smaller.toml", r"smaller\.toml \(device\)"),
    ({"device": "invented"}, "invented/gains.toml", r"invented/gains\.toml of invented \(device\)"),
    ({"device": "invented"}, "invented/invented.eds", r"invented/invented\.eds of invented \(device\)"),
    ({"device": "invented"}, "invented/presets/qbl4208.toml", r"invented/presets/qbl4208\.toml of invented \(device\)"),
])  # fmt: skip
def test_a_sweep_is_not_resumed_with_a_file_that_was_changed(own, names, changed, told):
    """Before: the rows of two motors in one table, 1024 of 4356 the old one's, and the same settings.toml."""
    (own / "grid.toml").write_text(own_grid(swept_by(names), **names), encoding="utf-8")
    before = begin(own / "out", own / "grid.toml")
    edit(own / changed)
    result = drive_tune("sweep", "--config", "grid.toml", "--out", "out", "--resume")
    assert result.exit_code == 2
    assert re.search(
        rf"drive-tune: {told} was changed since the run in out\.unfinished was begun, and the results of two are not "
        r"mixed: go on with the .* as it was, of which out\.unfinished/inputs/.* is a copy, or remove out\.unfinished",
        result.output,
    ), result.output
    assert (own / "out.unfinished" / "shards").read_bytes() == before
    assert not (own / "out").exists()


def swept_by(names):
    """Return the grid in the names that the invented drive has for the gains, if it is of that."""
    if names.get("device") != "invented":
        return SMALL
    gains = find_device(str(INVENTED)).gains
    keys = [f"{index:04X}h:{sub:02X}" for index, sub in (gains.keys[gains.names.index(name)] for name in gains.outer)]
    text = SMALL.replace("2042h:01", keys[0]).replace("2042h:02", keys[1])
    return text.replace("low = 100\nhigh = 3000", "low = 1\nhigh = 9").replace('spacing = "log"', 'spacing = "lin"')


def test_a_sweep_goes_on_from_its_own_copy_though_the_file_is_gone(own):
    (own / "grid.toml").write_text(own_grid(), encoding="utf-8")
    begin(own / "out", own / "grid.toml")
    shutil.rmtree(own / "arm")
    (own / "mine.toml").unlink()
    experiment = load_experiment(own / "out.unfinished" / "settings.toml")
    assert find_motor(experiment.motor).R_s == find_motor("qbl4208").R_s
    (own / "out.unfinished" / "inputs" / "motor" / "mine.toml").write_text(resistance(MOTOR, 2.0))
    result = drive_tune("sweep", "--out", "out", "--resume")
    assert result.exit_code == 2
    assert "inputs/motor/mine.toml was changed since the run was made with it" in result.output


@pytest.mark.slow
def test_settings_of_a_sweep_repeat_it_from_its_folder_alone(own, decoys, monkeypatch):
    """Before: whatever lay at the path in the present folder."""
    experiment = load_experiment(write(own / "grid.toml", own_grid(motor="mine.toml", load="arm/arm.xml")))
    first = sweep.run(experiment)
    save_sweep(first, own / "out")
    shipped = contents(own / "out")
    settings = tomllib.loads((own / "out" / "settings.toml").read_text())
    assert (settings["motor"], settings["load"]) == ("inputs/motor/mine.toml", "inputs/load/arm.xml")
    assert set(settings["inputs"]) == {"inputs/motor/mine.toml", "inputs/load/arm.xml"}
    assert "drive-env-inputs" not in (own / "out" / "settings.toml").read_text()
    moved = decoys / "moved"
    (own / "out").rename(moved)
    for file in ("mine.toml", "grid.toml"):
        (own / file).unlink()
    shutil.rmtree(own / "arm")
    monkeypatch.chdir(decoys)
    save_sweep(sweep.run(load_experiment("moved/settings.toml")), "again")
    assert contents(decoys / "again") == shipped
    (decoys / "again" / "inputs" / "load" / "meshes" / "disc.obj").unlink()
    with pytest.raises(ExperimentError, match="there is no such file in"):
        load_experiment("again/settings.toml")
    shutil.rmtree(decoys / "again" / "inputs")
    with pytest.raises(ExperimentError, match=r"inputs/(motor|load)/.* is missing.*copy the run's folder as a whole"):
        load_experiment("again/settings.toml")


def write(path, text):
    path.write_text(text, encoding="utf-8")
    return path


# --- searches and comparisons -----------------------------------------------------------------------------------------
def interrupt_the_search(monkeypatch):
    """Have a search of `drive-tune auto --by tpe` end as Ctrl-C ends it, with a part that is done."""

    def stop(shards, pool, log, progress):
        log.append(0, {"x": np.zeros(1)})
        raise KeyboardInterrupt

    monkeypatch.setattr(searches, "run", stop)


OPTIMISE = ("auto", "--by", "tpe", "--motor", "mine.toml", "--load", "arm/arm.xml", "--trials", 1, "--machines", 1,
            "--out", "out")  # fmt: skip


def test_a_search_is_not_resumed_with_a_file_that_was_changed(own, monkeypatch):
    interrupt_the_search(monkeypatch)
    assert drive_tune(*OPTIMISE, "--searches", 2).exit_code == 130
    edit(own / "arm" / "parts" / "body.xml")
    result = drive_tune(*OPTIMISE, "--searches", 2, "--resume")
    assert result.exit_code == 2
    assert "parts/body.xml of arm/arm.xml (load) was changed since the run in out.unfinished" in result.output


@pytest.mark.slow
def test_settings_of_a_search_repeat_it_from_its_folder_alone(own, decoys, monkeypatch):
    assert drive_tune(*OPTIMISE, "--by", "grid").exit_code == 0
    found = (own / "out" / "trials.csv").read_bytes()
    (own / "out").rename(decoys / "moved")
    shutil.rmtree(own / "arm")
    monkeypatch.chdir(decoys)
    result = drive_tune("auto", "--config", "moved/settings.toml", "--out", "again")
    assert result.exit_code == 0, result.output
    assert (decoys / "again" / "trials.csv").read_bytes() == found
    edit(decoys / "moved" / "inputs" / "motor" / "mine.toml")
    result = drive_tune("auto", "--config", "moved/settings.toml", "--out", "third")
    assert result.exit_code == 2
    assert "inputs/motor/mine.toml was changed since the run was made with it" in result.output


@pytest.mark.slow
@pytest.mark.parametrize("other", ["changed", "another load", "another motor"])
def test_a_journal_is_not_gone_on_with_for_something_else(own, other):
    """Before: trials of both in one study, whatever they were of."""
    pytest.importorskip("optuna")
    first = ["auto", "--by", "random", "--motor", "mine.toml", "--load", "inertia", "--trials", 1, "--machines", 1,
             "--journal", "journal"]  # fmt: skip
    assert drive_tune(*first, "--out", "one").exit_code == 0
    before = (own / "journal").read_bytes()
    if other == "changed":
        edit(own / "mine.toml")
    else:
        old, new = ("inertia", "two_mass") if other == "another load" else ("mine.toml", "qbl4208")
        first = [new if one == old else one for one in first]
    result = drive_tune(*first, "--out", "two")
    assert result.exit_code == 2
    assert "journal holds trials of something else, and they are not mixed: " in result.output
    added = (own / "journal").read_bytes().removeprefix(before)
    assert added.count(b"\n") == 1 and b"study_name" in added  # no trial


@pytest.mark.slow
def test_a_comparison_is_not_resumed_with_a_file_that_was_changed(own, monkeypatch):
    def stop(*_, log, **__):
        log.append(0, {"rows": np.array("[]")})
        raise KeyboardInterrupt

    monkeypatch.setattr("tuning.compare.comparison.compare", stop)
    monkeypatch.setattr("tuning.compare.comparison.so_far", lambda *_: None)
    command = ("rank", "--suite", "machines.toml", "-t", "factory", "--out", "out")
    assert drive_tune(*command).exit_code == 130
    edit(own / "mine.toml")
    result = drive_tune(*command, "--resume")
    assert result.exit_code == 2
    assert "mine.toml of machines.toml (suite) was changed since the run in out.unfinished" in result.output
    assert (
        tomllib.loads((own / "out.unfinished" / "settings.toml").read_text())["suite"] == "inputs/suite/machines.toml"
    )


@pytest.mark.slow
def test_a_suite_is_the_same_wherever_its_folder_lies_and_whoever_reads_it(own, decoys, monkeypatch):
    (here,) = load_suite("machines.toml")
    assert here.name == "arm-mine-0"
    shutil.copytree(own, decoys / "copy")
    monkeypatch.chdir(decoys)
    (there,) = load_suite("copy/machines.toml")
    assert repr(there) == repr(here)
    assert find_motor(there.motor) == find_motor(here.motor)
    edit(decoys / "copy" / "arm" / "meshes" / "disc.obj")
    assert repr(load_suite("copy/machines.toml")) != repr((here,))


# --- elsewhere --------------------------------------------------------------------------------------------------------
class Away:
    """A pool in a folder with other files of the same names, after those here are gone: what travels is the task."""

    width, shares_disk = 1, False

    def __init__(self, gone, folder):
        self.gone, self.folder = gone, folder

    def unordered(self, function, items, say=None, fits=None):
        packed, before = pickle.dumps(list(items)), Path.cwd()
        aside = self.gone.with_name("aside")
        self.gone.rename(aside)
        kept = inputs._COPIES[:]
        inputs._COPIES.clear()  # as in another process
        os.chdir(self.folder)
        try:
            for k, item in enumerate(pickle.loads(packed)):
                result = function(item)
                assert fits is None or fits(items[k], result)
                yield k, result
        finally:
            inputs.forget_copies()
            inputs._COPIES[:] = kept
            aside.rename(self.gone)
            os.chdir(before)


@pytest.mark.slow
def test_a_sweep_elsewhere_has_the_files_of_here(own, decoys):
    experiment = load_experiment(write(own / "grid.toml", own_grid(motor="mine.toml", load="arm/arm.xml")))
    here = sweep.run(experiment)
    there = sweep.run(experiment, pool=Away(own, decoys))
    for name, column in here.columns.items():
        np.testing.assert_array_equal(there.columns[name], column, err_msg=name)


@pytest.mark.slow
def test_a_search_elsewhere_has_the_files_of_here(own, decoys, tmp_path):
    from tuning.runs.shard_log import ShardLog

    shards = searches.searches({"load": "arm/arm.xml", "motor": "mine.toml"}, Settings("grid", trials=1), 1)
    with ShardLog(tmp_path / "a", "x") as one, ShardLog(tmp_path / "b", "x") as two:
        (here,), (there,) = searches.run(shards, None, one), searches.run(shards, Away(own, decoys), two)
    assert here.cost == there.cost and np.array_equal(here.rule, there.rule)


@pytest.mark.slow
def test_a_comparison_elsewhere_has_the_files_of_here(own, decoys):
    from tuning.compare.tuners import find_tuner

    machines, tuners = load_suite("machines.toml"), {"factory": find_tuner("factory")}
    assert compare(machines, tuners).rows == compare(machines, tuners, pool=Away(own, decoys)).rows


@pytest.mark.slow
def test_episodes_elsewhere_have_the_files_of_here(own, decoys):
    options = {"load": "arm/arm.xml", "motor": "mine.toml", "distributions": "spread.toml", "mode": "csp",
               "action": "offset", "duration": 0.05}  # fmt: skip
    arguments = {"name": "nothing", "episodes": 2, "seed": 5}
    policy = Written.of("nothing", False)
    here = evaluate(policy.open("tracking", options), "tracking", options, **arguments)
    there = evaluate_elsewhere(policy, "tracking", options, Away(own, decoys), **arguments)
    assert there.values == here.values
    other = evaluate(
        policy.open("tracking", options), "tracking",
        options | {"load": str(decoys / "arm/arm.xml"), "motor": str(decoys / "mine.toml")}, **arguments,
    )  # fmt: skip
    assert other.values != here.values  # the decoys would have been seen


def test_a_function_of_a_workers_own_is_not_taken_for_the_one_here(own, decoys, monkeypatch):
    (own / "my_policy.py").write_text("def act(observation):\n    return 0 * observation[:, :1]\n")
    monkeypatch.setattr(sys, "path", [str(own), *sys.path])
    options = {"load": "inertia", "mode": "csp", "action": "offset", "duration": 0.05}
    written = Written.of("my_policy:act", False)
    assert written.open("tracking", options) is not None
    other = written._replace(source="0123456789abcdef" * 4)
    with pytest.raises(ValueError, match=r"my_policy:act: a worker's file with it has hash .*, here it has 0123456789"):
        other.open("tracking", options)


@pytest.mark.slow
def test_a_cluster_opens_what_was_sent_though_its_worker_has_a_file_of_that_name(own, decoys):
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 0, "protocol": "tcp://", "dashboard_address": "127.0.0.1:0"}
    with distributed.LocalCluster(host="127.0.0.1", silence_logs="CRITICAL", **options) as cluster:
        address = cluster.scheduler_address
        program = "from distributed.cli.dask_worker import main; main()"
        process = subprocess.Popen(
            [sys.executable, "-c", program, address, "--host", "127.0.0.1", "--no-nanny", "--no-dashboard"],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=decoys,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
        )  # fmt: skip
        try:
            with distributed.Client(address, set_as_default=False) as client:
                client.wait_for_workers(1, timeout=PATIENCE)
                assert list(client.run(os.getcwd).values()) == [str(decoys)]
                assert find_motor(decoys / "mine.toml").R_s == pytest.approx(3.0 * find_motor("qbl4208").R_s)
            with open_pool(cluster=address) as pool:
                ((_, motor),) = pool.unordered(find_motor, [taken("motor", "mine.toml")])
                ((_, load),) = pool.unordered(find_load, [taken("load", "arm/arm.xml")])
        finally:
            process.kill()
            process.wait()
    assert motor.R_s == find_motor("qbl4208").R_s
    assert not load.mjcf.is_relative_to(decoys)


# --- trainings and agents ---------------------------------------------------------------------------------------------
def own_training():
    run = tiny()
    run.hyperparameters["env_kwargs"] |= {"load": "arm/arm.xml", "motor": "mine.toml", "distributions": "spread.toml"}
    return run


@pytest.mark.slow
def test_a_training_goes_on_and_its_agent_acts_with_the_load_that_it_had(own, decoys, monkeypatch):
    pytest.importorskip("stable_baselines3")
    agent = train(own_training(), own / "out")
    assert set(agent.card["inputs"]) == {
        "inputs/load/arm.xml",
        "inputs/motor/mine.toml",
        "inputs/distributions/spread.toml",
    }
    (own / "out").rename(decoys / "moved")
    shutil.rmtree(own / "arm")
    monkeypatch.chdir(decoys)
    again = AgentFile.load("moved/agent.npz")
    assert again.hash == agent.hash
    assert find_motor(again.configuration["motor"]).R_s == find_motor("qbl4208").R_s
    assert evaluate(policy_of(again), again.environment, again.configuration, episodes=1).values
    resumed = run_to_resume("moved")
    assert find_motor(resumed.hyperparameters["env_kwargs"]["motor"]).R_s == find_motor("qbl4208").R_s
    # Alone it finds no load: none of that name in the present folder, and beside it none that is another.
    (decoys / "alone").mkdir()
    shutil.copy("moved/agent.npz", "alone/agent.npz")
    alone = open_policy("alone/agent.npz")
    assert alone.configuration["load"] == str(decoys / "alone/inputs/load/arm.xml")
    shutil.copytree("inputs", "alone/inputs")
    with pytest.raises(InputError, match=r"alone/inputs/.* was changed since the run was made with it"):
        open_policy("alone/agent.npz")
    edit(decoys / "moved" / "inputs" / "motor" / "mine.toml")
    for read in (lambda: run_to_resume("moved"), lambda: AgentFile.load("moved/agent.npz")):
        with pytest.raises(InputError, match=r"inputs/motor/mine\.toml was changed since the run was made with it"):
            read()
    (decoys / "moved" / "inputs" / "motor" / "mine.toml").unlink()
    with pytest.raises(InputError, match=r"inputs/motor/mine\.toml is missing"):
        run_to_resume("moved")


def test_an_agent_that_was_moved_alone_has_no_load_rather_than_another(own, decoys):
    kept = {"inputs/load/arm.xml": "0" * 64}
    found = found_again({"load": "inputs/load/arm.xml"}, kept, own / "nowhere", alone=True)["load"]
    assert isinstance(found, Input) and found.kept == "inputs/load/arm.xml" and hashes([found]) == kept
    with pytest.raises(ValueError, match=r"nowhere/inputs/load/arm\.xml"):
        find_load(found)
    assert pickle.loads(pickle.dumps(found)).hash == "0" * 64


# --- certificates -----------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_a_certificate_has_the_hash_of_the_motor_and_its_folder_the_copy(own):
    result = drive_tune("auto", "--motor", "mine.toml", "--load", "inertia", "--out", "out")
    assert result.exit_code == 0, result.output
    versions = json.loads((own / "out" / "certificate.json").read_text())["versions"]
    assert versions["inputs/motor/mine.toml"] == taken("motor", "mine.toml").hash
    assert (own / "out" / "inputs" / "motor" / "mine.toml").read_text() == MOTOR


# --- a million --------------------------------------------------------------------------------------------------------
MILLION = (
    GRID.replace("count = 48", "count = 1000")
    .replace("low = 100\nhigh = 3000", "low = 100\nhigh = 1099")
    .replace('"log"', '"lin"')
)


def test_a_grid_of_a_million_is_split_and_its_shards_are_points_of_it(own):
    """Before: refused above 262,144."""
    experiment = load_experiment(write(own / "grid.toml", MILLION))
    assert experiment.size() == 1_000_000
    parts = sweep.shards(experiment, width=4)
    assert len(parts) == 977 and parts[-1].last == 1_000_000
    for part in (parts[0], parts[500], parts[-1]):
        points = experiment.points(part.first, part.last)
        first, second = divmod(np.arange(part.first, part.last), 1000)
        np.testing.assert_array_equal(points, np.stack([100 + first, 100 + second], axis=1))


@pytest.mark.slow
def test_a_table_is_written_in_parts_to_the_same_bytes(own, monkeypatch):
    result = sweep.run(load_experiment(write(own / "grid.toml", SMALL)))
    save_sweep(result, own / "whole")
    monkeypatch.setattr("tuning.runs.sweep_files.ROWS", 4)
    save_sweep(result, own / "parts")
    assert contents(own / "parts") == contents(own / "whole")
    assert len(list(csv.reader((own / "parts" / "results.csv").open()))) == 10
    assert set(FILES) <= {path.name for path in (own / "parts").iterdir()}


def test_a_disk_that_is_full_names_the_input(own, monkeypatch):
    def full(path, content):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("drive_env.whole_file.write_whole", full)
    with pytest.raises(OSError, match=r"out/inputs/motor/mine\.toml"):
        write_inputs(own / "out", [taken("motor", "mine.toml")])
