"""An area file as JSON: a list of values for each key of buses, branches, generators and meters."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from agents.area_files.area_file import save_area_file
from agents.area_files.reader import load_area_file
from agents.protocol.configuration import Configuration
from coordinator.lab.deployment.split import area_files
from dsse_core.errors import InvalidInputError
from dsse_core.estimation.state_limits import StateLimits
from dsse_core.grid.division import build_partition
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.link_faults import LinkFaults
from scenarios.scenario import load_scenario
from tests.support.rings import tied33
from tests.support.simulated_bus import area_files_of


@pytest.fixture
def content() -> Configuration:
    return area_files(load_scenario("industrial13"), "run", ["tcp/127.0.0.1:7447"])[0]


def spoilt(path: Path, content: Configuration, change: Any) -> tuple[str, ...]:
    """What is said of ``content`` as a file that ``change`` was applied to."""
    save_area_file(path, content)
    table = json.loads(path.read_text())
    change(table)
    path.write_text(json.dumps(table))
    with pytest.raises(InvalidInputError) as caught:
        load_area_file(path)
    return tuple(caught.value.problems)


@pytest.mark.parametrize("suffix", [".toml", ".json"])
def test_what_was_written_is_read_back(tmp_path: Path, content: Configuration, suffix: str):
    path = tmp_path / f"area{suffix}"
    save_area_file(path, content)
    assert load_area_file(path) == content


def test_every_wrong_value_of_a_list_is_named_with_its_place(tmp_path: Path, content: Configuration):
    def change(table: dict[str, Any]) -> None:
        table["network"]["branch"]["r"][2] = "much"
        table["meter"]["kind"][0] = "temperature"
        table["network"]["bus"]["colour"] = ["red"]

    colour, r, kind = spoilt(tmp_path / "area.json", content, change)
    assert r.startswith("network.branch.r[3]: ")
    assert "'much'" in r
    assert kind.startswith("meter.kind[1]: ")
    assert colour == (
        "network.bus.colour: unknown key; allowed here: id, base_kv, name, p_load, q_load, g_shunt, b_shunt, x, y, "
        "phases"
    )


def test_lists_of_different_lengths_and_missing_ones_are_named(tmp_path: Path, content: Configuration):
    n = len(content.meters)

    def change(table: dict[str, Any]) -> None:
        table["meter"]["bus"].pop()
        del table["network"]["branch"]["from_bus"]

    missing, lengths = spoilt(tmp_path / "area.json", content, change)
    assert missing == "network.branch.from_bus: missing"
    assert lengths.startswith(f"meter: the lists need as many values each; kind has {n}, bus has {n - 1}")


def test_a_list_where_one_table_belongs_is_rejected(tmp_path: Path, content: Configuration):
    (problem,) = spoilt(tmp_path / "area.json", content, lambda t: t.update(meter=[{"kind": "vm", "bus": 1}]))
    assert problem == "meter: must be a table, found a list of 1 table (the area's meters)"


@pytest.mark.parametrize("text", ['version = 1\nnetwork = "ieee33"\n', 'name = "x"\n[[bus]]\nid = 1\n', ""])
def test_who_gives_another_kind_of_file_is_reported_what_writes_area_files(tmp_path: Path, text: str):
    (tmp_path / "other.toml").write_text(text)
    with pytest.raises(
        InvalidInputError, match=r"area file .*other.toml, which `dsse split SCENARIO --out DIR` writes"
    ):
        load_area_file(tmp_path / "other.toml")


def test_a_neighbour_that_is_given_twice_would_be_believed_twice(tmp_path: Path, content: Configuration):
    problems = spoilt(tmp_path / "area.json", content, lambda t: t["neighbour"].append(t["neighbour"][0]))
    assert f"neighbour[2].area: {content.area.neighbours[0].area} is given twice; keep one" in problems


def test_what_is_wrong_with_the_network_names_the_file(tmp_path: Path, content: Configuration):
    path = tmp_path / "area.json"
    first = content.area.network.buses[0].id

    def change(table: Any) -> None:
        table["network"]["bus"]["id"][1] = first

    assert f"network: bus {first} is defined more than once; give each bus its own id" in spoilt(path, content, change)
    with pytest.raises(InvalidInputError, match=r"area\.json"):
        load_area_file(path)


def test_a_key_that_is_given_twice_in_json_is_rejected_as_in_toml(tmp_path: Path, content: Configuration):
    path = tmp_path / "area.json"
    save_area_file(path, content)
    path.write_text(path.read_text().replace('"run":', '"run":"other","run":', 1))
    with pytest.raises(InvalidInputError, match="not valid JSON: key 'run' is given twice; keep one of them"):
        load_area_file(path)


def test_angles_count_from_the_substation_and_from_no_bus_beside(tmp_path: Path):
    areas = area_files(load_scenario("industrial13"), "run", ["tcp/127.0.0.1:7447"])
    (other,) = (area for area in areas if area.area.reference is None)
    bus = other.area.network.buses[-1].id
    (problem,) = spoilt(tmp_path / "a.json", other, lambda t: t.update(reference={"bus": bus, "va": 0.0}))
    assert problem.startswith(f"reference.bus: bus {bus} is not the substation, from which all angles count")


def test_an_area_behind_the_substation_that_counts_angles_from_it_is_read_back(tmp_path: Path, content: Configuration):
    """The bus of the substation belongs to another area, which this one meets there."""
    buses = tuple(Bus(id=k, base_kv=20.0, p_load=0.1) for k in (1, 2, 3))
    branches = tuple(Branch(f"1-{k}", 1, k, r=0.01, x=0.01) for k in (2, 3))
    network = Network("star", 1.0, buses, branches, (Generator(1, Control.SLACK),))
    for area in build_partition(network, {"one": [1, 2], "two": [1, 3]}).areas:
        assert area.reference == (1, 0.0)
        save_area_file(tmp_path / "a.json", replace(content, area=area, meters=(), links={}))
        assert load_area_file(tmp_path / "a.json").area == area


def test_a_band_of_voltages_that_is_empty_is_rejected(tmp_path: Path, content: Configuration):
    def change(table: dict[str, Any]) -> None:
        table["quality"]["lowest_vm"] = 1.5

    (problem,) = spoilt(tmp_path / "area.json", content, change)
    assert problem == "quality: lowest_vm is 1.5; it must be below highest_vm, 1.5"


@pytest.mark.parametrize("suffix", [".toml", ".json"])
def test_limits_and_lies_are_read_back(tmp_path: Path, content: Configuration, suffix: str):
    lie = LinkFaults(lie_p=0.1, lie_scale=1.1, lie_objective=0.0, lie_areas=3, lie_worst="vm@1", lie_verdict="final")
    changed = replace(content, links=content.links | {"area2": lie}, limits=StateLimits(0.8, 1.1, 0.05))
    save_area_file(tmp_path / f"area{suffix}", changed)
    assert load_area_file(tmp_path / f"area{suffix}") == changed


@pytest.mark.parametrize("suffix", [".toml", ".json"])
def test_names_and_ratings_of_some_branches_are_read_back(tmp_path: Path, content: Configuration, suffix: str):
    network = content.area.network
    first, second, *others = network.branches
    branches = (replace(first, name="north", i_max=0.3), replace(second, s_max=2.5), *others)
    rated = replace(content, area=replace(content.area, network=replace(network, branches=branches)))
    path = tmp_path / f"area{suffix}"
    save_area_file(path, rated)
    assert load_area_file(path) == rated


def ring_of_two() -> Configuration:
    """The area behind the substation's of two that meet at buses 2 and 3."""
    buses = tuple(Bus(id=k, base_kv=20.0, p_load=0.1) for k in (1, 2, 3, 4))
    ends = ((1, 2), (1, 3), (2, 4), (3, 4))
    branches = tuple(Branch(f"{f}-{t}", f, t, r=0.01, x=0.01, tap=1.02 if t == 2 else 1.0) for f, t in ends)
    network = Network("ring", 1.0, buses, branches, (Generator(1, Control.SLACK),))
    area = build_partition(network, {"one": [1, 2, 3], "two": [2, 3, 4]}).area("two")
    return Configuration("run", area, (), "information", ("tcp/127.0.0.1:7447",), links={"one": LinkFaults()})


