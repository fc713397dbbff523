"""``areas`` of a scenario file: bus lists, a count or switches; faults name the areas that come out."""

from __future__ import annotations

from pathlib import Path

import pytest

from dsse_core.errors import InvalidInputError
from scenarios.files.shipped_files import find_shipped
from scenarios.scenario import Scenario, load_scenario

GOOD = find_shipped("shipped")["ieee33"].read_text(encoding="utf-8")
HEAD, TAIL = GOOD[: GOOD.index("[areas.area1]")], GOOD[GOOD.index("[measurements]") :]
HEAD_OF_AREAS = GOOD[len(HEAD) : -len(TAIL)]
RING = """
name = "ring"
data_source = "made up"
base_mva = 1.0
bus = [{ id = 1, base_kv = 10.0 }, { id = 2, base_kv = 10.0 }, { id = 3, base_kv = 10.0 }, { id = 4, base_kv = 10.0 }]
branch = [
    { from = 1, to = 2, r_pu = 0.01, x_pu = 0.01 },
    { from = 2, to = 3, r_pu = 0.01, x_pu = 0.01 },
    { from = 3, to = 4, r_pu = 0.01, x_pu = 0.01 },
    { from = 4, to = 1, r_pu = 0.01, x_pu = 0.01 },
]
source = [{ bus = 1, kind = "slack", vm_pu = 1.0 }]
"""


def load(tmp_path: Path, areas: str, more: str = "", head: str = HEAD) -> Scenario:
    path = tmp_path / "mine.toml"
    path.write_text(f"{head}{areas}\n\n{TAIL}\n{more}", encoding="utf-8")
    return load_scenario(path)


def problems_of(tmp_path: Path, areas: str, more: str = "", head: str = HEAD) -> tuple[str, ...]:
    with pytest.raises(InvalidInputError) as caught:
        load(tmp_path, areas, more, head)
    return caught.value.problems


def test_a_count_cuts_the_network(tmp_path: Path) -> None:
    scenario = load(tmp_path, "areas = { count = 5 }")
    assert [area.name for area in scenario.partition.areas] == ["area1", "area2", "area3", "area4", "area5"]


def test_ties_count_as_open_where_areas_are_cut_and_are_held_though_they_are_open(tmp_path: Path) -> None:
    partition = load(tmp_path, 'areas = { count = 5, ties = ["9-15", "18-33"] }').partition
    held = {branch: area.name for area in partition.areas for branch in area.network.branch_ids}
    assert (held["9-15"], held["18-33"]) == (partition.owner_of_bus[9], partition.owner_of_bus[18])
    (problem,) = problems_of(tmp_path, 'areas = { count = 5, ties = ["9-16"] }')
    assert problem == "areas: ties: there is no branch 9-16"


def test_an_area_holds_the_branches_that_it_names(tmp_path: Path) -> None:
    lists = HEAD_OF_AREAS.replace("[areas.area3]", '[areas.area3]\nholds = ["18-33"]')
    partition = load(tmp_path, lists).partition
    assert "18-33" in partition.area("area3").network.branch_ids
    assert partition.owner_of_bus[18] == "area2"
    twice = lists.replace("[areas.area2]", '[areas.area2]\nholds = ["18-33"]')
    (problem,) = problems_of(tmp_path, twice)
    assert problem == "areas: branch 18-33 is in holds 2 times; keep one"


def test_a_count_of_one_is_the_whole_network(tmp_path: Path) -> None:
    assert len(load(tmp_path, "[areas]\ncount = 1").partition.area("area1").network.buses) == 33


def test_switches_cut_the_network(tmp_path: Path) -> None:
    partition = load(tmp_path, 'areas = { switches = ["6-7", "6-26"] }').partition
    assert partition.boundaries == {6: ("area1", "area2", "area3")}


def test_bus_lists_may_have_areas_called_count_and_switches(tmp_path: Path) -> None:
    partition = load(
        tmp_path, HEAD_OF_AREAS.replace("areas.area2", "areas.count").replace("area3", "switches")
    ).partition
    assert [area.name for area in partition.areas] == ["area1", "count", "switches"]


