"""What proposes gains: points of a box by ask and tell, and that a study broken off goes on as if it had not been."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from tuning.runs import provenance
from tuning.search import samplers
from tuning.search.samplers import check_installed, new_proposer

LOW, HIGH = np.array([-1.0, -2.0]), np.array([1.0, 2.0])
BEST = np.array([0.3, -0.7])


def bowl(point):
    """A bowl whose bottom, at BEST, is worth 0."""
    return float(np.sum((point - BEST) ** 2))


def search(proposer, trials, generation, journal_breaks_at=None):
    """Return all points that a search proposes, told what they are worth."""
    points = []
    while len(points) < trials:
        if journal_breaks_at is not None and len(points) >= journal_breaks_at:
            break
        asked = proposer.ask(min(generation, trials - len(points)))
        if not asked:
            break
        proposer.tell([[bowl(point)] for point in asked], [{"point": point.tolist()} for point in asked])
        points += asked
    return np.array(points)


@pytest.mark.every(3)
@pytest.mark.parametrize(("sampler", "generation"), [("tpe", 1), ("tpe", 8), ("cmaes", 1), ("cmaes", 8)])
def test_a_search_gets_to_the_bottom(sampler, generation):
    points = search(new_proposer(sampler, LOW, HIGH, seed=1, generation=generation), 64, generation)
    assert points.shape == (64, 2)
    assert np.all((points >= LOW) & (points <= HIGH))
    # Of 64 points at random half are nearer than 0.15 to the bottom, squared, at best; a search does much better.
    assert min(bowl(point) for point in points) < 0.03
    late, early = (np.mean([bowl(point) for point in part]) for part in (points[-16:], points[:16]))
    assert late < 0.5 * early


def test_random_points_fill_the_box():
    points = search(new_proposer("random", LOW, HIGH, seed=3), 400, 8)
    share = (points - LOW) / (HIGH - LOW)
    assert np.all(np.abs(share.mean(axis=0) - 0.5) < 0.06)
    assert np.all(np.abs(share.std(axis=0) - 1.0 / np.sqrt(12.0)) < 0.03)


def test_a_grid_is_every_point_once_without_the_edges():
    points = search(new_proposer("grid", LOW, HIGH, seed=0, trials=9), 9, 4)
    expected = {(x, y) for x in (-0.5, 0.0, 0.5) for y in (-1.0, 0.0, 1.0)}
    assert {tuple(np.round(point, 9)) for point in points} == expected
    assert len(points) == 9


def test_a_grid_ends_when_there_is_no_point_left():
    proposer = new_proposer("grid", LOW, HIGH, seed=0, trials=12)  # 3 levels: 9 points, 12 do not make 4 levels
    assert len(search(proposer, 12, 5)) == 9
    assert proposer.ask(5) == []


@pytest.mark.parametrize("sampler", ["random", "tpe", "cmaes", "grid"])
def test_the_given_points_come_first(sampler):
    proposer = new_proposer(sampler, LOW, HIGH, seed=0, trials=10, first=[BEST, -BEST])
    points = search(proposer, 6, 3)
    np.testing.assert_allclose(points[:2], [BEST, -BEST])


@pytest.mark.parametrize("sampler", ["random", "tpe", "cmaes"])
def test_a_seed_is_a_search(sampler):
    first, again, other = (search(new_proposer(sampler, LOW, HIGH, seed=seed), 20, 4) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.any(np.all(first[:, None] == other[None], axis=2))


@pytest.mark.every(2)
@pytest.mark.parametrize(("sampler", "generation"), [("tpe", 1), ("tpe", 4), ("cmaes", 4), ("random", 2)])
def test_a_search_that_was_broken_off_goes_on_as_if_it_had_not_been(sampler, generation, tmp_path):
    def proposer(path):
        return new_proposer(sampler, LOW, HIGH, seed=7, generation=generation, journal=path, first=[BEST * 0.5])

    whole = search(proposer(tmp_path / "whole.log"), 20, generation)
    broken = tmp_path / "broken.log"
    first = search(proposer(broken), 20, generation, journal_breaks_at=8)
    proposer(broken).ask(generation)  # killed before these were told
    resumed = proposer(broken)
    assert resumed.told == 8
    np.testing.assert_allclose([fact["point"] for fact in resumed.history()], first)
    rest = search(resumed, 12, generation)
    np.testing.assert_array_equal(np.concatenate([first, rest]), whole)


def test_a_journal_of_other_sources_is_not_gone_on_with(tmp_path, monkeypatch):
    file = tmp_path / "kept.log"
    search(new_proposer("random", LOW, HIGH, seed=7, journal=file), 2, 1)
    here = provenance.SOURCES
    refused = f"kept.log holds results of sources {here}, these are 0123456789abcdef.*or give another --journal"
    with monkeypatch.context() as other, pytest.raises(ValueError, match=refused):
        other.setattr(provenance, "SOURCES", "0123456789abcdef")
        new_proposer("random", LOW, HIGH, seed=7, journal=file)
    assert new_proposer("random", LOW, HIGH, seed=7, journal=file).told == 2


def test_several_objectives_are_for_samplers_that_know_them():
    proposer = new_proposer("tpe", LOW, HIGH, seed=0, objectives=2)
    for _ in range(10):
        (point,) = proposer.ask(1)
        proposer.tell([[bowl(point), -bowl(point)]], [{}])
    assert proposer.told == 10
    with pytest.raises(ValueError, match=r"CMA-ES has one objective only; take tpe or gp"):
        new_proposer("cmaes", LOW, HIGH, seed=0, objectives=2)


@pytest.mark.parametrize(("sampler", "package"), [("gp", "torch"), ("cmaes", "cmaes")])
def test_a_missing_package_is_named_with_its_remedy(sampler, package, monkeypatch):
    monkeypatch.setattr(samplers.importlib.util, "find_spec", lambda name: None if name == package else object())
    with pytest.raises(ValueError, match=rf"needs {package}: pip install {package}; without it there are random"):
        check_installed(sampler)
    with pytest.raises(ValueError, match=rf"pip install {package}"):
        new_proposer(sampler, LOW, HIGH, seed=0)


def test_mistakes_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"no sampler is named 'luck'; there are random, grid"):
        new_proposer("luck", LOW, HIGH, seed=0)
    with pytest.raises(ValueError, match=r"a grid keeps no journal"):
        new_proposer("grid", LOW, HIGH, seed=0, journal=tmp_path / "j.log")


@pytest.mark.slow
def test_a_gaussian_process_gets_to_the_bottom():
    pytest.importorskip("torch")
    points = search(new_proposer("gp", LOW, HIGH, seed=1), 20, 1)
    assert min(bowl(point) for point in points) < 0.01


@pytest.mark.parametrize(
    ("sampler", "generation", "kind", "options"),
    [
        ("random", 1, "RandomSampler", {}),
        ("tpe", 1, "TPESampler", {"multivariate": True, "n_startup_trials": 6}),
        ("cmaes", 3, "CmaEsSampler", {"popsize": None, "n_startup_trials": 0}),
        ("cmaes", 4, "CmaEsSampler", {"popsize": 4, "n_startup_trials": 0}),
        ("gp", 1, "GPSampler", {"n_startup_trials": 6}),
    ],
)
def test_what_a_sampler_is_told_and_that_each_point_has_a_seed_of_its_own(
    sampler, generation, kind, options, monkeypatch
):
    made = []

    def noted(name):
        return lambda **given: made.append((name, given))

    monkeypatch.setattr(samplers, "check_installed", lambda name: None)
    proposer = new_proposer(sampler, LOW, HIGH, seed=3, generation=generation)
    proposer._optuna = SimpleNamespace(samplers=SimpleNamespace(**{
        name: noted(name) for name in ("RandomSampler", "TPESampler", "CmaEsSampler", "GPSampler")
    }))  # fmt: skip
    for number in (0, 1):
        proposer._new_sampler(number)
    seeds = [given.pop("seed") for _, given in made]
    assert made == [(kind, options)] * 2
    assert seeds == [int(np.random.SeedSequence((3, number)).generate_state(1)[0]) for number in (0, 1)]


@pytest.mark.parametrize(("trials", "levels"), [(1, 1), (3, 1), (4, 2), (8, 2), (9, 3), (10, 3)])
def test_a_grid_has_as_many_levels_as_its_trials_allow(trials, levels):
    points = search(new_proposer("grid", LOW, HIGH, seed=0, trials=trials), 100, 7)
    assert len(points) == levels**2
    first = new_proposer("grid", LOW, HIGH, seed=0, trials=trials + 1, first=[BEST])  # one of them is given
    assert len(search(first, 100, 7)) == levels**2 + 1 and first.told == levels**2 + 1
    cubic = new_proposer("grid", np.zeros(3), np.ones(3), seed=0, trials=125)  # whose root is a little less than 5
    assert len(cubic.ask(1000)) == 125
