"""The protocol, without sockets and without sleeping: order, loss, restarts, rejections, repeats."""

from dataclasses import replace

import numpy as np
import pytest

from agents.messages.packing import Header, HeartbeatMessage, Incarnation, LoadMessage
from agents.protocol.choose import make_protocol
from agents.protocol.events import Finish, PresenceChanged, Publish, Received, Rejected, StopRequested
from agents.strategies.admm_boundary import AdmmMessage
from agents.strategies.angle_offset import BoundaryMessage
from coordinator.lab.plant.telemetry_messages import make_message
from coordinator.lab.simulator.simulator import STARTED_AT
from dsse_core.grid.boundary import boundary_at
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.levels import further
from tests.support.simulated_bus import SimulatedBus, area_files_of, bus_of


def boundary_from(bus: SimulatedBus, sender: str, receiver: str) -> BoundaryMessage:
    return [m for _, s, r, m in bus.delivered if (s, r) == (sender, receiver) and isinstance(m, BoundaryMessage)][-1]


def test_without_loss_every_area_agrees_at_the_boundary_within_a_few_messages():
    bus, scenario, _ = bus_of("ieee33")
    bus.run_until_settled()
    voltages = bus.voltages()
    for boundary in scenario.partition.boundaries:
        angles = [np.angle(v) for v in voltages[boundary]]
        assert len(angles) == 3
        assert max(angles) - min(angles) < 1e-9
    assert max(seq for s in bus.states.values() for pair in s.sent.values() for seq in pair) <= 4


@pytest.mark.parametrize("seed", [0, 1, *further(*range(2, 8))])
@pytest.mark.parametrize("loss", [0.3, 0.6, 0.9])
def test_loss_delays_the_result_but_does_not_change_it(loss, seed):
    lossless, _, _ = bus_of("ieee33")
    lossless.run_until_settled()
    bus, _, _ = bus_of("ieee33", loss=loss, seed=seed)
    bus.run_until_settled(limit_s=600.0)
    assert sum(link.lost for link in bus.links.values()) > 0
    for name, state in bus.states.items():
        np.testing.assert_allclose(state.va, lossless.states[name].va, atol=1e-9)
        np.testing.assert_allclose(state.vm, lossless.states[name].vm, atol=1e-9)


def test_a_cut_link_delays_consensus_but_does_not_change_it():
    whole, _, _ = bus_of("ieee33")
    whole.run_until_settled()
    bus, _, _ = bus_of("ieee33")
    bus.cut("area1", "area2")
    bus.run(5.0)
    assert not bus.settled
    assert not bus.states["area2"].referenced
    assert "no angle from area1 yet" in " ".join(bus.states["area2"].notes)
    bus.heal("area1", "area2")
    bus.run_until_settled()
    np.testing.assert_allclose(bus.states["area2"].va, whole.states["area2"].va, atol=1e-9)


def test_a_lost_last_message_is_repeated_at_the_heartbeat():
    bus, _, _ = bus_of("industrial13")
    lost = []

    def lose_each_sequence_once(sender, receiver, message):
        first = (sender, receiver, message.kind, message.header.sequence) not in lost
        lost.append((sender, receiver, message.kind, message.header.sequence))
        return first

    bus.reject_delivery = lose_each_sequence_once
    bus.run_until_settled()
    assert lost


def test_a_restarted_area_is_received_at_once_and_finds_the_same_state():
    bus, _, _ = bus_of("ieee33")
    bus.run_until_settled()
    before = bus.states["area2"]
    bus.kill("area2")
    bus.run(1.0)
    assert "neighbour area2 is gone" in bus.states["area1"].notes
    bus.start("area2")
    bus.send_telemetry("area2")
    bus.run_until_settled()
    after = bus.states["area2"]
    assert after.header.incarnation > before.header.incarnation
    assert after.header.sequence < before.header.sequence + 3
    np.testing.assert_allclose(after.va, before.va, atol=1e-9)
    assert boundary_from(bus, "area2", "area1").header.incarnation == after.header.incarnation
    assert "neighbour area2 is gone" not in bus.states["area1"].notes


def test_a_new_scan_brings_everyone_to_the_new_state():
    bus, scenario, _ = bus_of("ieee33", loss=0.3, seed=1)
    bus.run_until_settled()
    first = bus.states["area3"]
    bus.next_scan(make_telemetry(scenario, scan=2).by_area)
    bus.run_until_settled()
    assert {state.header.scan for state in bus.states.values()} == {2}
    fresh, _, _ = bus_of("ieee33")
    fresh.next_scan(make_telemetry(scenario, scan=2).by_area)
    fresh.run_until_settled()
    np.testing.assert_allclose(bus.states["area3"].va, fresh.states["area3"].va, atol=1e-9)
    assert max(abs(np.array(bus.states["area3"].va) - first.va)) > 1e-6


