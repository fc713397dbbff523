"""``dsse partition`` and ``dsse generate`` as a user meets them: tables, pictures, files, and what is rejected."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from coordinator.show.report.area_table import format_area_tables
from dsse_core.grid.division import build_partition
from scenarios.scenario import load_scenario
from tests.support.rings import tied33

PNG = b"\x89PNG"


def test_the_areas_of_a_scenario_are_printed_with_a_summary(dsse) -> None:
    code, out, _ = dsse("partition", "ieee33")
    lines = [" ".join(line.split()) for line in out.splitlines()]
    assert code == 0
    assert lines[:3] == [
        "area buses owned boundary buses parent variables children meters",
        "area1 13 13 6 - - area2, area3 52",
        "area2 13 12 6 area1 4 - 49",
    ]
    assert "the largest, area1, owns 13, the smallest, area3, 8; the mean is 11.0" in out
    assert "longest path of the tree: 3 areas" in out
    assert "boundary buses: 1 (3 % of all); at most 3 areas meet at one, at bus 6" in out


def test_another_cut_is_tried_without_touching_the_file_whatever_its_faults_name(dsse) -> None:
    code, out, _ = dsse("partition", "ieee33-load-error", "--areas", 2)
    assert code == 0
    assert "33 buses in 2 areas" in out


@pytest.mark.parametrize("switches", [["6-7", "--switches", "6-26"], ["6-7,6-26"], ["6-7, 6-26,"]])
def test_switches_are_named_one_by_one_or_with_commas(dsse, switches: list[str]) -> None:
    code, out, _ = dsse("partition", "ieee33", "--switches", *switches)
    assert code == 0
    assert "at most 3 areas meet at one, at bus 6" in out


def test_one_area_has_no_path_and_no_boundary(dsse) -> None:
    code, out, _ = dsse("partition", "ieee33", "--areas", 1)
    assert code == 0
    assert "path" not in out


@pytest.mark.parametrize("scenario", ["ieee33", "ieee33-thesis", "industrial13", "industrial13-thesis"])
def test_pasted_bus_lists_make_the_same_areas(scenario: str) -> None:
    partition = load_scenario(scenario).partition
    tables = tomllib.loads(format_area_tables(partition))["areas"]
    slacks = {name: (t["slack_bus"], t["slack_vm_pu"]) for name, t in tables.items() if "slack_bus" in t}
    again = build_partition(partition.network, {name: table["buses"] for name, table in tables.items()}, slacks)
    assert again.areas == partition.areas


def test_pasted_bus_lists_of_a_grid_with_ties_name_the_areas_that_hold_them() -> None:
    partition = tied33(5).partition
    tables = tomllib.loads(format_area_tables(partition))["areas"]
    assert {name: table["holds"] for name, table in tables.items() if "holds" in table} == {
        **{"area1": ["21-8"], "area2": ["25-29"], "area3": ["9-15"], "area5": ["12-22", "18-33"]}
    }
    buses, slacks = ({n: t[key] for n, t in tables.items() if key in t} for key in ("buses", "slack_bus"))
    holders = {branch: name for name, table in tables.items() for branch in table.get("holds", ())}
    again = build_partition(
        partition.network, buses, {n: (bus, tables[n]["slack_vm_pu"]) for n, bus in slacks.items()}, holders
    )
    assert again.areas == partition.areas


def test_toml_is_all_that_is_printed_when_it_is_asked_for(dsse, tmp_path: Path) -> None:
    code, out, _ = dsse("partition", "ieee33", "--areas", 4, "--toml", "--out", tmp_path / "areas.svg")
    assert code == 0
    assert list(tomllib.loads(out)["areas"]) == ["area1", "area2", "area3", "area4"]
    assert (tmp_path / "areas.svg").stat().st_size > 0


def test_areas_are_drawn_into_a_new_folder(dsse, tmp_path: Path) -> None:
    picture = tmp_path / "new" / "areas.png"
    code, out, _ = dsse("partition", "industrial13", "--out", picture)
    assert code == 0
    assert picture.read_bytes().startswith(PNG)
    assert f"picture: {picture}" in out


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("--areas", "3", "--switches", "6-7"), "give one of them"),
        (("--areas", "0"), "0 is not in the range"),
        (("--areas", "99"), "at most 32"),
        (("--switches", "6-77"), "did you mean '6-7'?"),
        (("--out", "areas.bmp"), "none of the endings .png, .pdf, .svg"),
    ],
)
def test_what_cannot_be_cut_or_drawn_is_rejected(dsse, options: tuple[str, ...], reason: str) -> None:
    code, out, err = dsse("partition", "ieee33", *options)
    assert (code, out) == (2, "")
    assert reason in err


def test_a_generated_feeder_passes_the_check_and_is_not_overwritten(dsse, tmp_path: Path) -> None:
    arguments = ("generate", "--buses", 40, "--seed", 3, "--areas", 4, "--out", tmp_path / "feeder")
    code, out, _ = dsse(*arguments)
    assert code == 0
    scenario = tmp_path / "feeder" / "scenario.toml"
    assert f"next: dsse run {scenario}" in out
    code, out, _ = dsse("check", scenario)
    assert code == 0
    assert "40 buses, 39 branches in service" in out
    before = scenario.read_bytes()
    code, _, err = dsse(*arguments)
    assert code == 2
    assert "network.toml is there already" in err
    assert "scenario.toml is there already" in err
    assert scenario.read_bytes() == before


def test_the_generated_scenario_says_by_which_command(dsse, tmp_path: Path) -> None:
    dsse("generate", "--buses", 12, "--pv", 2, "--meters", "sparse", "--out", tmp_path / "one")
    first = (tmp_path / "one" / "scenario.toml").read_text().splitlines()[0]
    command = first.partition("dsse ")[2].split()
    assert dsse(*command, "--out", tmp_path / "two")[0] == 0
    for name in ("network.toml", "scenario.toml"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("--buses", "1"), "1 is not in the range"),
        (("--buses", "20", "--lowest-vm", "0.5"), "ask for 0.85 to 1.0 p.u."),
        (("--buses", "20", "--lowest-vm", "nan"), "ask for 0.85 to 1.0 p.u."),
        (("--buses", "20", "--pv", "20"), "ask for fewer"),
        (("--buses", "5", "--areas", "5"), "ask for fewer"),
    ],
)
def test_what_cannot_be_generated_is_rejected(dsse, tmp_path: Path, options: tuple[str, ...], reason: str) -> None:
    code, _, err = dsse("generate", *options, "--out", tmp_path / "feeder")
    assert code == 2
    assert reason in err
    assert not (tmp_path / "feeder").exists()
