"""The view of a watcher as text, and the tables below it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.messages.packing import Header, Incarnation, ReadingsMessage
from coordinator.watch.observe.grid_tables import GridTables, collect_readings, find_tables, list_buses, worst_first
from coordinator.watch.observe.table_text import write_table
from coordinator.watch.observe.view_json import describe_tables, describe_view
from coordinator.watch.observe.view_text import WIDTH, fit_view, format_view
from coordinator.watch.observe.watcher import Watcher
from dsse_core.results.table import Table
from dsse_core.split_identity import SplitIdentity
from scenarios.scenario import load_scenario
from tests.support.shown_states import a_state, published_by

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
        watcher.take_presence(f"dsse/v3/run/live/area/{state.header.sender}/1-00000001", True)
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
    state = published_by("area1", Incarnation(1, 1), notes=tuple(notes), quality=name, vm=(value,))
    lines = format_view(watching(replace(state, header=replace(state.header, sender=name))).look(0.0)).splitlines()
    assert max(map(len, lines)) <= WIDTH


def test_a_line_says_where_voltages_lie_and_which_meter_is_farthest_off():
    state = a_state(buses=(1, 2), vm=(1.0, 0.931), va=(0.0, 0.0), sigma_vm=(0.1, 0.1), sigma_va=(0.1, 0.1))
    watcher = watching(state)
    (area,) = watcher.look(0.0).areas
    assert (area.lowest_vm.at, area.worst_meter.at, area.worst_meter.value) == ("2", "vm@1", 5.2)
    assert "0.931..1.000  vm@1 5.2" in format_view(watcher.look(0.0))


def test_readings_of_another_scan_show_nothing_of_the_worst_meter():
    older = replace(USED, header=replace(HEADER, scan=7))
    assert watching(a_state(), readings=older).look(0.0).areas[0].worst_meter is None


def test_an_older_reading_does_not_take_the_place_of_a_newer_one():
    watcher = watching(a_state())
    watcher.take_readings(replace(USED, header=replace(HEADER, sequence=0), values=(9.0, 9.0)))
    assert watcher.readings["area1"].values == USED.values


def test_readings_of_an_area_that_began_again_with_its_clock_set_back_are_shown():
    watcher = watching(a_state(), readings=None)
    watcher.take_readings(replace(USED, header=replace(HEADER, incarnation=Incarnation(2, 1)), values=(9.0, 9.0)))
    watcher.take_readings(USED)
    assert watcher.readings["area1"].values == USED.values


def test_an_area_that_never_spoke_says_so():
    watcher = watching(a_state(sent={"area2": (1, 1)}))
    assert "is gone" in format_view(watcher.look(0.0))


def test_meters_are_listed_with_age_residual_and_what_became_of_them_the_worst_first():
    states = {"area1": a_state(removed=("vm@1",), meters_off=("q_flow@1:1-2",))}
    table = worst_first(Table("meters", collect_readings(states, {"area1": USED}, {})))
    assert table.meter == ("vm@1", "p_flow@1:1-2", "q_flow@1:1-2")
    assert table.status == ("removed", "used", "off")
    assert table.age_s.tolist()[:2] == [60.0, 0.0]
    assert table.residual_in_sigmas.tolist()[:2] == pytest.approx([5.0, -2.0])
    assert np.isnan(table.residual_in_sigmas[2])


def test_angles_that_count_from_nowhere_are_not_shown():
    table = list_buses({"area1": a_state(referenced=False)}, {})
    assert np.isnan(table.va_deg[0])
    assert table.vm_pu.tolist() == [1.0]


def test_of_a_known_grid_every_bus_and_every_silent_meter_has_its_row():
    scenario = load_scenario("industrial13")
    known = GridTables(scenario)
    area = scenario.partition.area("area2")
    n = len(area.network.buses)
    flat = (1.0,) * n, (0.0,) * n
    sigmas = (0.001,) * n
    state = published_by(
        "area2",
        Incarnation(1, 1),
        buses=tuple(reversed([bus.id for bus in area.network.buses])),
        **dict(zip(("vm", "va", "sigma_vm", "sigma_va"), (*flat, sigmas, sigmas), strict=True)),
    )
    buses, branches = known.buses_and_branches({"area2": state, "area1": a_state(buses=(99,))}, {})
    assert len(buses) == 13
    assert len(branches) == len(scenario.network.branches)
    assert buses.vm_kv[buses.bus == 1] == 69.0
    assert np.isnan(buses.vm_pu[buses.bus == 9])[0]  # what a stranger said of bus 99 counts for nothing
    used = replace(USED, meters=("vm@1", "vm@999"))
    meters = Table("meters", known.collect_meters({"area2": state}, {"area2": used}, {}))
    assert len(meters) == sum(m.source != "virtual" for m in scenario.meters)
    assert (meters.meter[0], meters.status[0], meters.unit[0]) == ("vm@1", "used", "pu")
    assert set(zip(meters.area[1:], meters.status[1:], strict=True)) == {("area1", "not received"), ("area2", "silent")}


def test_the_columns_that_fit_a_terminal_are_those_one_looks_for():
    scenario = load_scenario("industrial13")
    known, watcher = GridTables(scenario), watching(a_state())
    used = {"area1": replace(USED, meters=("vm@1", "vm@3"))}
    buses, _ = known.buses_and_branches(watcher.states, {})
    meters = worst_first(Table("meters", known.collect_meters(watcher.states, used, {})))
    shown = known_columns(format_view(watcher.look(0.0), [meters]), "meter")
    assert shown[:5] == ["meter", "area", "status", "normalised_residual", "reading"]
    assert "estimate" in shown
    listed = format_view(watcher.look(0.0), [list_buses(watcher.states, {})])
    assert "name" not in known_columns(listed, "bus")
    assert "p_kw" not in known_columns(format_view(watcher.look(0.0), [buses]), "bus")  # nothing is known of it here


def known_columns(text: str, first: str) -> list[str]:
    """The heading of the table that begins with column ``first``; no line is wider than a terminal."""
    lines = text.splitlines()
    assert max(map(len, lines)) <= 80
    return next(line.split() for line in lines if line.split()[:1] == [first])


def test_json_has_all_that_the_text_has_and_unknown_numbers_are_null():
    watcher = watching(a_state(referenced=False))
    described = describe_view(watcher.look(0.0))["areas"]["area1"]
    assert described["worst_meter"] == {"value": 5.2, "at": "vm@1"}
    tables = describe_tables({"buses": list_buses(watcher.states, {})})
    assert tables["buses"]["va_deg"] == [None]


def test_the_split_of_the_area_files_is_shown_and_of_several_which_areas_have_which():
    one = SplitIdentity("1a2b3c4d5e6f7081", 1.7e9)
    other = replace(one, edited="9f8e7d6c5b4a3928")
    states = {name: published_by(name, Incarnation(1, 1), split=one) for name in ("area1", "area2", "area3")}
    alike, differing = (
        watching(*states.values()),
        watching(*{**states, "area2": replace(states["area2"], split=other)}.values()),
    )
    assert f"area files: {one}" in format_view(alike.look(0.0))
    text = " ".join(format_view(differing.look(0.0)).split())
    assert f"area files of 2 splits: {other}: area2; {one}: area1, area3" in text
    described = describe_view(differing.look(0.0))["areas"]["area2"]
    assert (described["split"], described["split_time"], described["split_edited"]) == (
        other.digest,
        1.7e9,
        other.edited,
    )


def test_files_of_the_next_split_are_shown_with_the_areas_that_have_them():
    following = SplitIdentity("9f8e7d6c5b4a3928", 1.7e9)
    states = [published_by(name, Incarnation(1, 1), next_split=following) for name in ("area1", "area3")]
    view = watching(*states, published_by("area2", Incarnation(1, 1))).look(0.0)
    text = " ".join(format_view(view).split())
    assert "files of the next split 9f8e7d6c lie ready in 2 of 3 areas: area1, area3" in text
    assert describe_view(view)["areas"]["area1"]["next_split"] == following.digest


def many(areas: int, buses: int) -> Watcher:
    """Areas side by side, the last one degraded; the voltages of each rise from 0.9 p.u."""
    names = [f"area{k + 1}" for k in range(areas)]
    flat = dict.fromkeys(("va", "sigma_vm", "sigma_va"), (0.001,) * buses)
    vm = tuple(0.9 + 0.004 * k for k in range(buses))
    return watching(
        *(
            published_by(
                name,
                Incarnation(1, 1),
                buses=tuple(range(buses * k, buses * (k + 1))),
                vm=vm,
                **flat,
                quality="degraded" if name == names[-1] else "good",
                notes=("a note that is longer than a line of a terminal " * 3,),
            )
            for k, name in enumerate(names)
        )
    )


@pytest.mark.parametrize(("width", "height"), [(80, 23), (120, 39), (60, 12), (40, 5)])
@pytest.mark.parametrize("areas", [1, 3, 40])
def test_nothing_is_cut_off_by_a_terminal_without_being_counted(width: int, height: int, areas: int):
    watcher = many(areas, 30)
    found = find_tables(watcher, watcher.look(0.0), None)
    tables = [found.buses, Table("meters", found.meters)]
    lines = [text for text, _ in fit_view(watcher.look(0.0), tables, width, height)]
    assert len(lines) <= height
    assert max(map(len, lines)) <= width
    left_out = [line for line in lines if line.startswith("... and ")]
    assert left_out
    assert all("--once shows all" in line for line in left_out)


def test_areas_that_are_not_good_come_first_where_not_all_fit():
    shown = [text for text, _ in fit_view(many(40, 3).look(0.0), [], 80, 23)]
    (first,) = (k for k, line in enumerate(shown) if line.startswith("area40 "))
    assert all(not line.startswith("area1 ") for line in shown[:first])
    whole = [text for text, _ in fit_view(many(3, 3).look(0.0), [], 80, 60)]
    assert [line.split()[0] for line in whole if line.startswith("area")][1:] == ["area1", "area2", "area3"]


def test_the_buses_that_are_shown_are_those_whose_voltages_are_farthest_off():
    table = list_buses(many(1, 51).states, {})
    lines = list(write_table(table, 80, 4))
    assert [line.split()[0] for line in lines[1:-1]] == ["0", "1", "49", "50"]
    assert lines[-1] == "... and 47 rows more: --once shows all"


def test_numbers_stand_under_one_another_and_none_needs_an_exponent():
    table = Table(
        "buses", {"bus": np.array([1, 20]), "vm_pu": np.array([1.0007, 0.9]), "p_kw": np.array([294597.4, -78.2])}
    )
    assert list(write_table(table, 80, None)) == ["bus   vm_pu    p_kw", "  1  1.0007  294597", " 20  0.9000     -78"]


def test_a_reading_in_per_unit_keeps_its_digits_beside_one_in_kw():
    table = Table("meters", {"meter": ("a", "b"), "reading": np.array([0.98765, 3210.4]), "unit": ("pu", "kw")})
    assert [line.split()[1] for line in write_table(table, 80, None)][1:] == ["0.98765", "3210.4"]
