"""Consensus as the coordinator sees it: each condition alone keeps a run from it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from agents.messages.keys import live_key
from agents.messages.packing import Header, Incarnation, StateMessage
from agents.peers.orders_and_ages import PATIENCE_HEARTBEATS
from coordinator.watch.observe.observer import Observer, Standing
from coordinator.watch.observe.progress import describe_progress
from coordinator.watch.observe.view import OVER_S
from coordinator.watch.observe.watcher import Watcher
from dsse_core.grid.division import build_partition
from scenarios.scenario import load_scenario
from tests.support.phases import AREAS as AREAS_WITH_PHASES
from tests.support.phases import make_feeder
from tests.support.shown_states import published_by

PARTITION = load_scenario("ieee33").partition
AREAS = tuple(area.name for area in PARTITION.areas)
HEARTBEAT_S = 0.2


def a_state(area: str, sequence: int = 1, **changes: object) -> StateMessage:
    """A state of an area that agrees with everybody: 1 p.u. at 0 rad, everything received."""
    here = PARTITION.area(area)
    n = len(here.network.buses)
    sent = {neighbour.area: (1, 2) for neighbour in here.neighbours}
    shown = {
        **{"buses": tuple(bus.id for bus in here.network.buses), "vm": (1.0,) * n, "va": (0.0,) * n},
        **{"sigma_vm": (0.001,) * n, "sigma_va": (0.001,) * n, "sent": sent, "received": sent, "lost": 1},
        **{"telemetry_age": 0.0, "ages": {}},
    }
    state = published_by(area, Incarnation(1, 1), **(shown | changes))
    return replace(state, header=replace(state.header, sequence=sequence))


def with_scan(state: StateMessage, scan: int) -> StateMessage:
    return replace(state, header=replace(state.header, scan=scan))


def watch(
    *states: StateMessage, heartbeats: int = 3, alive: tuple[str, ...] = AREAS, magnitudes: bool = False
) -> Observer:
    """An observer of agreeing states, with ``states`` in their place, and all of them ``heartbeats`` times again."""
    observer = Observer(
        "run", PARTITION, tolerance_va=1e-6, tolerance_vm=1e-6, heartbeat_s=HEARTBEAT_S, compare_magnitudes=magnitudes
    )
    for area in alive:
        observer.take_presence(area, True, 0.0)
    shown = {area: a_state(area) for area in AREAS} | {state.header.sender: state for state in states}
    for heartbeat in range(heartbeats + 1):
        for state in shown.values():
            observer.take_state(state, heartbeat * HEARTBEAT_S)
    return observer


def obstacles(observer: Observer, heartbeats: int = 3) -> str:
    return "; ".join(observer.standing(heartbeats * HEARTBEAT_S).obstacles)


def shifted(state: StateMessage, vm: float = 0.0, va: float = 0.0) -> StateMessage:
    return replace(state, vm=tuple(v + vm for v in state.vm), va=tuple(a + va for a in state.va))


def test_areas_that_agree_and_have_received_all_messages_are_in_consensus_at_once():
    assert watch(heartbeats=0).standing(0.0) == Standing(())


def test_an_area_that_is_not_on_the_bus_keeps_the_run_from_consensus():
    assert obstacles(watch(alive=AREAS[:2])) == f"{AREAS[2]} is not on the bus"


def test_what_an_area_that_is_not_on_the_bus_has_not_received_is_no_obstacle_of_its_own():
    killed = a_state(AREAS[2], received={})
    assert obstacles(watch(killed, alive=AREAS[:2])) == f"{AREAS[2]} is not on the bus"


def test_an_area_that_vanishes_is_missed_and_one_that_returns_is_waited_for():
    observer = watch()
    observer.take_presence("area2", False, 3 * HEARTBEAT_S)
    assert "area2 is not on the bus" in obstacles(observer, 20)
    observer.take_presence("area2", True, 4 * HEARTBEAT_S)
    assert "changed" in obstacles(observer, 20)  # nobody has repeated itself since


def test_an_area_without_a_state_keeps_the_run_from_consensus():
    observer = Observer("run", PARTITION, 1e-6, 1e-6, HEARTBEAT_S, False)
    observer.take_presence("area1", True, 0.0)
    assert "area1 has not shown a state" in obstacles(observer)


def test_an_area_without_telemetry_is_named():
    assert "area2 has no telemetry" in obstacles(watch(with_scan(a_state("area2"), 0)))


def test_an_area_on_an_older_scan_is_named():
    states = [with_scan(a_state(area), 7 if area == "area3" else 8) for area in AREAS]
    assert obstacles(watch(*states)) == "area3 works on scan 7, the current one is 8"


def test_an_area_without_an_estimate_says_why():
    nothing = {key: () for key in ("buses", "vm", "va", "sigma_vm", "sigma_va")}
    text = obstacles(watch(a_state("area2", notes=("no estimate: singular",), **nothing)))
    assert text == "area2 has no estimate: no estimate: singular"


def test_relative_angles_are_no_consensus_even_where_they_happen_to_agree():
    assert "the angles of area3 do not count from the substation" in obstacles(
        watch(a_state("area3", referenced=False))
    )


def test_angles_that_differ_at_a_boundary_bus_are_named_with_bus_and_size():
    assert (
        obstacles(watch(shifted(a_state("area2"), va=math.radians(0.5))))
        == "area1 and area2 differ by 0.5 deg at bus 6"
    )


def test_angles_within_the_tolerance_agree():
    assert obstacles(watch(shifted(a_state("area2"), va=0.9e-6))) == ""


def test_angles_a_full_turn_apart_are_equal():
    assert obstacles(watch(shifted(a_state("area2"), va=2 * math.pi))) == ""


@pytest.mark.parametrize(
    ("magnitudes", "expected"), [(False, ""), (True, "area1 and area2 differ by 0.01 p.u. at bus 6")]
)
def test_magnitudes_count_only_where_the_strategy_reconciles_them(magnitudes: bool, expected: str):
    assert obstacles(watch(shifted(a_state("area2"), vm=0.01), magnitudes=magnitudes)) == expected


@pytest.mark.parametrize(("received", "kind"), [((0, 2), "load"), ((1, 1), "boundary")])
def test_last_messages_that_were_not_received_are_named(received: tuple[int, int], kind: str):
    assert (
        obstacles(watch(a_state("area2", received={"area1": received})))
        == f"area2 has not received the last {kind} message of area1"
    )


def test_an_area_that_has_reported_its_neighbour_nothing_is_named():
    silent = a_state("area2", sent={"area1": (1, 0)})
    text = obstacles(watch(silent, a_state("area1", received={"area2": (1, 0), "area3": (1, 2)})))
    assert text == "area2 has sent area1 no boundary message"


def restarted(area: str) -> StateMessage:
    """The state of another incarnation, which numbers its words like the incarnation before."""
    state = a_state(area)
    return replace(state, header=replace(state.header, incarnation=Incarnation(2, 0)))


def test_after_a_restart_nothing_must_have_changed_for_two_heartbeats():
    observer = watch()
    observer.take_state(restarted("area1"), 3 * HEARTBEAT_S)
    assert (
        obstacles(observer, 3) == "something has changed within the last 2 heartbeats, after a restart or another fault"
    )
    for heartbeat in (4, 5, 6):
        for state in (restarted("area1"), a_state("area2"), a_state("area3")):
            observer.take_state(state, heartbeat * HEARTBEAT_S)
    assert obstacles(observer, 6) == ""


def test_after_a_restart_silence_is_not_quiet_because_every_area_must_be_received_to_repeat_itself():
    observer = watch()
    observer.take_state(restarted("area1"), 3 * HEARTBEAT_S)
    assert (
        obstacles(observer, 100)
        == "something has changed within the last 2 heartbeats, after a restart or another fault"
    )


def test_an_older_message_does_not_replace_a_newer_one():
    observer = watch(a_state("area1", sequence=5))
    assert not observer.take_state(a_state("area1", sequence=4), 1.0)
    assert observer.states["area1"].header.sequence == 5


def test_a_repeat_brings_newer_counts():
    observer = watch()
    assert not observer.take_state(a_state("area1", messages=99), 1.0)
    assert observer.states["area1"].messages == 99


def test_a_restarted_area_is_received_at_once_although_it_counts_from_one_again():
    observer = watch(a_state("area1", sequence=9))
    assert observer.take_state(restarted("area1"), 1.0)
    assert observer.states["area1"].header.incarnation == Incarnation(2, 0)


def test_an_area_restarted_with_its_clock_set_back_is_received_once_its_former_incarnation_is_over():
    observer = watch()
    last_received = 3 * HEARTBEAT_S
    earlier = a_state(AREAS[0], vm=(1.01,) * len(a_state(AREAS[0]).buses))
    earlier = replace(earlier, header=replace(earlier.header, incarnation=Incarnation(0, 7)))
    assert not observer.take_state(earlier, last_received + OVER_S)
    assert observer.take_state(earlier, last_received + OVER_S + HEARTBEAT_S)
    assert observer.states[AREAS[0]].vm[0] == 1.01


def test_a_stranger_is_ignored():
    observer = watch()
    assert not observer.take_state(
        replace(a_state("area1"), header=Header("run", "x", Incarnation(1, 1), 1, 1, 0.0)), 1.0
    )
    assert not observer.take_presence("x", True, 1.0)


def test_exchanges_are_the_most_changed_messages_on_one_directed_link():
    observer = watch(a_state("area1", sent={"area2": (1, 2), "area3": (2, 5)}))
    assert observer.exchanges == 7


def test_history_keeps_every_changed_estimate_with_its_time():
    observer = watch()
    observer.take_state(a_state("area1", sequence=2), 9.0)
    assert [sample.time for sample in observer.history if sample.area == "area1"] == [0.0, 9.0]


def test_samples_of_an_area_do_not_keep_its_buses_once_more_each():
    observer = watch()
    buses = tuple(int(f"{bus}") for bus in observer.states["area1"].buses)
    observer.take_state(a_state("area1", sequence=2, buses=buses), 9.0)
    first, second = (sample.buses for sample in observer.history if sample.area == "area1")
    assert first is second


def test_a_state_that_names_a_bus_twice_or_lacks_one_is_not_of_its_area():
    observer, buses = watch(), a_state("area1").buses
    for wrong in ((buses[1], *buses[1:]), buses[1:], (10**18, *buses[1:])):
        n = len(wrong)
        columns = {key: (1.0,) * n for key in ("vm", "va", "sigma_vm", "sigma_va")}
        assert not observer.take_state(a_state("area1", sequence=2, buses=wrong, **columns), 9.0)


def test_progress_shows_state_and_mismatch_of_every_area():
    progress = describe_progress(watch(shifted(a_state("area2"), va=0.1)), 1.5, ("area2 adjusts",))
    assert [area.name for area in progress.areas] == list(AREAS)
    by_name = {area.name: area for area in progress.areas}
    assert by_name["area2"].state == "adjusts"
    assert by_name["area2"].mismatch_va == pytest.approx(0.1)
    assert by_name["area3"].state == "agrees"
    assert progress.obstacles == ("area2 adjusts",)


def test_progress_compares_no_relative_angles_and_no_different_scans():
    moved = shifted(a_state("area2"), vm=0.01, va=0.1)
    relative = describe_progress(watch(replace(moved, referenced=False)), 1.5, ())
    later = describe_progress(watch(with_scan(moved, 2)), 1.5, ())
    neighbours = {"area2", *(neighbour.area for neighbour in PARTITION.area("area2").neighbours)}
    for progress, vm in ((relative, pytest.approx(0.01)), (later, None)):
        by_name = {area.name: area for area in progress.areas}
        assert by_name["area2"].mismatch_va is None
        assert by_name["area2"].mismatch_vm == vm
        assert "agrees" not in {by_name[name].state for name in neighbours}


def test_after_a_fault_every_area_must_have_been_received_again():
    observer = watch()
    assert not observer.standing(5 * HEARTBEAT_S).obstacles
    observer.take_fault(5 * HEARTBEAT_S)
    for heartbeat in (6, 7):
        for state in (a_state("area1"), a_state("area2")):  # area3 was killed, and nobody has reported it yet
            observer.take_state(state, heartbeat * HEARTBEAT_S)
    assert (
        obstacles(observer, 8) == "something has changed within the last 2 heartbeats, after a restart or another fault"
    )
    for heartbeat in (8, 9):
        observer.take_state(a_state("area3"), heartbeat * HEARTBEAT_S)
    assert obstacles(observer, 9) == ""


def test_areas_that_agree_on_stale_estimates_are_no_consensus_and_after_long_a_dead_end_that_names_the_scan():
    observer = watch(a_state("area2", quality="stale", telemetry_age=1.0))
    assert obstacles(observer) == "area2 has received no telemetry for 1.0 s"
    assert observer.standing(3 * HEARTBEAT_S).dead_end is None
    assert observer.standing((3 + PATIENCE_HEARTBEATS) * HEARTBEAT_S).dead_end is None, "the plant may be slow"
    later = 5.0
    for state in (a_state("area1"), a_state("area3")):
        observer.take_state(state, later)
    reason = observer.standing(later).dead_end
    assert reason is not None
    assert "stale estimates: area2 received the last telemetry, of scan 1, 5.4 s ago" in reason
    observer.take_state(shifted(a_state("area1", sequence=2), va=0.1), later)
    assert observer.standing(later).dead_end is None, "areas that differ may still come to agree"


def test_after_a_fault_every_area_must_have_received_its_telemetry_again_which_a_dead_plant_has_not_sent():
    observer = watch()
    observer.take_fault(3 * HEARTBEAT_S)
    for heartbeat in (4, 5, 6):
        for area in AREAS:
            received = 0.0 if area != "area3" else (heartbeat - 3) * HEARTBEAT_S + 0.01
            observer.take_state(a_state(area, telemetry_age=received), heartbeat * HEARTBEAT_S)
    assert obstacles(observer, 6) == "area3 has received no telemetry for 0.6 s"
    observer.take_state(a_state("area3"), 7 * HEARTBEAT_S)
    assert obstacles(observer, 7) == ""


def test_the_state_of_an_area_that_is_gone_or_not_received_is_no_longer_good():
    observer = watch(heartbeats=0)
    assert observer.quality_of("area1", OVER_S) == "good"
    assert observer.quality_of("area1", OVER_S + HEARTBEAT_S) == "stale"
    observer.take_state(a_state("area1"), OVER_S + HEARTBEAT_S)
    assert observer.quality_of("area1", OVER_S + HEARTBEAT_S) == "good"
    observer.take_presence("area1", False, OVER_S + HEARTBEAT_S)
    assert observer.quality_of("area1", OVER_S + HEARTBEAT_S) == "stale"


@pytest.mark.parametrize("arrivals", [(0.0,), (0.0, 0.2, 0.4), (0.0, 5.0), (0.0, 0.2, 7.0, 7.2)], ids=str)
def test_a_run_and_a_watcher_without_its_scenario_call_an_area_silent_at_the_same_time(arrivals: tuple[float, ...]):
    observer, watcher = Observer("run", PARTITION, 1e-6, 1e-6, HEARTBEAT_S, False), Watcher("run")
    observer.take_presence("area1", True, 0.0)
    watcher.take_presence(live_key("run", "area", "area1", Incarnation(1, 1)), True)
    for at in arrivals:
        observer.take_state(a_state("area1"), at)
        watcher.take_state(a_state("area1"), at)
    qualities = []
    for at in np.arange(arrivals[-1], arrivals[-1] + 30.0, 0.1):
        (view,) = [area for area in watcher.look(at).areas if area.name == "area1"]
        qualities.append(observer.quality_of("area1", at))
        assert qualities[-1] == view.quality
    assert (qualities[0], qualities[-1]) == ("good", "stale")


WITH_PHASES = build_partition(make_feeder(), AREAS_WITH_PHASES)


def show_phases(**of_west: object) -> Observer:
    """An observer of head and west of a network with phases, which meet in phases a and c of bus 671."""
    observer = Observer("run", WITH_PHASES, 1e-6, 1e-6, HEARTBEAT_S, compare_magnitudes=True)
    for area, changes in (("head", {}), ("west", of_west)):
        network = WITH_PHASES.area(area).network
        nodes = {"buses": network.node_buses, "phases": network.node_phases, "sent": {"head": (1, 1), "west": (1, 1)}}
        voltages = dict.fromkeys(("vm", "va", "sigma_vm", "sigma_va"), (1.0,) * network.n_nodes)
        observer.take_state(published_by(area, Incarnation(1, 1), **(nodes | voltages | changes)), 0.0)
    return observer


def test_areas_agree_phase_by_phase_where_they_meet():
    vm = [1.0] * WITH_PHASES.area("west").network.n_nodes
    vm[WITH_PHASES.area("west").network.node(671, "c")] = 1.25
    for observer, expected in ((show_phases(), False), (show_phases(vm=tuple(vm)), True)):
        assert ("head and west differ by 0.25 p.u. at bus 671.c" in observer.standing(0.0).obstacles) is expected
        assert not any("671.a" in obstacle for obstacle in observer.standing(0.0).obstacles)
    seen = observer.watcher.look(0.0)
    assert [area.mismatch_vm_pu for area in seen.areas] == [0.25, 0.25]
    assert [area.highest_vm.at for area in seen.areas] == ["650.a", "671.c"]


def test_a_state_of_other_phases_than_its_area_has_is_not_kept():
    network = WITH_PHASES.area("west").network
    assert "west" in show_phases().states
    for phases in ((), ("b", *network.node_phases[1:])):
        assert "west" not in show_phases(phases=phases).states
