"""Random and designed scripts against the envelope: a sample in every run (tests/adversary.py has the verdict)."""

from __future__ import annotations

import inspect
import multiprocessing
import os
import random
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from adversary import (
    ACTIONS,
    END_STOP_SPEED,
    MACHINES,
    WRITABLE,
    Bench,
    Tally,
    attack_machines,
    build_bench,
    judge,
    kind_of,
    main,
    quiet,
    run_episode,
    runs,
)
from rigs import TESTS
from rigs.fault_injection import eds_read_once
from rigs.thinning import part

from drive_env import Limits
from drive_env.cia402 import State
from drive_env.cores import usable_cores

SAMPLE, MANY = 12, part(300, 40)
PATIENCE = 60.0  # s
ON, OFF = 4, 1  # of the automaton


def test_the_envelope_withstands_a_sample():
    tally = attack_machines(range(SAMPLE))
    assert tally.text() == ""
    assert tally.refused > SAMPLE // 3  # it was needed
    assert tally.outside > 0  # it does reach the ends of travel


@pytest.mark.slow
def test_the_envelope_withstands_many():
    cores = usable_cores()
    tally = Tally()
    with ProcessPoolExecutor(cores, multiprocessing.get_context("spawn")) as pool:
        for part in pool.map(attack_machines, [range(SAMPLE + k, SAMPLE + MANY, cores) for k in range(cores)]):
            tally.merge(part)
    assert tally.text() == ""
    assert tally.episodes == MANY


WORKER = """
import multiprocessing, time
from concurrent.futures import ProcessPoolExecutor
import adversary

def note(k):
    open(f"{multiprocessing.current_process().pid}.worker", "w").close()
    time.sleep(600)

if __name__ == "__main__":
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=adversary.end_with_parent) as pool:
        list(pool.map(note, range(100)))
"""


@pytest.mark.slow
def test_workers_end_with_the_program_that_started_them(tmp_path):
    """Killed, it can tell them nothing; they had gone on to the end of their queue."""
    (tmp_path / "many.py").write_text(WORKER)
    program = subprocess.Popen([sys.executable, "many.py"], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(TESTS)})
    try:
        wait_until(lambda: list(tmp_path.glob("*.worker")))
        worker = int(next(tmp_path.glob("*.worker")).stem)
        assert is_running(worker)
    finally:
        program.terminate()
        program.wait(PATIENCE)
    wait_until(lambda: not is_running(worker))


def test_its_own_workers_do_so():
    assert "initializer=end_with_parent" in inspect.getsource(main)


def wait_until(condition):
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "nothing came of it"
        time.sleep(0.05)


def is_running(process):
    try:
        os.kill(process, 0)
        return "\nState:\tZ" not in Path(f"/proc/{process}/status").read_text()
    except (ProcessLookupError, FileNotFoundError):
        return False


# --- the adversary is one -------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_without_the_envelope_it_wins():
    problems = []
    with eds_read_once(), quiet():
        benches = [build_bench(machine) for machine in (0, 1, 3)]
        for number in range(75):
            problems += run_episode(benches[number % 3], number, envelope=False).problems
        for bench in benches:
            bench.drives.close()
    found = Counter(map(kind_of, problems))
    assert found["left enabled"] >= 10
    assert found["beyond the travel"] >= 5
    assert found["above the limit"] >= 3
    assert found["mistake of ours"] == 0


def test_an_episode_is_the_same_again():
    with eds_read_once(), quiet():
        bench = build_bench(2)
        first, other, again = (run_episode(bench, number) for number in (2, 22, 2))
        bench.drives.close()
    assert first == again
    assert other.diary != first.diary


@pytest.mark.slow
def test_every_action_is_taken_and_every_kind_of_object_written():
    taken = set()
    with eds_read_once(), quiet():
        bench = build_bench(0)
        for number in range(40):
            taken |= {line for line in run_episode(bench, number).diary if not line.startswith(" ")}
        bench.drives.close()
    assert taken == {action.__name__ for action in ACTIONS}
    indices = {entry.index for entry in WRITABLE}
    assert {0x1016, 0x1029, 0x1600, 0x2003, 0x2058, 0x2080, 0x6040, 0x6060, 0x607A, 0x6085, 0x60B0} <= indices


def test_machines_differ_and_have_end_stops_among_them():
    benches = [build_bench(number) for number in range(MACHINES)]
    assert len({bench.limits for bench in benches}) == MACHINES
    assert len({round(bench.deceleration) for bench in benches}) == MACHINES
    assert sum(bench.stops is not None for bench in benches) >= 4
    assert all(300.0 < bench.deceleration < 10_000.0 for bench in benches)
    for bench in benches:
        bench.drives.close()