def test_an_area_estimates_alone_and_says_what_it_lacks():
    bus, _, _ = bus_of("ieee33", loss=1.0)
    bus.run(2.0)
    state = bus.states["area2"]
    assert state.vm
    assert not state.referenced
    assert "no load message from area1 yet" in state.notes


# One protocol by itself


@pytest.fixture
def area1():
    """The protocol of area1 of ieee33, its telemetry as one event, and its file."""
    scenario = load_scenario("ieee33")
    content = area_files_of(scenario, strategy="angle-offset")[0]
    header = Header(content.run, "plant", Incarnation(0, 0), scan=1, sequence=1, time=STARTED_AT)
    telemetry = Received(make_message(header, "area1", make_telemetry(scenario).by_area["area1"]), "")
    protocol = make_protocol(content, Incarnation(1, 1), now=0.0, started_at=STARTED_AT)
    return protocol, telemetry, content


AT_5, AT_6 = (boundary_at((bus,), "area2").names for bus in (5, 6))


def load_from_area2(sequence=1, **changes):
    fields = {"run": "sim", "sender": "area2", "incarnation": Incarnation(5, 5), "scan": 1, "time": 0.0}
    bus = changes.pop("bus", 6)
    return LoadMessage(
        Header(sequence=sequence, **(fields | changes)), bus, (0.08 + sequence / 1000,), (0.05,), (0.001,)
    )


def heartbeat_from_area2(received=(0, 0)):
    of_file = {"towards_hub": True, "is_parent": True, "areas": 3, "base_mva": 10.0}
    return HeartbeatMessage(
        load_from_area2().header, 0, 0, True, 0.0, received, False, False, (), **of_file, variables=AT_6
    )


def act(protocol, events, now):
    """What it does at time ``now``."""
    return list(protocol.handle(events, now))


def last_state(actions):
    return [a.message for a in actions if isinstance(a, Publish) and a.message.kind == "state"][-1]


def test_neighbours_get_messages_before_the_state_is_shown(area1):
    protocol, telemetry, content = area1
    actions = [action for action in protocol.handle([telemetry], 0.0) if action.message.kind != "load"]
    assert [action.to for action in actions] == [*(n.area for n in content.area.neighbours), None, None]
    assert [action.message.kind for action in actions[-2:]] == ["state", "readings"]


def test_before_any_telemetry_an_area_says_that_it_has_none(area1):
    protocol, _, _ = area1
    assert last_state(act(protocol, [], 0.0)).notes == ("no telemetry yet",)


def act_until(protocol, start, end):
    """What it does by itself between two times."""
    done, now = [], start
    while (now := now + protocol.wait_s(now)) < end:
        done += act(protocol, [], now)
    return done


def test_without_update_an_area_only_repeats_itself_until_the_heartbeat(area1):
    protocol, telemetry, content = area1
    actions = act(protocol, [telemetry], 0.0)
    assert act(protocol, [telemetry], 0.01) == []
    sent = {(a.message.kind, a.message.header.order) for a in actions if a.to is not None}
    quiet = {(m.kind, m.header.order) for m in (a.message for a in act_until(protocol, 0.01, content.beat_s))}
    assert sent <= quiet | {("heartbeat", (Incarnation(1, 1), 1))}
    assert quiet <= sent | {("heartbeat", (Incarnation(1, 1), 1))}
    assert last_state(act(protocol, [], content.beat_s)).header.order == last_state(actions).header.order


def test_a_repeat_is_the_same_message_with_the_same_number_and_stops_when_it_is_acknowledged(area1):
    protocol, telemetry, content = area1
    first = {a.to: a.message for a in act(protocol, [telemetry], 0.0) if a.message.kind == "boundary"}
    again = [a for a in act_until(protocol, 0.0, 0.5 * content.beat_s) if a.message.kind == "boundary"]
    assert {a.to for a in again} == first.keys() == {"area2", "area3"}
    for action in again:
        sent = first[action.to]
        assert action.message.header.order == sent.header.order
        assert (action.message.vm, action.message.va) == (sent.vm, sent.va)
    now = 0.5 * content.beat_s
    reply = Received(heartbeat_from_area2(received=(0, first["area2"].header.sequence)), "area2")
    assert act(protocol, [reply], now)
    later = [a.to for a in act_until(protocol, now, 2 * content.beat_s) if a.message.kind == "boundary"]
    assert set(later) == {"area3"}


