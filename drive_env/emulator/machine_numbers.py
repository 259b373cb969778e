"""Random numbers for thousands of machines at once, equal to those of NumPy's generator for each machine.

Machine k of a seed has a generator of its own, `numpy.random.default_rng((seed, k))`, so that it is the same machine in
every set. Creating one takes some 30 us; the same arithmetic on arrays, one element per machine, takes 2 us each, plus
3 ms in all. `SeedSequence` (M. E. O'Neill, "Developing a seed_seq alternative", 2015) and PCG64 (XSL RR 128/64, "PCG: a
family of simple fast space-efficient statistically good algorithms for random number generation", 2014) are as NumPy
has them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from mechanics.arrays import Floats

_Halves = NDArray[np.uint32]
_Words = NDArray[np.uint64]
_Wide = tuple[_Words, _Words]  # 128 bits: upper and lower half

_FEW = 100  # up to this number NumPy's generators are faster
_POOL = 4  # words in the pool of SeedSequence
_FIRST_IN, _FACTOR_IN = 0x43B0D7E5, 0x931E8875
_FIRST_OUT, _FACTOR_OUT = 0x8B51F9DD, 0x58F38DED
_MIX_LEFT, _MIX_RIGHT = np.uint32(0xCA01F9DD), np.uint32(0x4973F715)
_PCG_FACTOR = (np.uint64(0x2360ED051FC65DA4), np.uint64(0x4385DF649FCCF645))
_HALF, _LOW_HALF = np.uint64(32), np.uint64(2**32 - 1)


def machine_numbers(seed: int, machines: Sequence[int], count: int) -> tuple[Floats, Floats]:
    """Return an integer of 1...2^32 - 1 for each machine, shape (n,), and `count` shares of 0...1, shape (n, count).

    For machine k they are `integers(1, 2**32)` and then `random(count)` of `numpy.random.default_rng((seed, k))`.

    Args:
        seed: The set's seed, 0 or more.
        machines: Their numbers, 0 or more.
        count: Number of shares for each.

    Raises:
        ValueError: For a negative seed or number.
    """
    if len(set(machines)) < len(machines):
        distinct, place = np.unique(np.array(machines, object), return_inverse=True)
        integers, shares = machine_numbers(seed, distinct.tolist(), count)
        return integers[place], shares[place]
    integers, shares = np.empty(len(machines)), np.empty((len(machines), count))
    # Numbers of two words are left to `default_rng`, and so are negative ones, which it refuses.
    short = np.array([len(machines) >= _FEW and seed >= 0 and 0 <= number < 2**32 for number in machines], bool)
    if np.any(short):
        words = [np.full(int(short.sum()), word, np.uint32) for word in _halves(seed)]
        numbers = np.array([number for number, plain in zip(machines, short, strict=True) if plain], np.uint32)
        stream = _pcg64(*_seeds([*words, numbers]))
        first = next(stream) & _LOW_HALF
        # Lemire's method from 32 bits to 1...2^32 - 1, which rejects only 0.
        integers[short] = 1 + (first * np.uint64(2**32 - 1) >> _HALF)
        for k in range(count):
            shares[short, k] = (next(stream) >> np.uint64(11)) * 2.0**-53
        short[np.flatnonzero(short)[first == 0]] = False
    for k in np.flatnonzero(~short).tolist():
        generator = np.random.default_rng((seed, machines[k]))
        integers[k], shares[k] = generator.integers(1, 2**32), generator.random(count)
    return integers, shares


def _halves(number: int) -> list[int]:
    """Return a number in pieces of 32 bits, the lowest first, at least one."""
    return [number >> shift & 0xFFFFFFFF for shift in range(0, max(number.bit_length(), 1), 32)]


def _seeds(entropy: list[_Halves]) -> tuple[_Wide, _Wide]:
    """Return state and increment of PCG64 that `SeedSequence` makes of the pieces of a seed, each of shape (n,)."""
    factor = _FIRST_IN

    def stirred(value: _Halves) -> _Halves:
        nonlocal factor
        value = value ^ np.uint32(factor)
        factor = factor * _FACTOR_IN & 0xFFFFFFFF
        value = value * np.uint32(factor)
        return value ^ value >> np.uint32(16)

    def mixed(left: _Halves, right: _Halves) -> _Halves:
        value: _Halves = left * _MIX_LEFT - right * _MIX_RIGHT
        return value ^ value >> np.uint32(16)

    nothing = np.zeros_like(entropy[0])
    pool = [stirred(entropy[k] if k < len(entropy) else nothing) for k in range(_POOL)]
    for source in range(_POOL):
        for k in range(_POOL):
            if k != source:
                pool[k] = mixed(pool[k], stirred(pool[source]))
    for piece in entropy[_POOL:]:
        for k in range(_POOL):
            pool[k] = mixed(pool[k], stirred(piece))
    out, factor = [], _FIRST_OUT
    for k in range(8):
        value = pool[k % _POOL] ^ np.uint32(factor)
        factor = factor * _FACTOR_OUT & 0xFFFFFFFF
        value = value * np.uint32(factor)
        out.append((value ^ value >> np.uint32(16)).astype(np.uint64))
    words = [low | high << _HALF for low, high in zip(out[::2], out[1::2], strict=True)]
    return (words[0], words[1]), (words[2], words[3])


def _pcg64(seed: _Wide, increment: _Wide) -> Iterator[_Words]:
    """Yield the generators' 64-bit numbers one after the other, each of shape (n,)."""
    one = np.uint64(1)
    odd = increment[0] << one | increment[1] >> np.uint64(63), increment[1] << one | one
    # A step from 0 gives the increment.
    state = _step(_sum(odd, seed), odd)
    while True:
        state = _step(state, odd)
        turn: _Words = state[0] >> np.uint64(58)
        folded: _Words = state[0] ^ state[1]
        turned: _Words = folded >> turn | folded << (np.uint64(64) - turn & np.uint64(63))
        yield turned


def _step(state: _Wide, increment: _Wide) -> _Wide:
    high, low = state
    factor_high, factor_low = _PCG_FACTOR
    product = _upper(low, factor_low) + high * factor_low + low * factor_high, low * factor_low
    return _sum(product, increment)


def _sum(one: _Wide, other: _Wide) -> _Wide:
    low = one[1] + other[1]
    return one[0] + other[0] + (low < one[1]), low


def _upper(one: _Words, other: np.uint64) -> _Words:
    """Return the upper 64 bits of a product."""
    a, b, c, d = one >> _HALF, one & _LOW_HALF, other >> _HALF, other & _LOW_HALF
    middle = a * d + (b * d >> _HALF)
    product: _Words = a * c + (middle >> _HALF) + (b * c + (middle & _LOW_HALF) >> _HALF)
    return product
