"""The compiled iteration on a tree comes to what ``decide`` says: k, share, use of currents, restart, end, removals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dsse_core.errors import DsseError, EstimationDivergedError, InvalidInputError
from dsse_core.estimation import decision as verdict
from dsse_core.estimation import radial
from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.estimation.decision import Decision, Memory, Totals, add_totals, decide
from dsse_core.estimation.estimator import estimate_state
from dsse_core.estimation.residuals import CONFIDENCE, chi_square_limit
from dsse_core.gauss_newton import (
    FARTHEST_DVM,
    FULL_STEPS,
    LARGEST_STEP,
    MAX_DVA,
    MAX_DVM,
    MOST_SHARE,
    MOST_STEPS,
    choose_share,
)
from tests.support.grids import MeterShares, make_grid, with_gross_errors
from tests.support.loaded_feeders import make_outvoted_feeder

LIMIT = chi_square_limit(9, CONFIDENCE)


def totals(step: float = 0.0, **changes: object) -> Totals:
    return Totals(**{"degrees_of_freedom": 9, "dva": step, "areas": 1} | changes)


def decisions(*steps: float, memory: Memory = Memory()) -> list[str]:  # noqa: B008 - frozen
    """The verdicts on states that steps of these sizes have led to."""
    decided = []
    for step in steps:
        memory, found = decide(memory, totals(step))
        decided.append(str(found))
    return decided


def test_a_half_step_is_not_made_longer_by_shortening_it():
    memory = Memory(steps=FULL_STEPS + 1, share=0.5, stepped=True)
    assert decide(memory, totals(1.5 * MAX_DVA))[1].decision is Decision.STEP
    assert decide(memory, totals(4 * MAX_DVA))[1] == verdict.Verdict(Decision.SHORTEN, 0.25)


def test_a_late_step_that_turns_back_is_halved_and_gives_no_rate():
    last_full = Memory(steps=FULL_STEPS, stepped=True, square_before=1e-6)
    memory, decided = decide(last_full, totals(1e-3, square=1e-6, turn=-1e-6))
    assert (decided.share, memory.before) == (0.5, 0.0)
    early = replace(last_full, steps=FULL_STEPS - 1)
    assert decide(early, totals(1e-3, square=1e-6, turn=-1e-6))[1].share == 1.0


def test_shares_are_those_that_take_the_slowest_part_of_the_error_away():
    """Steps d_2 = (1 - share_1 m) d_1 along one line: the next share is 1 / m."""
    for share, m in ((1.0, 0.25), (1.0, 2.0), (0.5, 4.0), (4.0, 0.5)):
        rest = 1 - share * m
        assert choose_share(5, True, share, 1.0, rest * rest, rest) == 1 / m
    assert choose_share(5, True, 1.0, 1.0, 1.0, 1.0) == MOST_SHARE
    assert choose_share(5, True, 1.0, 1.0, 4.0, 2.0) == MOST_SHARE
    assert choose_share(5, True, 1.0, 1.0, 1e4, -1e2) == 1 / MOST_SHARE
    assert choose_share(5, True, 1.0, 1.0, 1e-3, 0.0) == 1.0


def test_a_step_that_was_shortened_is_compared_with_no_other():
    memory = Memory(steps=5, stepped=True, uses_currents=True, square_before=1.0)
    memory, decided = decide(memory, totals(4 * MAX_DVA, square=9.0, turn=-3.0))
    assert (decided.decision, memory.square_before) == (Decision.SHORTEN, 0.0)
    assert decide(memory, totals())[1].share == 1.0


def test_a_step_beyond_all_states_begins_anew_at_the_flat_start_and_then_ends():
    memory, decided = decide(Memory(removed=("a",), steps=3, stepped=True), totals(2 * LARGEST_STEP))
    assert (decided.decision, memory) == (Decision.ANEW, Memory(removed=("a",), from_flat_start=True, spent=3))
    _, decided = decide(Memory(steps=3, stepped=True, from_flat_start=True), totals(float("inf")))
    assert decided == verdict.Verdict(Decision.FINAL, reason=verdict.DIVERGED)


def test_nothing_is_removed_where_the_last_step_has_brought_j_below_the_limit():
    memory, decided = decide(
        Memory(steps=3, before=1e-3, stepped=True, objective=2 * LIMIT), totals(1e-6, objective=2 * LIMIT)
    )
    assert decided.decision is Decision.EVALUATE
    worst = (("p_flow@1:1-2", 5.0),)
    assert decide(memory, totals(1e-9, objective=LIMIT / 2, worst=worst))[1].decision is Decision.FINAL
    assert decide(memory, totals(1e-9, objective=2 * LIMIT, worst=worst))[1].decision is Decision.ANEW


def test_without_an_estimate_the_meter_that_was_taken_out_last_comes_back_and_stays():
    """Once: the estimate before stands, whatever its J is."""
    without = Memory(removed=("a", "b"), steps=3, stepped=True, from_flat_start=True)
    for lost in (totals(2 * LARGEST_STEP), totals(failed=("a1",))):
        memory, decided = decide(without, lost)
        assert (decided.decision, memory) == (Decision.ANEW, Memory(removed=("a",), kept="b", spent=3))
    memory = replace(memory, steps=3, before=1e-3, stepped=True, objective=2 * LIMIT)
    assert decide(memory, totals(1e-6, objective=2 * LIMIT))[1] == verdict.Verdict(Decision.FINAL, with_step=True)
    memory, decided = decide(memory, totals(2 * LARGEST_STEP))
    kept = Memory(removed=("a",), kept="b", from_flat_start=True, spent=6)
    assert (decided.decision, memory) == (Decision.ANEW, kept)
    assert decide(memory, totals(2 * LARGEST_STEP))[1] == verdict.Verdict(Decision.FINAL, reason=verdict.DIVERGED)


def test_without_a_meter_the_start_of_the_scan_is_tried_first():
    memory = Memory(steps=3, before=1e-3, stepped=True, from_flat_start=True, evaluating=True)
    memory, _ = decide(memory, totals(1e-9, objective=2 * LIMIT, worst=(("a", 5.0),)))
    assert memory == Memory(removed=("a",), tied=((),), spent=3)


def test_meters_that_equal_the_worst_are_remembered_with_it_and_forgotten_where_it_comes_back():
    sides = [Totals(worst=(("b", 5.0),), tied=(("c", 5.0),)), Totals(worst=(("a", 5.0 + 1e-9),), tied=(("d", 6.0),))]
    of_all = add_totals([totals(1e-9, objective=2 * LIMIT), *sides])
    memory, _ = decide(Memory(removed=("z",), tied=((),), evaluating=True), of_all)
    assert (memory.removed, memory.tied) == (("z", "a"), ((), ("b", "c")))
    anew, _ = decide(replace(memory, steps=3, stepped=True), totals(2 * LARGEST_STEP))
    assert anew.tied == memory.tied
    back, _ = decide(replace(anew, steps=3, stepped=True), totals(2 * LARGEST_STEP))
    assert (back.removed, back.tied, back.kept) == (("z",), ((),), "a")


def test_a_magnitude_that_no_start_can_lead_to_ends_a_start_at_once():
    far = totals(dvm=1.01 * FARTHEST_DVM)
    memory, decided = decide(Memory(steps=1, stepped=True), far)
    assert (decided.decision, memory) == (Decision.ANEW, Memory(from_flat_start=True, spent=1))
    _, decided = decide(replace(memory, steps=1, stepped=True), far)
    assert decided == verdict.Verdict(Decision.FINAL, reason=verdict.OUT_OF_REACH)
    assert decide(Memory(steps=1, stepped=True), totals(dvm=0.99 * FARTHEST_DVM))[1].decision is Decision.SHORTEN


def evaluate(memory: Memory, steps: int) -> tuple[Memory, verdict.Verdict]:
    """The verdict on suspects after so many steps of a start."""
    suspect = (f"m{len(memory.removed)}", 5.0)
    return decide(replace(memory, steps=steps, evaluating=True), totals(objective=2 * LIMIT, worst=(suspect,)))


def test_starts_that_end_well_are_begun_for_as_many_bad_meters_as_there_are():
    memory = Memory()
    for k in range(200):
        memory, decided = evaluate(memory, FULL_STEPS)
        assert decided.decision is Decision.ANEW, k
    assert len(memory.removed) == 200


def test_a_scan_whose_starts_end_badly_has_steps_for_two_of_them():
    memory, decided = evaluate(Memory(), 2 * MOST_STEPS)
    assert decided.decision is Decision.ANEW
    memory, decided = evaluate(memory, 2 * MOST_STEPS + FULL_STEPS + 1)
    assert decided == verdict.Verdict(Decision.FINAL, reason=verdict.STEPS_USED_UP)
    assert memory.removed == ("m0",)


def draw_grid(seed: int):
    rng = np.random.default_rng([seed, 8])
    shares = MeterShares(
        voltage=float(rng.choice([0.1, 0.5])),
        angle=float(rng.choice([0, 0.3])),
        flow=float(rng.choice([0.6, 1.0])),
        current=float(rng.choice([0, 0.3, 0.6])),
    )
    grid = make_grid(
        seed,
        n_bus=int(rng.integers(3, 40)),
        n_area=1,
        chain=rng.random(),
        decades=float(rng.choice([0, 1])),
        loops=0,
        transformers=float(rng.choice([0, 0.3])),
        short=None,
        slack_at_root=True,
        shares=shares,
    )
    return with_gross_errors(rng, grid) if rng.random() < 0.7 else grid


def outcome(network, measurements, backend: str):
    """All that has been decided: how often, what is taken out, how it ends."""
    try:
        report = process_bad_data(network, measurements, backend=backend)
    except EstimationDivergedError as error:
        return error.reason, error.iterations
    removed = [removed.measurement.meter.id for removed in report.removed]
    memory = report.result.memory
    return removed, report.result.iterations, memory.from_flat_start, memory.spent + memory.steps, report.detected


@pytest.mark.slow
@pytest.mark.random_cases(few=10, long=25, many=1000)
def test_the_compiled_iteration_decides_the_same(random_seed):
    pytest.importorskip("numba", reason="the radial back end needs numba: pip install 'consensus-dsse[fast]'")
    grid = draw_grid(random_seed)
    try:
        compiled = outcome(grid.network, grid.measurements, "radial")
    except (InvalidInputError, DsseError):
        pytest.skip("the tree cannot serve, or the state is not observable")
    assert compiled == outcome(grid.network, grid.measurements, "sparse")


def test_the_compiled_iteration_rests_on_the_same_estimate_where_a_removal_diverges():
    pytest.importorskip("numba", reason="the radial back end needs numba: pip install 'consensus-dsse[fast]'")
    feeder = make_outvoted_feeder()
    compiled, sparse = (process_bad_data(feeder.network, feeder.measurements, backend=b) for b in ("radial", "sparse"))
    assert (compiled.result.memory.kept, compiled.suspect.reason) == ("vm@3", "diverges")
    np.testing.assert_allclose(compiled.result.vm, sparse.result.vm, atol=1e-9)
    assert sparse.result.memory.kept == "vm@3"


def test_it_begins_anew_after_as_many_steps(monkeypatch, backend):
    """From a start that is far off, the flat start needs as many steps as it does alone."""
    grid = draw_grid(1)
    n = len(grid.network.buses)
    alone = estimate_state(grid.network, grid.measurements, backend=backend)
    for module in (verdict, radial):
        monkeypatch.setattr(module, "MOST_STEPS", alone.iterations)
    start = (np.full(n, 1 + 2 * MAX_DVM), np.zeros(n))
    begun = estimate_state(grid.network, grid.measurements, start=start, backend=backend)
    assert begun.memory.from_flat_start
    assert begun.iterations == alone.iterations
    np.testing.assert_allclose(begun.vm, alone.vm, atol=1e-9)