# --- the verdict -----------------------------------------------------------------------------------------------------
def verdict(theta, omega, fsa=ON, current=0.0, load=0.0, intact=True, stops=None):
    """Judge an axis with travel of 10 rad either way, a ramp of 500 rad/s^2 at half of 1000, and 2 A."""
    column = [
        np.broadcast_to(np.asarray(one, float), theta.shape)[:, None] for one in (theta, omega, fsa, current, load)
    ]
    names = ("theta", "omega", "fsa", "current", "load")
    truth = SimpleNamespace(**{name: lambda one=one: one for name, one in zip(names, column, strict=True)})
    bench = Bench(0, None, Limits(current=2000), (-10.0, 10.0), 1000.0, 0.0, stops)
    return judge(bench, SimpleNamespace(truth=truth), intact)


def drive_out(distance, speed=100.0):
    """Pass the end of the travel at a speed and stop `distance` beyond it; return angle and speed."""
    theta = np.minimum(np.arange(400) * speed * 1e-3, 10.0 + distance)
    return theta, np.where(theta < 10.0 + distance, speed, 0.0)


def test_the_verdict_takes_power_at_the_end_for_left_enabled():
    still = np.zeros(200)
    assert verdict(still, still, ON) == ["left enabled"]
    assert verdict(still, still, OFF) == []
    assert verdict(still, still, np.repeat([ON, OFF], 100)) == []


@pytest.mark.parametrize(("distance", "wrong"), [(12.5, False), (14.0, True)])  # 2.5 + 10 + 0.63 rad at 100 rad/s
@pytest.mark.parametrize("way", [1, -1])
def test_the_verdict_knows_the_stopping_distance(distance, wrong, way):
    theta, omega = drive_out(distance)
    fsa = np.where(np.arange(400) < 399, ON, OFF)
    found = verdict(way * theta, way * omega, fsa)
    assert [("turns beyond the travel" in one) for one in found] == [True] * wrong


def test_momentum_counts_where_the_axis_could_have_been_stopped():
    theta, omega = drive_out(14.0)
    late, early = np.where(theta < 11.0, ON, OFF), np.where(theta < 9.0, ON, OFF)
    assert verdict(theta, omega, late) != []  # it passed the end with power, and was cut
    assert verdict(theta, omega, early) == []  # its program had switched it off inside
    assert verdict(theta, omega, late, intact=False) == []  # no loop to stop it with


@pytest.mark.parametrize(
    ("rates", "wrong"),
    [
        ([(500, 110.0)], False),  # it would stand within a second, all the way
        ([(500, 40.0)], True),  # it would not, from the beginning
        ([(150, 110.0), (40, 0.0), (310, 110.0)], False),  # the voltage goes after this if it lasts
        ([(150, 110.0), (100, 0.0), (250, 110.0)], True),
        ([(150, 110.0), (350, -20.0)], True),  # faster again
    ],
)
def test_an_axis_whose_loops_were_changed_may_have_current_while_it_slows_down(rates, wrong):
    omega = 100.0 - np.cumsum(np.concatenate([np.full(count, rate) for count, rate in rates])) * 1e-3
    theta = 10.0 + np.cumsum(omega) * 1e-3
    fsa = np.where(np.arange(500) < 499, State.QUICK_STOP_ACTIVE, OFF)
    assert bool(verdict(theta, omega, fsa, intact=False)) == wrong
    assert verdict(theta, omega, fsa) != []  # with loops as commissioned it would have stopped long before


def test_no_stop_has_current_for_longer_than_two_seconds():
    omega = 100.0 * np.exp(-1.1 * np.arange(2500) * 1e-3)
    theta = 10.0 + np.cumsum(omega) * 1e-3
    for cycles, wrong in ((2000, False), (2400, True)):
        fsa = np.where(np.arange(2500) < cycles, State.QUICK_STOP_ACTIVE, OFF)
        assert bool(verdict(theta, omega, fsa, intact=False)) == wrong


@pytest.mark.parametrize(("milliseconds", "wrong"), [(30, False), (31, True)])
def test_the_verdict_counts_current_above_its_limit(milliseconds, wrong):
    current = np.zeros(200)
    current[50 : 50 + milliseconds] = 2.6
    current[150:190] = 2.4  # within the margin
    still = np.zeros(200)
    assert len(verdict(still, still, OFF, current)) == wrong


@pytest.mark.parametrize(("speed", "wrong"), [(END_STOP_SPEED - 1, False), (END_STOP_SPEED + 1, True)])
def test_the_verdict_sees_end_stops(speed, wrong):
    load = np.where(np.arange(200) < 150, 0.0, 0.26)
    fsa = np.repeat([ON, OFF], [190, 10])
    assert len(verdict(np.zeros(200), np.full(200, speed), fsa, load=load, stops=(-0.25, 0.25))) == wrong


def test_runs_of_true_values():
    assert runs(np.array([True, True, False, False, True])) == [(0, 2), (4, 5)]
    assert runs(np.zeros(3, bool)) == []
    rng = random.Random(1)
    values = np.array([rng.random() < 0.5 for _ in range(100)])
    again = np.zeros(100, bool)
    for first, last in runs(values):
        again[first:last] = True
    assert (again == values).all()
