"""A file knows of which split it is, and that it was edited."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from agents.area_files.area_file import save_area_file, stamp_split
from agents.area_files.reader import load_area_file
from agents.protocol.configuration import Configuration
from agents.protocol.configuration_digest import LEFT_OUT
from coordinator.lab.deployment.split import area_files
from dsse_core.errors import InvalidInputError
from dsse_core.split_identity import NO_SPLIT, SplitIdentity
from scenarios.scenario import load_scenario

WHERE = ("run", ["tcp/127.0.0.1:7447"])


def files_of(name: str = "ieee33") -> list[Configuration]:
    return area_files(load_scenario(name), *WHERE)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "area2.json"
    save_area_file(path, files_of()[1])
    return path


def edit(path: Path, change: Any) -> SplitIdentity:
    table = json.loads(path.read_text())
    change(table)
    path.write_text(json.dumps(table))
    return load_area_file(path).identity


def test_the_same_scenario_gives_the_same_split_on_any_machine_at_any_time():
    """The digest was noted once; it changes with what an area file says, and then all files are split anew."""
    first, *others = [content.identity for content in files_of()]
    assert first.is_sound
    assert all(other == first for other in others)
    (later,) = {content.identity for content in area_files(load_scenario("ieee33"), "other", WHERE[1], time=0.0)}
    assert later == first
    assert first.digest == "a76424312b341fd2"


@pytest.mark.parametrize("name", ["ieee33", "industrial13", "case33bw"])
@pytest.mark.parametrize("suffix", [".toml", ".json"])
def test_a_file_that_is_read_is_of_the_split_that_wrote_it(tmp_path: Path, name: str, suffix: str):
    for content in files_of(name):
        path = tmp_path / f"{content.area.name}{suffix}"
        save_area_file(path, content)
        read = load_area_file(path)
        assert read.identity == content.identity
        assert read.split is not None
        assert content.split is not None
        assert read.split.time == content.split.time


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("run", "other"),
        ("endpoints", ["tcp/192.0.2.7:7447"]),
        ("listen", ["tcp/0.0.0.0:7448"]),
        ("beat_s", 0.5),
        ("seed", 7),
        ("clock_error_s", 0.5),
    ],
)
def test_what_concerns_the_process_may_be_edited(saved: Path, key: str, value: object):
    assert edit(saved, lambda table: table.update({key: value})).is_sound


def test_every_other_key_of_a_file_enters_its_digest(saved: Path):
    """Each number and word of the file is changed in turn, with what is left out as the only exception."""
    original = json.loads(saved.read_text())
    places = list(list_places(original))
    assert len(places) > 25
    changed = {}
    for place in places:
        table = json.loads(json.dumps(original))
        *way, last = place
        inner = table
        for step in way:
            inner = inner[step]
        inner[last] = altered(inner[last])
        saved.write_text(json.dumps(table))
        try:
            changed[place] = not load_area_file(saved).identity.is_sound
        except InvalidInputError:  # such a file cannot be: no agent starts with it
            continue
    unseen = {".".join(step for step in place if isinstance(step, str)) for place, seen in changed.items() if not seen}
    assert unseen <= LEFT_OUT
    assert {"network.branch.r", "network.branch.to_bus", "meter.kind", "tolerance"} <= {
        ".".join(step for step in place if isinstance(step, str)) for place, seen in changed.items() if seen
    }


def list_places(value: Any, way: tuple[Any, ...] = ()) -> Any:
    """The way to the first value of each key."""
    if isinstance(value, dict):
        for key, part in value.items():
            if way or key != "split":
                yield from list_places(part, (*way, key))
    elif isinstance(value, list):
        if value:
            yield from list_places(value[0], (*way, 0))
    else:
        yield way


def altered(value: Any) -> Any:
    match value:
        case bool():
            return not value
        case int():
            return value + 1
        case float():
            return value * 1.25 + 0.001
        case "vm":
            return "va"
        case _:
            return f"{value}x"


def test_another_rule_of_standard_deviations_is_another_split():
    files = files_of()
    one, other = (stamp_split(files, 0.0, {"floor": floor})[0] for floor in (1e-3, 2e-3))
    assert one.identity != other.identity


def test_minus_zero_and_whole_numbers_are_the_numbers_that_files_give_back():
    content = files_of()[0]
    network = content.area.network
    first, *rest = network.branches
    for zero in (0.0, 0, -0.0):
        same = replace(network, branches=(replace(first, g=zero, shift=zero), *rest))
        assert replace(content, area=replace(content.area, network=same)).identity == content.identity


def test_a_file_without_a_split_is_read_and_has_none(saved: Path):
    assert edit(saved, lambda table: table.pop("split")) == NO_SPLIT
