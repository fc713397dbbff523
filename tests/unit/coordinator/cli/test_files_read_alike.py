"""Every kind of file with tables is rejected in the same words, with the same counting, all problems at once."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from itertools import permutations
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from agents.area_files.area_file import save_area_file
from agents.area_files.reader import load_area_file
from agents.security.access import Access
from agents.security.access_file import load_access, save_access
from coordinator.lab.deployment.split import area_files
from dsse_core.errors import InvalidInputError
from scenarios.files.network_file import load_network
from scenarios.files.shipped_files import find_shipped
from scenarios.scenario import load_scenario


def area(path: Path) -> None:
    save_area_file(path, area_files(load_scenario("industrial13"), "run", ["tcp/127.0.0.1:7447"])[0])


def scenario(path: Path) -> None:
    path.write_bytes(find_shipped("shipped")["industrial13-lossy"].read_bytes())


def network(path: Path) -> None:
    path.write_bytes(find_shipped("cases")["industrial13"].read_bytes())


def access(path: Path) -> None:
    save_access(path, Access("run", {"a": ("b",), "b": ("a",)}))


KINDS: dict[str, tuple[Callable[[Path], None], Callable[[Path], object], str]] = {
    "scenario file": (scenario, load_scenario, "network"),
    "network file": (network, load_network, "base_mva"),
    "area file": (area, load_area_file, "exchange"),
    "access file": (access, load_access, "run"),
}


def spoilt(tmp_path: Path, kind: str, change: Callable[[dict[str, Any]], None]) -> InvalidInputError:
    """What is said of a file of ``kind`` that ``change`` was applied to."""
    path = tmp_path / "mine.toml"
    write, read, _ = KINDS[kind]
    write(path)
    read(path)
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    change(table)
    path.write_text(tomli_w.dumps(table), encoding="utf-8")
    with pytest.raises(InvalidInputError) as caught:
        read(path)
    return caught.value


@pytest.mark.parametrize("kind", KINDS)
def test_unknown_missing_and_wrong_keys_do_not_depend_on_the_kind_of_file(tmp_path: Path, kind: str) -> None:
    required = KINDS[kind][2]

    def change(table: dict[str, Any]) -> None:
        table[required + "s"] = 1
        del table[required]

    error = spoilt(tmp_path, kind, change)
    unknown, missing = sorted(error.problems, reverse=True, key=lambda problem: "unknown" in problem)
    assert error.what.startswith(f"{kind} {tmp_path / 'mine.toml'}")
    assert unknown.startswith(f"{required}s: unknown key; allowed here: ")
    assert unknown.endswith(f"; did you mean {required!r}?")
    assert missing.startswith(f"{required}: missing; ")


@pytest.mark.parametrize(
    ("kind", "where", "key"),
    [
        ("scenario file", lambda t: t["measurements"]["injection"], "measurements.injection.sigma_percent"),
        ("network file", lambda t: t["bus"][1], "bus[2].base_kv"),
        ("area file", lambda t: t["network"]["bus"][1], "network.bus[2].base_kv"),
    ],
)
def test_a_number_in_quotes_is_no_number_in_any_file_and_items_count_from_1(
    tmp_path: Path, kind: str, where: Callable[[dict[str, Any]], dict[str, Any]], key: str
) -> None:
    error = spoilt(tmp_path, kind, lambda table: where(table).update({key.rpartition(".")[2]: "12"}))
    assert error.problems[0].startswith(f"{key}: must be a valid number, found '12'")
    assert ("(items of lists count from 1)" in str(error)) == ("[2]" in key)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("text", ["x = 1\nx = 2\n", "run = "])
def test_a_key_given_twice_or_no_toml_is_rejected_in_the_same_words(tmp_path: Path, kind: str, text: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(InvalidInputError) as caught:
        KINDS[kind][1](path)
    (problem,) = caught.value.problems
    assert problem.startswith("not valid TOML: ")


@pytest.mark.parametrize(("kind", "other"), list(permutations(KINDS, 2)))
def test_a_file_of_another_kind_is_called_by_its_name(tmp_path: Path, kind: str, other: str) -> None:
    path = tmp_path / "mine.toml"
    KINDS[other][0](path)
    with pytest.raises(InvalidInputError) as caught:
        KINDS[kind][1](path)
    (problem,) = caught.value.problems
    assert f"{other}, which " in problem
    assert problem.endswith(f"give {'an' if kind[0] == 'a' else 'a'} {kind}")


def test_limits_of_times_and_numbers_are_those_of_scenarios(tmp_path: Path) -> None:
    def change(table: dict[str, Any]) -> None:
        table |= {"beat_s": 1e6, "seed": -1}
        table["admm"]["penalty"] = 1e9

    problems = spoilt(tmp_path, "area file", change).problems
    assert sorted(p.partition(":")[0] for p in problems) == ["admm.penalty", "beat_s", "seed"]


def test_a_number_that_no_grid_has_does_not_reach_an_agent(tmp_path: Path) -> None:
    def change(table: dict[str, Any]) -> None:
        table["network"]["branch"][0]["r"] = 1e200
        table["strategy"] = "infomation"

    (problem,) = spoilt(tmp_path, "area file", change).problems
    assert problem.startswith("network: branch ")
    assert "r is 1e+200 p.u.; it must lie between" in problem


def test_an_unknown_strategy_of_an_area_is_named_beside_its_other_problems(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    area(path)
    text = path.read_text().replace('"information"', '"infomation"')
    path.write_text(text.replace("bus = ", "bus = 9", 1))
    with pytest.raises(InvalidInputError) as caught:
        load_area_file(path, ("admm", "information"))
    assert len(caught.value.problems) == 2
    assert (
        "strategy: unknown strategy 'infomation'; allowed: admm, information; did you mean 'information'?"
        in caught.value.problems
    )