@pytest.mark.parametrize("suffix", [".toml", ".json"])
def test_an_area_that_meets_its_parent_at_several_buses_is_read_back(tmp_path: Path, suffix: str):
    path, content = tmp_path / f"area{suffix}", ring_of_two()
    assert [bus for bus, _, _ in content.area.no_load] == [2, 3]
    save_area_file(path, content)
    assert load_area_file(path) == content


@pytest.mark.parametrize("suffix", [".toml", ".json"])
def test_an_area_with_an_open_tie_and_buses_that_it_relays_is_read_back(tmp_path: Path, suffix: str):
    scenario = tied33(5, closed=())
    for content in area_files_of(scenario):
        save_area_file(path := tmp_path / f"area{suffix}", content)
        assert load_area_file(path) == content
    area3 = scenario.partition.area("area3")
    assert area3.relayed == {2, 22, 29, 33}
    assert "9-15" in area3.network.branch_ids


@pytest.mark.parametrize(
    ("names", "problem"),
    [
        (
            ["s@2>two", "v@2", "s@3>two"],
            "has other voltages than v@2, v@3 behind its powers; write them as the split has",
        ),
        (["s@2>two", "s@9>two", "v@2", "v@9"], "bus 9 is not in the network"),
        (["s@3>two", "v@3"], "lacks bus 2, where these areas meet"),
    ],
)
def test_variables_that_two_areas_do_not_share_are_named(tmp_path: Path, names: list[str], problem: str):
    found = spoilt(tmp_path / "a.json", ring_of_two(), lambda t: t["neighbour"][0].update(variables=names))
    assert found[0] == f"neighbour[1].variables: {problem}"


def test_a_voltage_of_the_unloaded_grid_at_a_bus_elsewhere_is_rejected(tmp_path: Path):
    (problem,) = spoilt(tmp_path / "a.json", ring_of_two(), lambda t: t["exchange"]["no_load"][0].__setitem__(0, 9))
    assert problem == "exchange.no_load: bus 9 is not in the network"
