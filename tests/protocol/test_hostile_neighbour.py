"""A neighbour that says anything the format allows: nothing falls over, and its end heals everything."""

from __future__ import annotations

import itertools
from dataclasses import fields, replace

import numpy as np
import pytest
from simulated_bus import SimulatedBus, area_files_of

from agents.messages import Header, Incarnation, LoadMessage, TallyMessage, decode, encode
from agents.refusals import find_unreasonable
from agents.strategies import bad_data_tree
from agents.strategies.interface import Estimate
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry

HOSTILE = (0.0, -1.0, 1e-300, 1e-9, 1e3, 1e9, 1e17, 1e300, -1e300)
UNTOUCHED = ("header", "bus", "kind")


def spoil(message, rng: np.random.Generator):
    """``message`` with some of its numbers, flags and texts replaced; header and place stay."""
    changes = {}
    for field in fields(message):
        value = getattr(message, field.name)
        if field.name in UNTOUCHED or rng.random() < 0.5:
            continue
        if isinstance(value, bool):
            changes[field.name] = not value
        elif isinstance(value, float):
            changes[field.name] = float(rng.choice(HOSTILE))
        elif isinstance(value, int):
            changes[field.name] = int(rng.choice([0, 1, 10**6, 2**52]))
        elif isinstance(value, tuple) and value and isinstance(value[0], float):
            changes[field.name] = tuple(float(rng.choice([v, *HOSTILE])) for v in value)
        elif isinstance(value, tuple) and field.name == "decisions":
            changes[field.name] = ("vm@1", f"made-up@{rng.integers(1000)}")
    return replace(message, **changes)


@pytest.mark.random_cases(few=2, many=60)
@pytest.mark.parametrize("strategy", ["information", "angle-offset", "admm"])
def test_whatever_a_neighbour_says_states_stay_finite_and_recover_when_it_is_sane(strategy, random_seed):
    rng = np.random.default_rng(random_seed)
    scenario = load_scenario("ieee33")
    telemetry = make_telemetry(scenario).by_area
    files = area_files_of(scenario, strategy=strategy)
    bus = SimulatedBus(files, telemetry)
    lying = True
    honest = bus.deliver

    def deliver(sender: str, receiver: str, payload: bytes) -> None:
        if lying and sender == "area2":
            message = spoil(decode(payload), rng)
            header: Header = message.header
            payload = encode(replace(message, header=replace(header, scan=int(rng.choice([header.scan, 0, 2**40])))))
        honest(sender, receiver, payload)

    bus.deliver = deliver
    for _ in range(10):
        bus.run(0.02)
        for state in bus.states.values():
            assert np.isfinite([*state.vm, *state.va, *state.sigma_vm, *state.sigma_va, state.objective]).all()
    lying = False
    bus.kill("area2")
    bus.start("area2")
    bus.send_telemetry("area2")
    bus.run_until_settled()
    fresh = SimulatedBus(files, telemetry)
    fresh.run_until_settled()
    for name, state in bus.states.items():
        np.testing.assert_allclose(state.vm, fresh.states[name].vm, atol=1e-7)
        np.testing.assert_allclose(state.va, fresh.states[name].va, atol=1e-7)


def test_meters_that_a_neighbour_makes_up_do_not_keep_the_search_for_bad_data_going_for_ever(monkeypatch):
    monkeypatch.setattr(bad_data_tree, "MAX_DECISIONS", 12)
    scenario = load_scenario("ieee33")
    bus = SimulatedBus(area_files_of(scenario, strategy="information"), make_telemetry(scenario).by_area)
    honest, made_up = bus.deliver, itertools.count()
    longest = 0

    def deliver(sender: str, receiver: str, payload: bytes) -> None:
        nonlocal longest
        message = decode(payload)
        if isinstance(message, TallyMessage):
            longest = max(longest, len(message.decisions))
            assert longest <= 12
            if message.settled and sender == "area2":
                bad = {"objective": 1e9, "worst": (f"made-up@{next(made_up)}",), "normalized": (1e3,)}
                payload = encode(replace(message, **bad))
        honest(sender, receiver, payload)

    bus.deliver = deliver
    bus.run_until_settled()
    assert longest == 12
    bus.run(5.0)
    assert longest == 12
    assert all(state.checked for state in bus.states.values())
    assert {len(state.removed) for state in bus.states.values()} == {0}


@pytest.mark.parametrize("names", [("m",) * (bad_data_tree.MAX_DECISIONS + 1), ("m" * 999,) * 30])
def test_more_names_than_a_message_can_pass_on_are_refused(names):
    tally = TallyMessage(
        Header("run", "area2", Incarnation(1, 1), 1, 1, 0.0), 6, (), True, True, (), (), 1.0, 1, 0, (), (), ()
    )
    assert find_unreasonable(tally) == ""
    assert find_unreasonable(replace(tally, decisions=names)) == "too many names"
    assert find_unreasonable(replace(tally, worst=names, normalized=(1.0,) * len(names))) == "too many names"


def test_a_state_with_a_bus_that_is_full_turns_off_is_none_although_it_solves_the_equations():
    ones, zeros = np.ones(3), np.zeros(3)
    sound = Estimate(ones, zeros, ones, ones, True, 0.0, 1, (), ())
    assert sound.is_reasonable(zeros)
    assert replace(sound, va=zeros + 6.5).is_reasonable(zeros), "the whole area may be turned against its reference"
    assert not replace(sound, va=np.array([0.0, 0.01, 2 * np.pi])).is_reasonable(zeros)
    turned = np.array([0.0, np.radians(179), np.radians(-179)])  # by transformers, counted up to half a turn
    assert replace(sound, va=turned - 0.1).is_reasonable(turned)
    assert not replace(sound, va=turned - np.array([0.0, 0.0, 2 * np.pi])).is_reasonable(turned)


def test_a_lie_about_the_uncertainty_of_a_load_is_corrected_on_the_far_side_too():
    scenario = load_scenario("ieee33")
    telemetry = make_telemetry(scenario).by_area
    bus, fresh = (SimulatedBus(area_files_of(scenario, strategy="angle-offset"), telemetry) for _ in range(2))
    honest = bus.deliver

    def deliver(sender: str, receiver: str, payload: bytes) -> None:
        message = decode(payload)
        if isinstance(message, LoadMessage) and sender == "area2":
            payload = encode(replace(message, sigma=10.0))
        honest(sender, receiver, payload)

    bus.deliver = deliver
    bus.run_until_settled()
    fresh.run_until_settled()
    assert max(abs(np.subtract(bus.states["area3"].vm, fresh.states["area3"].vm))) > 1e-7
    bus.deliver = honest
    bus.kill("area2")
    bus.start("area2")
    bus.run_until_settled()
    np.testing.assert_allclose(bus.states["area3"].vm, fresh.states["area3"].vm, atol=1e-9)
