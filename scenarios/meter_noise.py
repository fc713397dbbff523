"""Noise of many meters at once: of each the first standard normal number of ``default_rng([*words, its own])``.

Making half a million generators takes numpy several times as long as their numbers, so that the seeds are mixed here
for all of them together, as ``numpy.random.SeedSequence`` and ``PCG64`` do, whose streams numpy promises to keep. After
M. O'Neill, "Developing a seed_seq alternative" (2015), and "PCG: a family of simple fast space-efficient statistically
good algorithms for random number generation" (2014).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

INIT_A, MULT_A = 0x43B0D7E5, 0x931E8875
INIT_B, MULT_B = 0x8B51F9DD, 0x58F38DED
MIX_L, MIX_R = np.uint32(0xCA01F9DD), np.uint32(0x4973F715)
SHIFT = np.uint32(16)
WORD = 2**32
PCG_MULTIPLIER = 0x2360ED051FC65DA44385DF649FCCF645
N_POOL = 4


def draw_noise(seeds: Sequence[int], own: np.ndarray) -> np.ndarray:
    """Of each ``own`` (n,), uint32, the number ``default_rng([*seeds, own]).standard_normal()``, shape (n,)."""
    bits = np.random.PCG64(0)
    generator = np.random.Generator(bits)
    state = bits.state
    noise = np.empty(len(own))
    for k, words in enumerate(_mix_seeds(seeds, own).tolist()):
        increment = (words[2] << 65 | words[3] << 1 | 1) % 2**128
        start = (words[0] << 64 | words[1]) + increment
        state["state"] = {"state": (start * PCG_MULTIPLIER + increment) % 2**128, "inc": increment}
        bits.state = state
        noise[k] = generator.standard_normal()
    return noise


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
