"""Values that a file or ``--set`` may hold by their type, and with which nothing can be computed."""

from __future__ import annotations

import math

import pytest

from coordinator.lab.evaluation.evaluation import choose_scenario
from dsse_core.errors import InvalidInputError
from dsse_core.limits import LARGEST_SEED
from scenarios.scenario import load_scenario


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("seed", LARGEST_SEED + 1, "seed: must be less than or equal to 9223372036854775807"),
        ("run.beat_s", 1e-300, "run.beat_s: must be greater than or equal to 0.001"),
        ("measurements.floor_kva", 1e308, "measurements.floor_kva: 1e+308 kVA is 1e+304 p.u. on base_mva 10; it"),
        (
            "measurements.floor_kva",
            5e-324,
            "measurements.floor_kva: 4.94066e-324 kVA is 0 p.u. on base_mva 10; it",
        ),
        ("version", True, "version: must be the integer 1, found True"),
        ("version", 1.0, "version: must be the integer 1, found 1.0"),
    ],
)
def test_a_value_that_nothing_can_be_computed_with_is_not_sound(key: str, value: object, message: str):
    with pytest.raises(InvalidInputError) as error:
        load_scenario("ieee33", changes={key: value})
    assert message in str(error.value)


def test_an_integer_of_more_digits_than_python_prints_is_no_traceback():
    with pytest.raises(InvalidInputError) as error:
        load_scenario("ieee33", changes={"seed": int("f" * 5000, 16)})
    assert "seed: must be less than or equal to 9223372036854775807, found an integer of too many digits" in str(
        error.value
    )


def test_a_gross_error_beyond_all_numbers_is_not_read_by_any_meter():
    wrong = [{"meter": "vm@1", "sigmas": -1e308}]
    with pytest.raises(InvalidInputError) as error:
        load_scenario("ieee33", changes={"telemetry.gross_error": wrong})
    assert "telemetry.gross_error[1].sigmas: must be greater than or equal to -1000000000" in str(error.value)


def test_a_key_of_twenty_thousand_parts_takes_no_work():
    with pytest.raises(InvalidInputError) as error:
        load_scenario("ieee33", changes={"x" + ".x" * 20_000: 1})
    (problem,) = error.value.problems
    assert problem.endswith("is a key of 20,001 parts joined by dots, the limit is 8")
    assert len(problem) < 200


@pytest.mark.parametrize("seed", [-1, LARGEST_SEED + 1])
def test_a_seed_beyond_the_integers_of_a_file_is_not_taken_by_a_call(seed: int):
    with pytest.raises(InvalidInputError, match="must be an integer from 0 to 9223372036854775807"):
        choose_scenario("ieee33", seed=seed)


def test_a_floor_at_the_limits_of_standard_deviations_is_taken():
    assert math.isclose(load_scenario("ieee33", changes={"measurements.floor_kva": 1e-4}).sigma_rule.floor, 1e-8)
