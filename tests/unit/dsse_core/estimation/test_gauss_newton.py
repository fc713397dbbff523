"""When the step to come is the last one: decided by the steps taken, and by those that can be compared."""

import math

import numpy as np
import pytest

from dsse_core import gauss_newton
from dsse_core.gauss_newton import (
    EVALUATE,
    FINAL,
    LAST_STEP,
    LEAST_RATE,
    MOST_SHARE,
    REST,
    choose_share,
    correct_step,
    next_step,
)


def is_last(largest: float, before: float, with_currents: bool, tolerance: float, change: float = 0.0) -> bool:
    """The step to come is the last one, with J far below its limit."""
    options = {
        "objective": 1.0,
        "change": change,
        "limit": 2.0,
        "tolerance": tolerance,
        "most_steps": 25,
        "coming": 1.0,
    }
    verdict, _, _ = next_step(3, 1.0, True, before, largest, True, with_currents, **options)
    return verdict == FINAL


def ends(*steps: float, with_currents: bool = False, tolerance: float = LAST_STEP) -> int:
    """After how many of ``steps`` the next one is the last; one more than there are: after none of them."""
    before = 0.0
    for count, step in enumerate(steps, 1):
        if is_last(step, before, with_currents, tolerance):
            return count
        before = step
    return len(steps) + 1


def test_nothing_ends_before_a_step_was_taken():
    assert not is_last(math.inf, 0.0, False, math.inf)


def test_one_step_alone_ends_nothing_however_short_unless_it_is_none():
    assert ends(1e-9) == 2
    assert ends(1e-11) == 1


def test_quadratic_convergence_ends_one_step_after_a_short_one():
    assert ends(0.05, 1e-3, 1e-6, 1e-12) == 3


def test_a_warm_start_ends_with_the_third_step_unless_the_second_is_above_what_the_least_rate_allows():
    """Six messages per edge, or eight: steps of random feeders whose loads have moved by 10 % since the last scan."""
    assert pytest.approx(1e-5) == REST / LEAST_RATE**2
    assert ends(4.2e-3, 8.9e-6, 1e-10) == 2  # the third is taken along
    assert ends(5.5e-3, 3.2e-5, 6.8e-9) == 3


def test_slow_convergence_is_not_taken_for_the_end():
    assert ends(*(1e-5 * 0.5**k for k in range(16))) == 17
    assert ends(*(1e-9 * 0.5**k for k in range(16))) == 5  # the first below 1e-10


def test_rounding_does_not_keep_it_from_ending():
    """Steps that shrink to 5e-8 and then no more, as over branches of 1e-8 p.u."""
    assert ends(1e-2, 1e-4, 5e-8, 5e-8, 4e-8) == 3
    assert ends(8e-10, 8.1e-10) == 2  # from the fixed point of a scan before


def test_a_step_that_has_moved_j_much_is_not_the_last_but_one_however_small_its_rate():
    """IEEE 13: 1.9e-5 after 1.2e-2, which moved J by 0.7 of its limit; the next step was 6.1e-6."""
    assert is_last(9e-6, 4e-3, False, LAST_STEP, change=5e-4)  # of a limit of 2
    assert not is_last(3.9e-6, 2e-3, False, LAST_STEP, change=-1.6e-2)


def test_one_small_rate_does_not_promise_that_the_next_one_is_as_small():
    """A grid with gross errors: after the quadratic part bad data set a rate of 0.013."""
    assert ends(1.3e-1, 3.3e-2, 9.1e-5, 1.2e-6, 2.3e-8) > 3


def test_with_current_magnitudes_the_step_to_come_itself_is_what_may_be_left():
    steps = (1e-2, 1e-4, 1e-6, 1e-8)
    assert ends(*steps) == 3
    assert ends(*steps, with_currents=True) == 4


@pytest.mark.parametrize(("tolerance", "count"), [(1e-5, 3), (1e-9, 4)])
def test_a_smaller_tolerance_bounds_the_step_to_come(tolerance, count):
    assert ends(1e-3, 3e-5, 8e-7, 8e-9, tolerance=tolerance) == count


def test_nothing_ends_while_j_lies_beside_its_limit():
    def verdict(objective: float, change: float) -> int:
        options = {"limit": 20.0, "tolerance": LAST_STEP, "most_steps": 25, "coming": 1.0}
        return next_step(3, 1.0, True, 1e-3, 1e-6, True, False, objective=objective, change=change, **options)[0]

    assert (verdict(19.0, 0.05), verdict(21.0, 0.05)) == (FINAL, EVALUATE)
    assert verdict(20.001, -0.002) == gauss_newton.GO_ON
    assert verdict(20.001, -0.0005) == EVALUATE


def test_the_compiled_step_control_says_the_same_as_the_plain_one_of_100000_iterations():
    pytest.importorskip("numba", reason="the radial back end needs numba: pip install 'consensus-dsse[fast]'")
    from dsse_core.radial import iteration as radial_iteration

    rng, count = np.random.default_rng(1), 100_000
    sizes = np.where(rng.random((3, count)) < 0.05, np.inf, 10.0 ** rng.uniform(-12, 7, (3, count)))
    steps, (stepped, known, currents) = rng.integers(0, 30, count), rng.random((3, count)) < 0.7
    share, J = rng.choice([0.5, 1.0], count), 20 + rng.choice([1e-3, 1e-1, 10.0], count) * rng.standard_normal(count)
    before = np.where(rng.random(count) < 0.2, 0.0, 10.0 ** rng.uniform(-12, 1, count))
    change = 10.0 ** rng.uniform(-12, 3, count) * rng.choice([-1, 1], count)
    ends, shares = set(), set()
    products = np.where(rng.random((3, count)) < 0.1, 0.0, 10.0 ** rng.uniform(-4, 0, (3, count)))
    products[2] *= rng.choice([-1, 1], count)
    for k in range(count):
        dva, dvm, largest = sizes[:, k].tolist()
        of_step = float(share[k]), bool(stepped[k]), bool(known[k]), dva, dvm
        assert radial_iteration.correct_step(*of_step) == correct_step(*of_step)
        of_pair = int(steps[k]), bool(currents[k]), float(share[k]), *products[:, k].tolist()
        coming = choose_share(*of_pair)
        assert radial_iteration.choose_share(*of_pair) == coming
        shares.add(coming)
        of_state = (
            int(steps[k]), float(share[k]), bool(stepped[k]), float(before[k]), largest, bool(known[k]),
            bool(currents[k]), float(J[k]), float(change[k]), 20.0, 1e-5, 25, coming,
        )  # fmt: skip
        plain = next_step(*of_state)
        assert radial_iteration.next_step(*of_state) == plain
        ends |= {plain[0], correct_step(*of_step)[0]}
    assert ends == set(range(6))
    assert {1 / MOST_SHARE, 1.0, MOST_SHARE} < shares