def test_faults_name_the_areas_that_were_cut(tmp_path: Path) -> None:
    faults = (
        "[faults]\nloss = 0.1\n[faults.load_error.area3]\np_mw = 1.0\nq_mvar = 0.0\n"
        '[[faults.link]]\nfrom = "area2"\nto = "area1"\nloss = 0.5\n'
    )
    scenario = load(tmp_path, 'areas = { switches = ["6-7", "6-26"] }', faults)
    assert scenario.load_error == {"area1": 0, "area2": 0, "area3": 0.1}
    assert scenario.faults.links["area2", "area1"].loss == 0.5
    problems = problems_of(tmp_path, "areas = { count = 2 }", faults)
    assert problems == ("faults.load_error.area3: there is no area 'area3'; areas: area1, area2; 'all' means each",)


def test_a_gap_of_the_areas_of_a_cut_is_reported_beside_other_problems(tmp_path: Path) -> None:
    areas = "areas = { count = 33 }"
    problems = problems_of(tmp_path, areas, '[[telemetry.gross_error]]\nmeter = "vm@99"\nsigmas = 3.0\n')
    assert problems[0].startswith("areas: 33 areas are asked for")
    assert "at most 32" in problems[0]
    assert problems[1] == "telemetry.gross_error[1].meter: meter vm@99: bus 99 is not in network 'ieee33'"


def test_wrong_switches_are_reported_with_their_key(tmp_path: Path) -> None:
    assert problems_of(tmp_path, 'areas = { switches = ["6-77"] }') == (
        "areas: there is no branch '6-77'; did you mean '6-7'?",
    )


@pytest.mark.parametrize(
    ("areas", "expected"),
    [
        ("areas = { count = 0 }", ["areas.count: must be greater than or equal to 1, found 0"]),
        ('areas = { count = "3" }', ["areas.count: must be a valid integer, found '3'"]),
        (
            "areas = { cuont = 3 }",
            ["areas.count: missing", "areas.cuont: unknown key; allowed here: count, ties; did you"],
        ),
        ('areas = { count = 3, switches = ["6-7"] }', ["areas.count: unknown key; allowed here: switches"]),
        (
            "[areas]\ncount = 2\n[areas.area1]\nbuses = [1]",
            ["areas: give count or the buses of each area, found count and the areas area1"],
        ),
        ("areas = { switches = [] }", ["areas.switches: must have at least 1 item, found []"]),
        ("areas = { switches = [67] }", ["areas.switches[1]: must be a valid string, found 67"]),
        ("areas = 3", ["areas: must be a table, found 3 (one [areas.NAME] with its buses for each area, or { count"]),
    ],
)
def test_every_wrong_key_of_areas_is_reported(tmp_path: Path, areas: str, expected: list[str]) -> None:
    problems = problems_of(tmp_path, areas)
    assert len(problems) == len(expected)
    for problem, start in zip(problems, expected, strict=True):
        assert problem.startswith(start)


def test_bus_lists_may_form_a_ring(tmp_path: Path) -> None:
    (tmp_path / "ring.toml").write_text(RING, encoding="utf-8")
    head = HEAD.replace('network = "ieee33"', 'network = "ring.toml"')
    areas = "[areas.a]\nbuses = [4, 1, 2]\n[areas.b]\nbuses = [2, 3]\n[areas.c]\nbuses = [3, 4]"
    assert not any(problem.startswith("areas: ") for problem in problems_of(tmp_path, areas, head=head))


def test_a_ring_cannot_be_cut_by_count_nor_at_a_switch(tmp_path: Path) -> None:
    (tmp_path / "ring.toml").write_text(RING, encoding="utf-8")
    head = HEAD.replace('network = "ieee33"', 'network = "ring.toml"')
    assert any("at most 1" in p for p in problems_of(tmp_path, "areas = { count = 2 }", head=head))
    problems = problems_of(tmp_path, 'areas = { switches = ["2-3"] }', head=head)
    assert any("areas: branch 2-3 lies in a loop with" in p for p in problems)