@pytest.mark.parametrize(
    ("message", "key_sender", "reason"),
    [
        (load_from_area2(run="other"), "area2", "other run"),
        (load_from_area2(sender="area9"), "area9", "unknown sender"),
        (load_from_area2(), "area3", "sender does not own the key"),
        (load_from_area2(bus=5), "area2", "other boundary bus"),
        (
            HeartbeatMessage(load_from_area2().header, 0, 0, True, 0.0, -1, False, False, (), variables=AT_5),
            "area2",
            "other boundary variables",
        ),
        (load_from_area2(time=STARTED_AT + 1e4), "area2", "time in the future"),
        (load_from_area2(incarnation=Incarnation(int(STARTED_AT * 1000) + 10**7, 1)), "area2", "time in the future"),
        (replace(load_from_area2(), p=(1e300,)), "area2", "numbers beyond reason"),
        (replace(load_from_area2(), sigma=(-0.1,)), "area2", "numbers beyond reason"),
        (BoundaryMessage(load_from_area2().header, 6, 0.0, 0.0, True), "area2", "numbers beyond reason"),
        (
            AdmmMessage(load_from_area2().header, 6, 1, (), (), (), True, True, variables=AT_6),
            "area2",
            "other strategy",
        ),
    ],
)
def test_what_should_not_have_come_is_rejected_and_counted(area1, message, key_sender, reason):
    protocol, telemetry, content = area1
    act(protocol, [telemetry], 0.0)
    sent = act(protocol, [Received(message, key_sender)], 0.01)
    noted = ("time in the future", "other strategy", "other boundary variables")
    assert [a.message.kind for a in sent] == (["state"] if reason in noted else [])
    state = last_state(act(protocol, [], content.beat_s))
    assert state.rejected == {reason: 1}
    assert state.received["area2"] == (0, 0)


def test_net_loads_of_more_phases_than_the_boundary_has_are_rejected(area1):
    protocol, telemetry, _ = area1
    act(protocol, [telemetry], 0.0)
    message = replace(load_from_area2(), p=(0.1,) * 3, q=(0.1,) * 3, sigma=(0.1,) * 3)
    act(protocol, [Received(message, "area2")], 0.01)
    assert protocol._rejections.counts["other boundary variables"] == 1


def test_a_clock_that_is_behind_is_named_once_as_the_cause_until_the_sender_is_received(area1):
    protocol, telemetry, _ = area1
    act(protocol, [telemetry], 0.0)
    ahead = Received(load_from_area2(time=STARTED_AT + 1e4), "area2")
    state = last_state(act(protocol, [ahead], 0.0))
    assert [
        n for n in state.notes if n.startswith("area2 is rejected, from 10000 s in the future: the clock of this area")
    ]
    assert act(protocol, [ahead] * 3, 0.01) == [], "a flood of them is no update"
    state = last_state(act(protocol, [Received(load_from_area2(time=STARTED_AT), "area2")], 0.02))
    assert not [n for n in state.notes if "rejected" in n]


def test_an_agent_whose_clock_is_behind_says_so_in_place_of_an_estimate(area1):
    protocol, telemetry, _ = area1
    header = replace(telemetry.message.header, time=STARTED_AT + 700.0)
    state = last_state(act(protocol, [Received(replace(telemetry.message, header=header), "")], 0.0))
    assert state.notes[0] == "no telemetry yet"
    assert state.notes[1].startswith("telemetry is rejected, from 700 s in the future")


def test_a_malformed_payload_is_noted_with_its_sender_and_its_field(area1):
    protocol, telemetry, _ = area1
    state = last_state(act(protocol, [telemetry, Rejected("malformed", 1, "area2", "bus: Expected `int`")], 0.0))
    assert "payloads of area2 are rejected, malformed: bus: Expected `int`" in state.notes
    assert state.rejected == {"malformed": 1}


def test_payloads_that_cannot_be_decoded_are_counted_by_reason(area1):
    protocol, telemetry, _ = area1
    state = last_state(act(protocol, [telemetry, Rejected("malformed", 2), Rejected("malformed", 1)], 0.0))
    assert state.rejected == {"malformed": 2}


def test_an_overtaken_message_changes_nothing(area1):
    protocol, telemetry, _ = area1
    act(protocol, [telemetry, Received(load_from_area2(3), "area2")], 0.0)
    sent = act(protocol, [Received(load_from_area2(2), "area2")], 0.01)
    assert [a.message.kind for a in sent] == ["heartbeat"]  # which acknowledges the newest


