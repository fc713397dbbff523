"""The exact exchange when a new scan begins: who waits for whom, and what is told and shown."""

from dataclasses import replace

import numpy as np
from exact_exchange import settle_bus
from simulated_bus import SimulatedBus, area_files_of

from agents.events import Received
from agents.hearing import PATIENT_BEATS
from agents.messages import InformationMessage
from agents.turn import ANSWER_S, LONGEST_TALK_S
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry


def new_scan(**changes):
    """ieee33 at rest when a new scan begins, and what is delivered and shown from then on."""
    scenario = load_scenario("ieee33")
    shown = []
    files = area_files_of(scenario, strategy="information", beat_s=1.0)
    bus = SimulatedBus(files, make_telemetry(scenario).by_area, on_state=lambda at, state: shown.append((at, state)))
    settle_bus(bus)
    bus.delivered.clear()
    shown.clear()
    start = bus.now
    bus.next_scan(make_telemetry(scenario, scan=2).by_area, **changes)
    return bus, shown, start


def information_of(bus, sender):
    return [(at, m) for at, s, _, m in bus.delivered if s == sender and isinstance(m, InformationMessage)]


def test_news_of_a_scan_climbs_the_tree_and_comes_down_again():
    """What the substation's area would say before it has heard both others would be out of date at once."""
    bus, shown, _ = new_scan()
    bus.run(0.1)
    heard = [at for name in ("area2", "area3") for at, m in information_of(bus, name) if m.header.scan == 2]
    told = [at for at, m in information_of(bus, "area1") if m.header.scan == 2]
    assert min(told) > sorted(heard)[0]
    assert len(told) + len(heard) <= 10
    assert {state.header.sender for at, state in shown if state.header.scan == 2} == {"area1", "area2", "area3"}
    last = {state.header.sender: state.vm for _, state in shown}
    for _, state in shown:
        np.testing.assert_allclose(state.vm, last[state.header.sender], atol=1e-8)  # no answer has changed it


def test_who_gets_its_readings_late_is_not_waited_for():
    bus, shown, start = new_scan(late_s={"area3": 0.5})
    bus.run(0.3)
    told = [at for at, m in information_of(bus, "area1") if m.header.scan == 2]
    assert PATIENT_BEATS <= max(told) - start < PATIENT_BEATS + 0.05
    assert [state.header.scan for _, state in shown if state.header.sender == "area1"][-1] == 2


def test_answers_without_end_do_not_keep_a_state_back():
    bus, shown, _ = new_scan()
    bus.run(0.5)
    last = information_of(bus, "area1")[-1][1]
    bus.cut("area1", "area2")
    bus.delivered.clear()
    shown.clear()
    for k in range(1, 41):
        header = replace(last.header, sequence=last.header.sequence + k)
        word = replace(last, header=header, z=tuple(z * (1 + 1e-4 * k) for z in last.z))
        bus.post("area2", Received(word, "area1"), delay_s=ANSWER_S / 2 * k)
    begin = bus.now
    bus.run(0.1)
    first, *_ = [at for at, state in shown if state.header.sender == "area2"]
    assert ANSWER_S < first - begin < LONGEST_TALK_S + 2 * ANSWER_S
