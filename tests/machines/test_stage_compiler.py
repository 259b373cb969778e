"""Stages have no machine code of their own, and what Numba is spared changes no kernel."""

import math
from contextlib import nullcontext

import numpy as np
import pytest
from numba import njit, types
from numba.core import inline_closurecall

from mechanics.kernels import compiled, stage_compiler
from mechanics.kernels.compiled import OPTIONS, inlined, stage

PARTS = ((types.Record, "__repr__"), (types.Function, "get_call_type"), (inline_closurecall, "copy"))
RECORD = np.dtype([("speed", np.float64, (4,)), ("state", np.int32, (4,))])


@stage
def _half(value):
    return value / 2


@stage
def _half_of_each(drive):
    for lane in range(4):
        drive.speed[lane] = _half(drive.speed[lane]) + (drive.state[lane] & 3)


@inlined
def _swung(value, times):
    for _ in range(times):
        value = math.sin(value) if value > 0.0 else abs(value) + 0.25
    return value


def _kernel(drives):
    total = 0.0
    for k in range(drives.shape[0]):
        _half_of_each(drives[k])
        total += _swung(drives[k].speed[0], 3) + _swung(drives[k].speed[1], 1)
    return total


def _run():
    """Compile the kernel anew, and return two records after it ran, what it returned, and the kernel."""
    kernel = njit(**OPTIONS)(_kernel)
    drives = np.zeros(2, RECORD)
    drives["speed"] = np.arange(8).reshape(2, 4) - 2.0
    drives["state"] = 7
    return drives, kernel(drives), kernel


def test_a_kernel_is_what_python_says():
    drives, total, _ = _run()
    expected = (np.arange(8).reshape(2, 4) - 2.0) / 2 + 3
    assert np.array_equal(drives["speed"], expected)
    swung = sum(_swung.py_func(row[0], 3) + _swung.py_func(row[1], 1) for row in expected)
    assert total == pytest.approx(swung, rel=1e-15)


def test_a_stage_has_no_machine_code_and_its_kernel_has_some():
    _, _, kernel = _run()
    for one in (_half, _half_of_each):
        (result,) = one.overloads.values()
        assert not result.library.codegen._engine.is_symbol_defined(result.fndesc.llvm_func_name)
    (result,) = kernel.overloads.values()
    assert result.library.codegen._engine.is_symbol_defined(result.fndesc.llvm_func_name)


def test_python_that_calls_a_stage_is_told():
    _run()
    with pytest.raises((TypeError, ValueError)):
        _half(3.0)


def test_what_numba_remembers_changes_nothing_and_ends_with_the_kernel(monkeypatch):
    before = [getattr(owner, name) for owner, name in PARTS]
    drives, total, kernel = _run()
    assert [getattr(owner, name) for owner, name in PARTS] == before
    monkeypatch.setattr(compiled, "remembered_answers", nullcontext)
    plain, plain_total, plain_kernel = _run()
    assert np.array_equal(plain, drives) and plain_total == total
    assert plain_kernel.signatures == kernel.signatures


def test_each_part_is_used_while_a_kernel_compiles(monkeypatch):
    """A version of Numba that asks elsewhere would make a cold start slow without a word."""
    operators, copies = [], []
    find, deepcopy = types.Function.get_call_type, stage_compiler._BlockCopies.deepcopy

    def asked(function, context, args, kws):
        operators.append((function.typing_key, args))
        return find(function, context, args, kws)

    monkeypatch.setattr(types.Function, "get_call_type", asked)
    monkeypatch.setattr(
        stage_compiler._BlockCopies, "deepcopy", lambda self, one: copies.append(one) or deepcopy(self, one)
    )
    _run()
    numbers = [one for one in operators if all(isinstance(kind, types.Number) for kind in one[1]) and one[1]]
    assert numbers and len(numbers) == len(set(numbers)), "one of them was looked for twice"
    assert copies
