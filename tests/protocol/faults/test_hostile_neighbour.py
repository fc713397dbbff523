"""A neighbour that says anything the format allows: nothing falls over, and its end heals everything."""

from __future__ import annotations

import itertools
from dataclasses import fields, replace

import numpy as np
import pytest

from agents.messages.packing import Header, Incarnation, LoadMessage, UpMessage, decode, encode
from agents.peers.rejections import FAR_SCAN, Rejections
from agents.protocol.events import Received
from dsse_core.estimation import decision as verdict
from dsse_core.estimation.decision import MOST_NAMED, Totals, add_totals
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.levels import further
from tests.support.simulated_bus import SimulatedBus, area_files_of

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
        elif isinstance(value, Totals):
            named = ("vm@1", f"made-up@{rng.integers(1000)}")
            worst = tuple((name, float(rng.choice(HOSTILE))) for name in named)
            sizes = {name: float(rng.choice(HOSTILE)) for name in ("objective", "dvm", "dva")}
            changes[field.name] = replace(value, worst=worst, areas=int(rng.choice([0, 1, 2**52])), **sizes)
    return replace(message, **changes)


@pytest.mark.random_cases(few=1, long=2, many=60)
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
    monkeypatch.setattr(verdict, "MOST_REMOVED", 12)
    scenario = load_scenario("ieee33")
    bus = SimulatedBus(area_files_of(scenario, strategy="information"), make_telemetry(scenario).by_area)
    honest, made_up = bus.deliver, itertools.count()

    def deliver(sender: str, receiver: str, payload: bytes) -> None:
        message = decode(payload)
        if isinstance(message, UpMessage) and sender == "area2":
            bad = replace(message.totals, objective=1e9, worst=((f"made-up@{next(made_up)}", 1e3),))
            payload = encode(replace(message, totals=bad))
        honest(sender, receiver, payload)

    bus.deliver = deliver
    bus.run(3.0)
    assert {len(protocol.removed) for protocol in bus.protocols.values()} == {12}
    assert {state.quality for state in bus.states.values()} == {"degraded"}
    assert all("readings contradict each other" in state.notes[0] for state in bus.states.values())
    assert {len(state.removed) for state in bus.states.values()} == {0}


def test_names_without_end_fit_no_message():
    names = tuple((f"{'m' * 999}{k}", 9.0) for k in range(40))
    totals = add_totals([Totals(worst=names, areas=1)])
    assert len(totals.worst) <= MOST_NAMED


def test_a_wild_scan_number_names_the_one_in_whose_name_it_came():
    scenario = load_scenario("ieee33")
    bus = SimulatedBus(area_files_of(scenario), make_telemetry(scenario).by_area)
    honest, received = bus.deliver, {}

    def deliver(sender: str, receiver: str, payload: bytes) -> None:
        received[sender, receiver] = payload
        honest(sender, receiver, payload)

    bus.deliver = deliver
    bus.run_until_settled()
    (sender, receiver), payload = next(item for item in received.items() if item[0][1] == "area1")
    message = decode(payload)
    header = replace(message.header, scan=2**40, sequence=message.header.sequence + 1)
    honest(sender, receiver, encode(replace(message, header=header)))
    bus.run(0.3)  # more than a heartbeat
    state = bus.states[receiver]
    assert state.rejected == {"scan far ahead of the telemetry": 1}
    (note,) = [note for note in state.notes if "far ahead" in note]
    assert note.startswith(f"messages of {sender} are rejected: one announced scan {2**40}, far ahead of the telemetry")
    assert state.quality == "good"  # a remark: who is really missed is said elsewhere
    others = {name: state.notes for name, state in bus.states.items() if name != receiver}
    assert not any("far ahead" in note for notes in others.values() for note in notes)


def test_who_announced_a_scan_that_then_came_is_accused_no_more():
    rejections = Rejections()
    header = Header("run", "area2", Incarnation(1, 1), 50, 1, 0.0)
    rejections.reject(LoadMessage(header, 6, (0.0,), (0.0,), (0.0,)), "area2", FAR_SCAN, 0.0)
    rejections.note_scan(49)
    assert rejections.far_scans == {"area2": 50}
    rejections.note_scan(50)
    assert rejections.far_scans == {}


@pytest.mark.parametrize("scan", [2**40, *further(2**50, 2**51 - 1), 2**53 - 1])
@pytest.mark.parametrize("victim", ["area1", *further("area2")])
def test_one_wild_scan_number_before_any_telemetry_keeps_no_later_scan_from_being_good(scan, victim):
    scenario = load_scenario("ieee33")
    areas = ("area1", "area2", "area3")
    bus = SimulatedBus(area_files_of(scenario), make_telemetry(scenario).by_area, late_s=dict.fromkeys(areas, 0.5))
    honest, received = bus.deliver, {}

    def deliver(sender: str, receiver: str, payload: bytes) -> None:
        received.setdefault(receiver, (sender, payload))
        honest(sender, receiver, payload)

    bus.deliver = deliver
    bus.run(0.3)
    sender, payload = received[victim]
    message = decode(payload)
    header = replace(message.header, scan=scan, sequence=message.header.sequence + 1000)
    honest(sender, victim, encode(replace(message, header=header)))
    bus.run(5.0)
    for number in (2, 3):
        bus.next_scan(make_telemetry(scenario, scan=number).by_area)
        bus.run(5.0)
        assert {state.quality for state in bus.states.values()} == {"good"}
        assert len({state.header.scan for state in bus.states.values()}) == 1


@pytest.mark.parametrize("scan", [2**40, *further(2**50, 2**51 - 1), 2**53 - 1])
def test_one_forged_scan_of_telemetry_keeps_no_later_scan_from_being_good(scan):
    scenario = load_scenario("ieee33")
    bus = SimulatedBus(area_files_of(scenario), make_telemetry(scenario).by_area)
    bus.run_until_settled()
    readings = bus.telemetry_of("area1")
    newer = replace(readings.header.incarnation, start_ms=readings.header.incarnation.start_ms + 5)
    header = replace(readings.header, scan=scan, incarnation=newer, sequence=1)
    bus.post("area1", Received(replace(readings, header=header), ""))
    bus.run(3.0)
    for number in (2, 3):
        bus.next_scan(make_telemetry(scenario, scan=number).by_area)
        bus.run(5.0)
    assert {state.quality for state in bus.states.values()} == {"good"}
    assert len({state.header.scan for state in bus.states.values()}) == 1
