"""The view of a watcher as text, and the tables below it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shown_states import a_state, said_by

from agents.messages.packing import Header, Incarnation, ReadingsMessage
from coordinator.observe.grid_tables import GridTables, list_buses, list_meters, worst_first
from coordinator.observe.view_json import describe_tables, describe_view
from coordinator.observe.view_text import WIDTH, format_view
from coordinator.observe.watch import Watcher
from scenarios.scenario import load_scenario

HEADER = Header("run", "area1", Incarnation(1, 1), 1, 1, 0.0)
USED = ReadingsMessage(
    HEADER,
    taken_at=100.0,
    meters=("vm@1", "p_flow@1:1-2"),
    values=(1.01, 0.5),
    sigmas=(0.002, 0.01),
    times=(40.0, 100.0),
    estimates=(1.0, 0.52),
    normalised=(5.2, 2.1),
)


def watching(*states, readings=USED) -> Watcher:
    watcher = Watcher("run")
    for state in states:
        watcher.take_presence(f"dsse/v2/run/live/area/{state.header.sender}/1-00000001", True)
        watcher.take_state(state, 0.0)
    if readings is not None:
        watcher.take_readings(readings)
    return watcher


@given(
    st.text(max_size=90),
    st.lists(st.text(max_size=300), max_size=5),
    st.floats(allow_nan=False, allow_infinity=False),
)
def test_no_line_is_wider_than_an_old_terminal(name, notes, value):
    state = said_by("area1", Incarnation(1, 1), notes=tuple(notes), quality=name, vm=(value,))
    lines = format_view(watching(replace(state, header=replace(state.header, sender=name))).look(0.0)).splitlines()
    assert max(map(len, lines)) <= WIDTH


def test_a_line_says_where_voltages_lie_and_which_meter_is_farthest_off():
    state = a_state(buses=(1, 2), vm=(1.0, 0.931), va=(0.0, 0.0), sigma_vm=(0.1, 0.1), sigma_va=(0.1, 0.1))
    watcher = watching(state)
    (area,) = watcher.look(0.0).areas
    assert (area.lowest_vm.at, area.worst_meter.at, area.worst_meter.value) == ("2", "vm@1", 5.2)
    assert "0.931..1.000  vm@1 5.2" in format_view(watcher.look(0.0))


def test_readings_of_another_scan_tell_nothing_of_the_worst_meter():
    older = replace(USED, header=replace(HEADER, scan=7))
    assert watching(a_state(), readings=older).look(0.0).areas[0].worst_meter is None


def test_an_older_reading_does_not_take_the_place_of_a_newer_one():
    watcher = watching(a_state())
    watcher.take_readings(replace(USED, header=replace(HEADER, sequence=0), values=(9.0, 9.0)))
    assert watcher.readings["area1"].values == USED.values


def test_an_area_that_never_spoke_says_so():
    watcher = watching(a_state(sent={"area2": (1, 1)}))
    assert "is gone" in format_view(watcher.look(0.0))


def test_meters_are_listed_with_age_residual_and_what_became_of_them_the_worst_first():
    states = {"area1": a_state(removed=("vm@1",), meters_off=("q_flow@1:1-2",))}
    table = worst_first(list_meters(states, {"area1": USED}))
    assert table.meter == ("vm@1", "p_flow@1:1-2", "q_flow@1:1-2")
    assert table.status == ("removed", "used", "off")
    assert table.age_s.tolist()[:2] == [60.0, 0.0]
    assert table.residual_in_sigmas.tolist()[:2] == pytest.approx([5.0, -2.0])
    assert np.isnan(table.residual_in_sigmas[2])


def test_angles_that_count_from_nowhere_are_not_shown():
    table = list_buses({"area1": a_state(referenced=False)})
    assert np.isnan(table.va_deg[0])
    assert table.vm_pu.tolist() == [1.0]


def test_of_a_known_grid_every_bus_and_every_silent_meter_has_its_row():
    scenario = load_scenario("industrial13")
    known = GridTables(scenario)
    area = scenario.partition.area("area2")
    n = len(area.network.buses)
    flat = (1.0,) * n, (0.0,) * n
    sigmas = (0.001,) * n
    state = said_by(
        "area2",
        Incarnation(1, 1),
        buses=tuple(reversed([bus.id for bus in area.network.buses])),
        **dict(zip(("vm", "va", "sigma_vm", "sigma_va"), (*flat, sigmas, sigmas), strict=True)),
    )
    buses, branches = known.buses_and_branches({"area2": state, "area1": a_state(buses=(99,))})
    assert len(buses) == 13
    assert len(branches) == len(scenario.network.branches)
    assert buses.vm_kv[buses.bus == 1] == 69.0
    assert np.isnan(buses.vm_pu[buses.bus == 9])[0]  # what a stranger said of bus 99 counts for nothing
    used = replace(USED, meters=("vm@1", "vm@999"))
    meters = known.meters({"area2": state}, {"area2": used})
    assert len(meters) == sum(m.source != "virtual" for m in scenario.meters)
    assert (meters.meter[0], meters.status[0], meters.unit[0]) == ("vm@1", "used", "pu")
    assert set(zip(meters.area[1:], meters.status[1:], strict=True)) == {("area1", "not received"), ("area2", "silent")}


def test_json_has_all_that_the_text_has_and_unknown_numbers_are_null():
    watcher = watching(a_state(referenced=False))
    described = describe_view(watcher.look(0.0))["areas"]["area1"]
    assert described["worst_meter"] == {"value": 5.2, "at": "vm@1"}
    tables = describe_tables({"buses": list_buses(watcher.states)})
    assert tables["buses"]["va_deg"] == [None]
