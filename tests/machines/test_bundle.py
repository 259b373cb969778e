"""A bundle in compiled code says what it says in Python; hooks are called; an exchange says what `record` says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from drive_env import EmulatedDrives, ObjectAccessError, motion
from drive_env.emulator.cyclic_control import CyclicControl, Hooks, cyclic_control
from mechanics.kernels.bundle import Bundle, Cube, Matrix, Numbers, Vector, reader
from mechanics.kernels.compiled import cached

SAMPLED = (0x6041, 0x6064, 0x606C)


@dataclass(eq=False)
class Inner(Bundle):
    vector: Vector
    yes: bool


@dataclass(eq=False)
class Outer(Bundle):
    numbers: Numbers
    cube: Cube
    matrix: Matrix
    inner: Inner
    share: float
    count: int = 3


@dataclass(eq=False)
class Noted(Bundle):
    played: Matrix
    calls: Matrix


outer_at, noted_at = reader(Outer), reader(Noted)


@cached()
def total(address, seen):
    own = outer_at(address)
    seen[0] = own.numbers.sum()
    seen[1] = own.cube[1, 2, 3]
    seen[2] = own.matrix.shape[0] + 10 * own.matrix.shape[1]
    seen[3] = own.inner.vector[1]
    seen[4] = own.share
    seen[5] = own.count + (100 if own.inner.yes else 0)
    own.matrix[1, 0] = 7.0


@cached()
def note_before(address, first, count):
    noted_at(address).calls[first // 64, 0] += count
    return 1


@cached()
def note_after(address, first, count):
    noted_at(address).calls[first // 64, 1] += count
    return 0


def test_compiled_code_reads_what_python_reads():
    inner = Inner(np.array([1.0, 2.5]), True)
    own = Outer(np.arange(4), np.arange(60.0).reshape(3, 4, 5), np.zeros((2, 3)), inner, 0.25)
    seen = np.zeros(6)
    total(own.address, seen)
    assert seen.tolist() == [6.0, own.cube[1, 2, 3], 32.0, 2.5, 0.25, 103.0]
    assert own.matrix[1, 0] == 7.0
    own.replace(numbers=np.array([5]), share=-1.0)
    inner.replace(yes=False)
    total(own.address, seen)
    assert seen.tolist() == [5.0, own.cube[1, 2, 3], 32.0, 2.5, -1.0, 3.0]


@pytest.mark.parametrize("threads", [1, 2])
def test_an_exchange_is_a_call_of_record(threads):
    options = {"num_machines": 130, "seed": 1, "randomise": True, "num_threads": threads}
    with EmulatedDrives(**options) as one, EmulatedDrives(**options) as other:
        for drives in (one, other):
            motion.enable(drives, mode="csv")
        calls = np.zeros((3, 2))
        short = cyclic_control(one, SAMPLED, (0x60FF,), 2, 0.001)
        short.hooks = Hooks(note_before, note_after, Noted(np.zeros((1, 1)), calls))
        long = CyclicControl(other, SAMPLED, (0x60FF,), 2, 0.001)
        rng = np.random.default_rng(0)
        for k in range(5):
            if k == 3:
                for drives in (one, other):
                    drives.write(0x2058, 1000)  # the scale of positions
            short.played[:] = long.played[:] = rng.integers(-100_000, 100_000, (1, 2, 130))
            short.run()
            long.run()
            assert np.array_equal(short.sampled, long.sampled)
        assert calls.tolist() == [[320.0, 320.0], [320.0, 320.0], [10.0, 10.0]]


def test_an_integer_out_of_range_is_refused():
    with EmulatedDrives(num_machines=2, num_threads=1) as drives:
        motion.enable(drives, mode="cst")
        call = cyclic_control(drives, SAMPLED, (0x6071,), 1, 0.001)
        call.played[:] = 1_000_000_000
        with pytest.raises(ObjectAccessError):
            call.run()
        call.played[:] = 0
        call.run()
