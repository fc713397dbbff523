"""Which estimates no grid can be in: they are not published, and an iteration that ends there begins anew."""

from dataclasses import replace

import numpy as np
import pytest

from agents.strategies.interface import LARGEST_VM, Estimate
from dsse_core.gauss_newton import REST

THREE = np.ones(3)
SOUND = Estimate(
    vm=THREE,
    va=0.0 * THREE,
    sigma_vm=0.001 * THREE,
    sigma_va=0.001 * THREE,
    referenced=True,
    objective=1.0,
    degrees_of_freedom=1,
    removed=(),
    critical=(),
    checked=True,
)
UNTURNED = 0.0 * THREE
TURNED = np.radians([0.0, 179.0, -179.0])  # by transformers, counted up to half a turn


def test_a_sound_estimate_is_within_reason_and_may_be_turned_against_its_reference():
    assert SOUND.is_reasonable(UNTURNED)
    assert replace(SOUND, va=UNTURNED + 6.5).is_reasonable(UNTURNED)


def test_what_transformers_turn_is_no_reason_to_reject_an_estimate():
    assert replace(SOUND, va=TURNED - 0.1).is_reasonable(TURNED)


@pytest.mark.parametrize(
    "changes",
    [
        {"va": np.array([0.0, 0.01, 2 * np.pi])},
        {"va": np.array([0.0, np.nan, 0.0])},
        {"vm": np.array([1.0, -1.0, 1.0])},
        {"vm": np.array([1.0, 0.9 * REST, 1.0])},
        {"vm": np.array([1.0, 1.1 * LARGEST_VM, 1.0])},
        {"sigma_vm": np.array([0.001, np.inf, 0.001])},
        {"objective": np.nan},
    ],
    ids=[
        "a full turn off",
        "no angle",
        "negative",
        "not known from 0",
        "far too high",
        "known to infinity",
        "no objective",
    ],
)
def test_an_estimate_that_no_grid_can_be_in_is_rejected(changes):
    assert not replace(SOUND, **changes).is_reasonable(UNTURNED)


def test_a_bus_that_is_a_full_turn_off_is_found_behind_transformers_too():
    assert not replace(SOUND, va=TURNED - np.array([0.0, 0.0, 2 * np.pi])).is_reasonable(TURNED)
