"""Noise of many meters at once: for each the first standard normal number of ``default_rng([*words, its own])``.

numpy takes long for half a million generators, so the seeds of all of them are mixed here together, as
``numpy.random.SeedSequence`` and ``PCG64`` do, whose streams numpy promises to keep. numpy does not promise to keep its
normal numbers, so the layers that they are made in are found by drawing from numpy. After M. O'Neill, "Developing a
seed_seq alternative" (2015), and "PCG: a family of simple fast space-efficient statistically good algorithms for random
number generation" (2014).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

INIT_A, MULT_A = 0x43B0D7E5, 0x931E8875
INIT_B, MULT_B = 0x8B51F9DD, 0x58F38DED
MIX_L, MIX_R = np.uint32(0xCA01F9DD), np.uint32(0x4973F715)
SHIFT = np.uint32(16)
WORD = 2**32
PCG_MULTIPLIER = 0x2360ED051FC65DA44385DF649FCCF645
PCG_INVERSE = pow(PCG_MULTIPLIER, -1, 2**128)
N_POOL = 4
N_ASKED = 1000  # numbers in which numpy must agree
AT_ONCE = 2**14  # meters whose numbers stay in the processor's cache
Pair = tuple[np.ndarray, np.ndarray]
"""The upper and the lower 64 bits of numbers modulo 2^128."""


def draw_noise(seeds: Sequence[int], own: np.ndarray) -> np.ndarray:
    """``default_rng([*seeds, k]).standard_normal()`` for each k of ``own`` (n,), uint32; shape (n,)."""
    parts = [_draw_some(seeds, own[first : first + AT_ONCE]) for first in range(0, len(own), AT_ONCE)]
    return np.concatenate(parts) if parts else np.zeros(0)


def _draw_some(seeds: Sequence[int], own: np.ndarray) -> np.ndarray:
    """``draw_noise`` of at most AT_ONCE meters."""
    words = _mix_seeds(seeds, own)
    state, increment = _seed_streams(words)
    noise, is_known = _read_normals(_output(*_step(*state, *increment)))
    generator = _Generator()
    for k in np.flatnonzero(~is_known).tolist():
        noise[k] = generator.draw(_join(*state, k), _join(*increment, k))
    return noise


class _Generator:
    """numpy's own generator of normal numbers, at a given state."""

    def __init__(self) -> None:
        self._bits = np.random.PCG64(0)
        self._generator = np.random.Generator(self._bits)
        self._state: Any = self._bits.state

    def draw(self, state: int, increment: int) -> float:
        """The first standard normal number after ``state``."""
        self._state["state"] = {"state": state, "inc": increment}
        self._bits.state = self._state
        return float(self._generator.standard_normal())

    def draw_of(self, raw: int) -> float:
        """The standard normal number made of ``raw``, the next 64 bits."""
        return self.draw((raw - 1) * PCG_INVERSE % 2**128, 1)  # one step on, the state is ``raw``, and so is its output