def test_a_message_of_a_former_incarnation_changes_nothing(area1):
    protocol, telemetry, content = area1
    act(protocol, [telemetry, Received(load_from_area2(1), "area2")], 0.0)
    late = load_from_area2(99, incarnation=Incarnation(4, 9))
    assert {a.message.kind for a in act(protocol, [Received(late, "area2")], 0.01)} <= {"heartbeat"}
    sent = act(protocol, [Received(heartbeat_from_area2(), "area2")], 0.02)
    answers = [a.message.received for a in sent if isinstance(a.message, HeartbeatMessage)]
    assert answers == [(1, 0)]  # the newest load is still that of the present incarnation
    assert last_state(act(protocol, [], content.beat_s)).rejected == {}


def test_a_gone_neighbour_is_named(area1):
    protocol, telemetry, _ = area1
    act(protocol, [telemetry, PresenceChanged("area2", alive=True)], 0.0)
    left = last_state(act(protocol, [PresenceChanged("area2", alive=False, leave_reason="SIGTERM")], 0.005))
    assert "neighbour area2 has left: SIGTERM" in left.notes
    act(protocol, [PresenceChanged("area2", alive=True)], 0.007)
    state = last_state(act(protocol, [PresenceChanged("area2", alive=False)], 0.01))
    assert "neighbour area2 is gone" in state.notes


def test_readings_of_unknown_meters_are_rejected_and_missing_ones_named(area1):
    protocol, telemetry, _ = area1
    message = telemetry.message
    strange = replace(message, meters=("vm@999", *message.meters[1:]))
    state = last_state(act(protocol, [Received(strange, "")], 0.0))
    assert state.rejected == {"unknown meter": 1}
    assert "no reading from vm@1" in state.notes


def test_a_stop_finishes_with_its_reason(area1):
    protocol, _, _ = area1
    assert act(protocol, [StopRequested("SIGTERM")], 0.0) == [Finish("SIGTERM")]


def test_a_flood_of_rejected_payloads_is_no_update(area1):
    protocol, telemetry, content = area1
    before = last_state(act(protocol, [telemetry], 0.0))
    assert act(protocol, [Rejected("unknown sender", 10_000)], 0.01) == []
    after = last_state(act(protocol, [], content.beat_s))
    assert after.header.order == before.header.order
    assert after.rejected == {"unknown sender": 10_000}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda m: replace(m, area="area2"), "telemetry of another area"),
        (lambda m: replace(m, values=(1e300, *m.values[1:])), "reading beyond reason"),
        (lambda m: replace(m, sigmas=(1e-300, *m.sigmas[1:])), "reading beyond reason"),
        (lambda m: replace(m, sigmas=(0.0, *m.sigmas[1:])), "sigma not positive"),
    ],
)
def test_telemetry_that_cannot_be_is_rejected_and_counted(area1, change, reason):
    protocol, telemetry, _ = area1
    state = last_state(act(protocol, [Received(change(telemetry.message), "")], 0.0))
    assert state.rejected == {reason: 1}


ALL_THREE = ("area1", "area2", "area3")


@pytest.mark.parametrize(
    ("strategy", "value", "misread"),
    [
        ("angle-offset", 1e12, ALL_THREE),
        ("information", 1e12, ALL_THREE),
        ("admm", 1e3, ALL_THREE),
        pytest.param("admm", 1e3, ("area2",), marks=pytest.mark.long),
    ],
)
def test_readings_that_break_the_iteration_are_forgotten_with_the_next_scan(strategy, value, misread):
    sane = make_telemetry(load_scenario("ieee33")).by_area
    bus = SimulatedBus(area_files_of(load_scenario("ieee33"), strategy=strategy), sane)
    bus.run(1.0)
    absurd = {area: [replace(m, value=value if m.sigma else 0.0) for m in sane[area]] for area in misread}
    bus.next_scan(sane | absurd)
    bus.run(0.1)
    for state in bus.states.values():
        assert np.isfinite([*state.vm, *state.va, *state.sigma_vm, *state.sigma_va]).all()
    bus.next_scan(sane)
    bus.run(1.0)
    fresh = SimulatedBus(area_files_of(load_scenario("ieee33"), strategy=strategy), sane)
    fresh.run_until_settled()
    for name, state in bus.states.items():
        np.testing.assert_allclose(state.vm, fresh.states[name].vm, atol=1e-7)


@pytest.mark.parametrize("late", ["area1", "area2"])
def test_a_new_scan_with_the_same_readings_is_passed_on_although_a_neighbour_was_faster(late):
    scenario = load_scenario("industrial13")
    telemetry = make_telemetry(scenario).by_area
    bus = SimulatedBus(area_files_of(scenario), telemetry)
    bus.run_until_settled()
    bus.next_scan(telemetry, late_s={late: 1.0})  # when the neighbour no longer uses messages of the former scan
    bus.run(5.0)
    assert {(state.header.scan, state.quality) for state in bus.states.values()} == {(2, "good")}
