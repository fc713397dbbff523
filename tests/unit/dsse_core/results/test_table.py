"""The table of results: named columns that cannot be changed."""

import copy
import pickle
import re
import sys

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.results.table import Table


def _table(n: int = 2) -> Table:
    columns = {"bus": np.arange(1, n + 1), "name": [f"north {k}" for k in range(n)], "vm_pu": np.linspace(1, 0.9, n)}
    return Table("buses", columns)


def test_a_column_is_read_by_attribute_and_by_name():
    table = _table()
    assert table.columns == ("bus", "name", "vm_pu")
    assert table.name == table["name"] == ("north 0", "north 1")
    assert table.vm_pu is table["vm_pu"]
    assert len(table) == 2
    assert list(table.rows()) == [(1, "north 0", 1.0), (2, "north 1", 0.9)]
    assert "vm_pu" in dir(table)


def test_a_result_cannot_be_changed_by_who_reads_it_or_who_made_it():
    made_from = np.array([1.0, 2.0])
    table = Table("buses", {"vm_pu": made_from})
    made_from[0] = 7.0
    assert table.vm_pu[0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        table.vm_pu[0] = 7.0
    with pytest.raises(AttributeError, match="cannot be changed"):
        table.vm_pu = made_from


def test_an_unknown_column_is_named_with_those_that_there_are():
    with pytest.raises(AttributeError, match=r"no column 'vm'; it has bus, name, vm_pu$"):
        _ = _table().vm
    with pytest.raises(KeyError, match="no column 'vm'"):
        _ = _table()["vm"]


def test_a_column_with_a_slip_in_its_name_is_suggested():
    with pytest.raises(AttributeError, match=r"; did you mean 'vm_pu'\?$"):
        _ = _table().v_pu


def test_a_table_is_written_as_text_to_a_path_and_to_a_file(tmp_path):
    table = Table("runs", {"faults.link[1].loss": np.array([0.25, np.nan]), "areas.x,y.p": ["a,b", ""]})
    text = 'faults.link[1].loss,"areas.x,y.p"\n0.25,"a,b"\n,\n'
    assert table.to_csv() == text
    table.to_csv(tmp_path / "a.csv")
    with (tmp_path / "b.csv").open("w", newline="") as file:
        table.to_csv(file)
    assert (tmp_path / "a.csv").read_text() == (tmp_path / "b.csv").read_text() == text


@pytest.mark.parametrize(
    "columns",
    [
        {"a": np.zeros(2), "b": np.zeros(3)},
        {"a": np.zeros((2, 2))},
        {"rows": np.zeros(2)},
        {"_a": np.zeros(2)},
        {"p kw": np.zeros(2)},
    ],
)
def test_what_is_no_table_is_none(columns):
    with pytest.raises(ValueError, match="column"):
        Table("x", columns)


def test_the_repr_of_a_large_table_has_a_few_lines():
    columns = {f"quantity_{k}_kw": np.random.default_rng(k).normal(size=100_000) for k in range(30)}
    lines = repr(Table("branches", columns)).splitlines()
    assert len(lines) < 10
    assert lines[0] == "branches: 100000 rows, 30 columns"
    assert repr(Table("areas", {})).splitlines()[0] == "areas: 0 rows, 0 columns"


def test_a_notebook_shows_the_first_rows_and_the_last_of_all_columns():
    shown = _table(1000)._repr_html_()
    assert re.findall(r"<tr><th>(.*?)</th>", shown) == ["", "0", "1", "2", "3", "4", "...", *map(str, range(995, 1000))]
    assert re.findall(r"<th>([a-z_]+)</th>", shown) == ["bus", "name", "vm_pu"]
    assert "buses: 1000 rows, 3 columns" in shown
    assert _table(10)._repr_html_().count("<tr>") == 11
    assert "areas: 0 rows" in Table("areas", {})._repr_html_()


def test_a_name_cannot_be_markup_in_a_notebook_nor_steer_a_terminal():
    table = Table("<b>", {"name": ["<script>alert(1)</script>", "\x1b[2Jaway", "Süd & Nord"]})
    shown = table._repr_html_()
    assert "<script" not in shown
    assert "<b>" not in shown
    assert "Süd &amp; Nord" in shown
    for text in (shown, repr(table)):
        assert "\x1b" not in text
        assert "Süd" in text


def test_a_table_survives_copying_and_pickling():
    for again in (pickle.loads(pickle.dumps(_table())), copy.deepcopy(_table())):
        assert list(again.rows()) == list(_table().rows())
        assert again.columns == _table().columns


def test_a_frame_has_the_columns_and_is_its_owners():
    frame = _table().to_pandas()
    assert list(frame.columns) == ["bus", "name", "vm_pu"]
    frame.loc[0, "vm_pu"] = 5.0
    assert _table().to_pandas()["vm_pu"].tolist() == [1.0, 0.9]


def test_without_pandas_the_cure_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(InvalidInputError, match="pip install pandas"):
        _table().to_pandas()