def _read_normals(raw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The normal numbers that numpy makes of 64 bits ``raw`` (n,), and true where those bits suffice, shape (n,) each.

    Marsaglia and Tsang, "The ziggurat method for generating random variables", J. Stat. Softw. 5 (2000): the lowest 8
    bits choose a layer, the next is the sign, 52 more the place in the layer: nearly always below the next one.
    """
    if (layers := _find_layers()) is None:
        return np.zeros(len(raw)), np.zeros(len(raw), dtype=bool)
    width, surely_inside = layers
    layer = (raw & np.uint64(0xFF)).astype(np.intp)
    place = (raw >> np.uint64(9)) & np.uint64(2**52 - 1)
    normal = place.astype(float) * width[layer]
    np.negative(normal, where=(raw & np.uint64(0x100)) != 0, out=normal)
    return normal, place < surely_inside[layer]


@cache
def _find_layers() -> tuple[np.ndarray, np.ndarray] | None:
    """Width over 2^52 of each of the 256 layers, and the place below which a number surely lies in the layer.

    Both are found by drawing from numpy; None where numpy makes its numbers in another way.
    """
    generator = _Generator()
    place = 2**40  # deep inside each layer
    width = np.array([generator.draw_of(place << 9 | layer) / place for layer in range(256)])
    if not (width > 0).all():
        return None
    inside = np.roll(width, 1) / width * (1 - 1e-9)
    inside[1] = 0.0  # the top of the bell
    surely_inside = (inside * 2**52).astype(np.uint64)
    asked = np.random.default_rng(0).integers(0, 2**64, N_ASKED, dtype=np.uint64)
    layer = (asked & np.uint64(0xFF)).astype(np.intp)
    place_of = (asked >> np.uint64(9)) & np.uint64(2**52 - 1)
    sign = np.where(asked & np.uint64(0x100), -1.0, 1.0)
    known = place_of < surely_inside[layer]
    answers = [generator.draw_of(raw) for raw in asked[known].tolist()]
    ours = (sign * (place_of.astype(float) * width[layer]))[known]
    return (width, surely_inside) if ours.tolist() == answers else None


def _seed_streams(words: np.ndarray) -> tuple[Pair, Pair]:
    """State and increment of PCG64 seeded with ``words`` (n, 4), each as upper and lower halves (n,)."""
    one = np.uint64(1)
    increment = words[:, 2] << one | words[:, 3] >> np.uint64(63), words[:, 3] << one | one
    start = _add((words[:, 0], words[:, 1]), increment)
    return _step(*start, *increment), increment


def _step(high: np.ndarray, low: np.ndarray, more_high: np.ndarray, more_low: np.ndarray) -> Pair:
    """``state * PCG_MULTIPLIER + increment`` modulo 2^128."""
    m_high, m_low = np.uint64(PCG_MULTIPLIER >> 64), np.uint64(PCG_MULTIPLIER % 2**64)
    half, lower = np.uint64(32), np.uint64(2**32 - 1)
    a, b = low >> half, low & lower
    c, d = m_low >> half, m_low & lower
    middle = (b * d >> half) + (a * d & lower) + (b * c & lower)
    carried = a * c + (a * d >> half) + (b * c >> half) + (middle >> half)
    return _add((carried + high * m_low + low * m_high, low * m_low), (more_high, more_low))


def _add(one: Pair, other: Pair) -> Pair:
    low = one[1] + other[1]
    return one[0] + other[0] + (low < one[1]), low


def _output(high: np.ndarray, low: np.ndarray) -> np.ndarray:
    """Output of PCG64 at a state: the exclusive or of its halves, turned right by the upper 6 bits."""
    turn, mixed = high >> np.uint64(58), high ^ low
    output: np.ndarray = mixed >> turn | mixed << (-turn & np.uint64(63))
    return output


def _join(high: np.ndarray, low: np.ndarray, k: int) -> int:
    return int(high[k]) << 64 | int(low[k])


def _mix_seeds(seeds: Sequence[int], own: np.ndarray) -> np.ndarray:
    """``SeedSequence([*seeds, own]).generate_state(4, np.uint64)`` of each ``own``, shape (n, 4)."""
    entropy = [np.full(len(own), word, dtype=np.uint32) for seed in seeds for word in _words_of(seed)] + [own]
    entropy += [np.zeros(len(own), dtype=np.uint32)] * (N_POOL - len(entropy))
    factor = INIT_A

    def scramble(value: np.ndarray, multiplier: int) -> np.ndarray:
        nonlocal factor
        value = value ^ np.uint32(factor)
        factor = factor * multiplier % WORD
        value = value * np.uint32(factor)
        scrambled: np.ndarray = value ^ (value >> SHIFT)
        return scrambled

    def mix(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        mixed: np.ndarray = MIX_L * one - MIX_R * other
        result: np.ndarray = mixed ^ (mixed >> SHIFT)
        return result

    pool = [scramble(word, MULT_A) for word in entropy[:N_POOL]]
    for i in range(N_POOL):
        for k in range(N_POOL):
            if i != k:
                pool[k] = mix(pool[k], scramble(pool[i], MULT_A))
    for word in entropy[N_POOL:]:
        for k in range(N_POOL):
            pool[k] = mix(pool[k], scramble(word, MULT_A))
    factor = INIT_B
    halves = [scramble(pool[i % N_POOL], MULT_B).astype(np.uint64) for i in range(8)]
    return np.stack([low | high << np.uint64(32) for low, high in zip(halves[::2], halves[1::2], strict=True)], axis=1)


def _words_of(seed: int) -> list[int]:
    """The 32-bit words of a seed, the lowest first."""
    words = [seed % WORD]
    while seed := seed // WORD:
        words.append(seed % WORD)
    return words
