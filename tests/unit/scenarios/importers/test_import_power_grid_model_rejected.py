"""Input of power-grid-model that the model cannot hold is rejected by its names, and nothing is dropped in silence."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from dsse_core.errors import InvalidInputError
from scenarios.importers import import_grid
from tests.support.power_grid_model_grids import (
    Data,
    problems_of,
    small_grid,
    table,
    utils,
)


def test_sources_of_separate_islands_are_reported_how_to_be_split(tmp_path: Path) -> None:
    data = small_grid()
    data["line"]["from_status"][:2] = 0
    data["line"]["to_status"][:2] = 0
    data["generic_branch"]["from_status"] = 0
    data["source"] = table("source", id=[50, 51], node=[1, 6], status=[1, 1], u_ref=[1.0, 1.0])
    text = problems_of(tmp_path, data)
    assert "2 islands have a substation each; import them one by one: take the sources of the other islands" in text
    assert "the island of source 50 at bus 1: bus 1, 2" in text
    assert "the island of source 51 at bus 6: bus 4, 5, 6, 9" in text


def test_everything_that_the_model_cannot_hold_is_named(tmp_path: Path) -> None:
    data = small_grid()
    data["source"] = table("source", id=[50, 51], node=[1, 6], status=[1, 1], u_ref=[1.0, 1.0])
    data["sym_load"]["type"][0] = 2
    text = problems_of(tmp_path, data)
    assert "source 50 at bus 1, source 51 at bus 6 feed one island" in text
    assert "sym_load 60: constant current" in text


def test_components_that_have_no_phases_are_rejected_beside_asymmetric_ones(tmp_path: Path) -> None:
    data = small_grid()
    data["asym_load"] = table(
        "asym_load", id=[90], node=[4], status=[1], type=[0], p_specified=[[1e3] * 3], q_specified=[[1e3] * 3]
    )
    assert "generic_branch 40: power-grid-model has none in asymmetric calculations" in problems_of(tmp_path, data)


def test_data_that_power_grid_model_finds_wrong_is_rejected_with_its_words(tmp_path: Path) -> None:
    data = small_grid()
    data["line"]["from_node"][0] = 77
    assert "power-grid-model: " in problems_of(tmp_path, data)


def test_a_missing_package_is_named_with_the_command_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "grid.json"
    utils.json_serialize_to_file(path, small_grid())
    monkeypatch.setitem(sys.modules, "power_grid_model.utils", None)
    with pytest.raises(InvalidInputError, match=r"pip install .*\[power-grid-model\]'"):
        import_grid(path)


def test_branches_without_impedance_are_rejected_by_their_names(tmp_path: Path) -> None:
    data = small_grid()
    data["line"]["r1"][1], data["line"]["x1"][1] = 1e-9, 0.0
    data["source"]["sk"] = 5e14
    text = problems_of(tmp_path, data)
    assert "branch 3-4 (line 31) has |r + jx| = 1e-11 p.u., the median branch " in text
    assert "branch 10-1 (source 50) has |r + jx| = 2e-09 p.u." in text
    assert "put a link in its place" in text


def changed_file(tmp_path: Path, change: Callable[[Data], object]) -> Path:
    """The file of ``small_grid``, its JSON changed."""
    path = tmp_path / "grid.json"
    utils.json_serialize_to_file(path, small_grid())
    tree = json.loads(path.read_text())
    change(tree)
    path.write_text(json.dumps(tree))
    return path


def test_no_attribute_is_dropped_in_silence(tmp_path: Path) -> None:
    def change(tree: Data) -> None:
        tree["data"]["source"][0]["Sk"] = tree["data"]["source"][0].pop("sk")
        for load in tree["data"]["sym_load"][:2]:
            load["foo"] = {"bar": [1]}

    with pytest.raises(InvalidInputError) as caught:
        import_grid(changed_file(tmp_path, change))
    assert sorted(caught.value.problems) == [
        "source 50: unknown attribute 'Sk', which power-grid-model would leave out; did you mean 'sk'?; correct or "
        "remove it, or put it under 'extra' if it describes",
        "sym_load 60, 61: unknown attribute 'foo', which power-grid-model would leave out; correct or remove it, or "
        "put it under 'extra' if it describes",
    ]


def test_an_unknown_attribute_of_compact_data_is_named_as_well(tmp_path: Path) -> None:
    path = changed_file(tmp_path, lambda tree: tree["attributes"].update(shunt=["id", "node", "status", "g1", "B1"]))
    with pytest.raises(InvalidInputError, match=r"shunt: unknown attribute 'B1'.*did you mean 'b1'"):
        import_grid(path)


def test_descriptions_are_left_out_and_reported(tmp_path: Path) -> None:
    def change(tree: Data) -> None:
        tree["data"]["node"][2]["extra"] = {"name": "Harbour"}
        tree["frequency"] = 60

    reported = {(remark.what, remark.text) for remark in import_grid(changed_file(tmp_path, change)).remarks}
    assert ("left out", "'extra' of node, which describes them") in reported
    assert ("left out", "beside the data: frequency, which power-grid-model does not know") in reported


@pytest.mark.parametrize(
    "change",
    [
        lambda tree: tree["data"].update(source={"id": 2}),
        lambda tree: tree["data"]["source"][0].update(sk="a\nb"),
        lambda tree: tree["data"].update(foo=[{"id": 3}]),
        lambda tree: tree.update(data=[], attributes=7),
        lambda tree: tree["data"].update(source=[7, None, []]),
    ],
)
def test_another_librarys_words_stand_on_one_line(tmp_path: Path, change: Callable[[Data], object]) -> None:
    with pytest.raises(InvalidInputError, match="power-grid-model cannot read it: ") as caught:
        import_grid(changed_file(tmp_path, change))
    assert "\\n" not in str(caught.value)
