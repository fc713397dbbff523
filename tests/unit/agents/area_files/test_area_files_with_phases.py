"""Area files of networks with phases: read back to the bit, covered by the split, and every mistake named."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.area_files.area_file import save_area_file, stamp_split
from agents.area_files.reader import load_area_file
from agents.protocol.configuration import Configuration
from dsse_core.errors import InvalidInputError
from dsse_core.grid.division import build_partition
from dsse_core.grid.gauge import Gauge
from dsse_core.grid.loads import Load
from dsse_core.link_faults import LinkFaults
from scenarios.files.network_file import load_case
from scenarios.generate.cutting import cut_at
from tests.support.phases import AREAS, RING, TIE, make_feeder, read_meters


def split(areas: dict[str, list[int]], *ties: Any) -> dict[str, Configuration]:
    """Area -> its configuration, of the feeder with a leg between two phases."""
    network = make_feeder(*ties)
    network = replace(network, loads=(*network.loads, Load(675, "ab", 0.1 + 0.2j, (2.0, 1.0))))
    partition = build_partition(network, areas)
    meters = partition.meters_by_area([m.meter for m in read_meters(network, 1, 1.0, is_rich=True)])
    files = [
        Configuration("run", area, meters[area.name], "information", ("tcp/127.0.0.1:7447",), links=links_of(area))
        for area in partition.areas
    ]
    return {content.area.name: content for content in stamp_split(files, 1.0)}


def links_of(area: Any) -> dict[str, LinkFaults]:
    return {n.area: LinkFaults() for n in area.neighbours}


def spoil(path: Path, content: Configuration, change: Callable[[Any], Any]) -> tuple[str, ...]:
    """What is said of ``content`` as a file that ``change`` was applied to."""
    save_area_file(path, content)
    table = json.loads(path.read_text())
    change(table)
    path.write_text(json.dumps(table))
    with pytest.raises(InvalidInputError, match=r"area\.json") as caught:
        load_area_file(path)
    return tuple(caught.value.problems)


@pytest.mark.parametrize("suffix", [".toml", ".json"])
@pytest.mark.parametrize("areas", [AREAS, RING])
def test_an_area_with_phases_is_read_back_to_the_bit(tmp_path: Path, areas: dict[str, list[int]], suffix: str):
    for name, content in split(areas, *([TIE] if areas is RING else [])).items():
        path = tmp_path / f"{name}{suffix}"
        save_area_file(path, content)
        found = load_area_file(path)
        assert found == content
        for read, written in zip(found.area.network.branches, content.area.network.branches, strict=True):
            assert read.primitive is not None
            assert written.primitive is not None
            assert read.primitive.y.tobytes() == written.primitive.y.tobytes()
            assert read.primitive.charging.tobytes() == written.primitive.charging.astype(complex).tobytes()
        assert found.identity.is_sound
        assert not found.identity.edited


@pytest.mark.parametrize("suffix", [".toml", ".json"])
def test_an_area_of_a_network_file_is_read_back_too(tmp_path: Path, suffix: str):
    network = load_case("ieee13")
    for area in build_partition(network, cut_at(network, ["632-670", "671-684"])).areas:
        (content,) = stamp_split([Configuration("run", area, (), "information", ("tcp/127.0.0.1:7447",))], 1.0)
        save_area_file(tmp_path / f"{area.name}{suffix}", content)
        found = load_area_file(tmp_path / f"{area.name}{suffix}")
        assert [branch.primitive for branch in found.area.network.branches] == [
            branch.primitive for branch in area.network.branches
        ]
        assert not found.identity.edited


@pytest.mark.parametrize("suffix", [".toml", ".json"])
def test_the_gauge_of_a_part_without_ground_is_read_back_and_names_buses_of_the_area(tmp_path: Path, suffix: str):
    content = split(AREAS)["east"]
    gauge = Gauge((692, 675), (692,), ((692, "a", 0.25, -0.5), (692, "b", 0.0, 0.5)))
    network = replace(content.area.network, gauge_of_whole=gauge)
    area = replace(content.area, network=network)  # without meters: those of voltages to ground would mean nothing
    path, content = tmp_path / f"area{suffix}", replace(content, area=area, meters=())
    save_area_file(path, content)
    assert load_area_file(path).area.network.gauge == gauge
    if suffix == ".json":
        problems = spoil(path, content, lambda table: table["network"]["gauge"]["pinned"].append(7))
        assert problems == ("network: the gauge names bus 7, which is not defined",)


@pytest.mark.parametrize(
    "change",
    [
        lambda network: network["branch"]["primitive"][0]["y"][0][0].__setitem__(1, 0.5),
        lambda network: network["load"]["exponents"][-1].__setitem__(0, 1.0),
        lambda network: network["load"]["phases"].__setitem__(-1, "bc"),
    ],
)
def test_an_edited_admittance_or_leg_is_no_longer_the_split(tmp_path: Path, change: Callable[[Any], Any]):
    path, content = tmp_path / "area.json", split(AREAS)["east"]
    save_area_file(path, content)
    table = json.loads(path.read_text())
    change(table["network"])
    path.write_text(json.dumps(table))
    assert load_area_file(path).identity.edited


def test_mistakes_of_phases_are_named_all_at_once(tmp_path: Path):
    def change(table: dict[str, Any]) -> None:
        table["neighbour"][0]["variables"] = ["s@671.ab>west", "v@671.ab"]
        table["exchange"]["no_load"].pop(1)
        table["meter"]["phases"][0] = "b"

    boundary, no_load, meter = spoil(tmp_path / "area.json", split(AREAS)["west"], change)
    assert boundary == (
        "neighbour[1].variables: has phases 'ab' at bus 671, which has 'ac' here; write them as the split has"
    )
    assert no_load == (
        "exchange.no_load: 4 voltages in another order; give 671.a, 671.c, 684.a, 684.c, 611.c, in this order"
    )
    assert meter.startswith("meter p_injection@684.b: phase b is not there, only a, c")


def test_mistakes_of_admittances_and_legs_are_named(tmp_path: Path):
    def change_shape(table: dict[str, Any]) -> None:
        table["network"]["branch"]["primitive"][0]["y"][0].pop()

    def change_phases(table: dict[str, Any]) -> None:
        table["network"]["branch"]["primitive"][0]["from_phases"] = "ab"
        table["network"]["load"]["phases"][0] = "b"

    content = split(AREAS)["west"]
    (shape,) = spoil(tmp_path / "area.json", content, change_shape)
    assert shape.startswith("network.branch.primitive[1].y: must be two square matrices of one size")
    branch, load = spoil(tmp_path / "area.json", content, change_phases)
    at = "network: branch 671-684 has phase b at bus 671, which lacks it"
    assert branch == f"{at}; leave it out of the branch, or add it to the bus"
    assert load == "network: a load at bus 611: phases is 'b'; name one or two of c"


def test_boundaries_without_phases_and_other_angles_of_the_substation_are_named(tmp_path: Path):
    content = split(AREAS)["head"]
    variables, angle = spoil(
        tmp_path / "area.json",
        content,
        lambda t: (t["neighbour"][0].pop("variables"), t["exchange"]["no_load"][1].__setitem__(2, 0.1)),
    )
    assert variables == (
        "neighbour[1].variables: has phases '' at bus 632, which has 'abc' here; write them as the split has"
    )
    assert angle == "exchange.no_load: 650.b is not at -2.0944 rad, where reference.va puts it"


def test_the_angles_of_a_split_are_those_of_the_substation_and_its_phases():
    area = split(AREAS)["head"].area
    assert area.reference == (650, 0.0)
    angles = [va for bus, _, va in area.no_load if bus == 650]
    assert angles == pytest.approx(np.radians([0.0, -120.0, 120.0]), abs=1e-12)
