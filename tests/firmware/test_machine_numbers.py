"""What machines draw: NumPy's own generators are the oracle."""

from __future__ import annotations

import numpy as np
import pytest
from rigs.tables import every_row

from drive_env.emulator import machine_numbers as of_many
from drive_env.emulator.machine_numbers import machine_numbers


@every_row("few", [0, of_many._FEW])
@every_row("seed", [0, 1, 2**32 - 1, 2**32, 2**40 + 5, 2**96, 2**130 + 17])
@every_row(
    "machines",
    [
        range(40),
        [0],
        [7, 7, 7],  # one machine many times
        [5, 2, 5, 2**31],
        [2**32 - 1, 2**32, 2**70],  # a number of two or three words is stirred in other turns
    ],
)
def test_every_machine_has_the_numbers_of_a_generator_of_its_own(seed, machines, few, monkeypatch):
    monkeypatch.setattr(of_many, "_FEW", few)
    integers, shares = machine_numbers(seed, machines, 9)
    for k, machine in enumerate(machines):
        generator = np.random.default_rng((seed, machine))
        assert integers[k] == generator.integers(1, 2**32)
        assert shares[k].tolist() == generator.random(9).tolist()


@pytest.mark.parametrize(("seed", "machines"), [(-1, [0]), (0, [3, -1])])
def test_what_is_negative_is_refused(seed, machines):
    with pytest.raises(ValueError, match="non-negative"):
        machine_numbers(seed, machines, 1)
