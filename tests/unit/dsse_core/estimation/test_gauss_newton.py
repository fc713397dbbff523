"""When the step to come is the last one: decided by the steps taken, and by those that can be compared."""

import math

import pytest

from dsse_core.gauss_newton import LAST_STEP, LEAST_RATE, REST, is_last


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
    assert pytest.approx(2e-5) == REST / LEAST_RATE**2
    assert ends(4.2e-3, 8.9e-6, 1e-10) == 2  # the third is taken along
    assert ends(5.5e-3, 3.2e-5, 6.8e-9) == 3


def test_slow_convergence_is_not_taken_for_the_end():
    assert ends(*(1e-5 * 0.5**k for k in range(16))) == 17
    assert ends(*(1e-9 * 0.5**k for k in range(16))) == 5  # the first below 1e-10


def test_rounding_does_not_keep_it_from_ending():
    """Steps that shrink to 5e-8 and then no more, as over branches of 1e-8 p.u."""
    assert ends(1e-2, 1e-4, 5e-8, 5e-8, 4e-8) == 3


def test_one_small_rate_does_not_promise_that_the_next_one_is_as_small():
    """A grid with gross errors: after the quadratic part bad data set a rate of 0.013."""
    assert ends(1.3e-1, 3.3e-2, 9.1e-5, 1.2e-6, 2.3e-8) > 3


def test_with_current_magnitudes_the_step_to_come_itself_is_what_may_be_left():
    steps = (1e-2, 1e-4, 1e-6, 1e-8)
    assert ends(*steps) == 3
    assert ends(*steps, with_currents=True) == 4


@pytest.mark.parametrize(("tolerance", "count"), [(1e-5, 3), (1e-9, 4)])
def test_a_smaller_tolerance_bounds_the_step_to_come(tolerance, count):
    assert ends(1e-3, 3e-5, 1e-6, 1e-8, tolerance=tolerance) == count


def test_the_compiled_rule_is_the_same():
    pytest.importorskip("numba", reason="the radial back end needs numba: pip install 'consensus-dsse[fast]'")
    from dsse_core.radial import iteration as radial_iteration

    sizes = [10.0**k for k in range(-12, 0)]
    cases = [(s, b, c, t) for s in sizes for b in (0.0, *sizes) for c in (False, True) for t in (1e-5, 1e-9)]
    assert [radial_iteration.is_last(*case) for case in cases] == [is_last(*case) for case in cases]
