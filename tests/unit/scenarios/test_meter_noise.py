"""The noise of many meters at once is that of one generator per meter."""

import numpy as np
import pytest

from scenarios.meter_noise import draw_noise


@pytest.mark.parametrize("seeds", [[], [0, 1], [5, 3], [2**32, 1], [2**40 + 7, 2**33], [2**100 + 1, 1]])
def test_every_meter_reads_what_a_generator_of_its_own_would_give(seeds: list[int]) -> None:
    own = np.random.default_rng(4).integers(0, 2**32, size=1000, dtype=np.uint32)
    own[:2] = 0, 2**32 - 1
    expected = [np.random.default_rng([*seeds, int(word)]).standard_normal() for word in own]
    assert draw_noise(seeds, own).tolist() == expected
