"""Files that would hang, exhaust or take over the reader are rejected as every other mistake is."""

from __future__ import annotations

import importlib
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_file import LARGEST_TOML, read_text
from dsse_core.files.wording import MOST_COMPARISONS
from dsse_core.grid.measurement import MeasurementKind
from scenarios.files.network_file import load_case, load_network
from scenarios.files.readings.file import load_readings
from scenarios.importers import import_grid
from scenarios.scenario import load_scenario
from tests.support.levels import further
from tests.support.pandapower_tables import ONE_WORKER, make_tables_once

READERS = [
    ("scenario.toml", load_scenario),
    ("readings.csv", lambda path: load_readings(path, load_case("ieee33"))),
    ("case.m", import_grid),
    ("grid.json", import_grid),
]
HOSTILE = {
    "a folder": lambda path: path.mkdir(),
    "a pipe": os.mkfifo,
    "a loop of links": lambda path: path.symlink_to(path),
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "random bytes": lambda path: path.write_bytes(bytes(range(256)) * 4),
    "UTF-16": lambda path: path.write_bytes("version = 1".encode("utf-16")),
    "deep arrays": lambda path: path.write_text("x = " + "[" * 100_000),
    "deep JSON": lambda path: path.write_text("[" * 100_000),
    "a long integer": lambda path: path.write_text("x = " + "9" * 1_000_000),
    "a long integer in JSON": lambda path: path.write_text('{"x": ' + "9" * 1_000_000 + "}"),
    "nothing": lambda path: path.write_text(""),
}


@pytest.mark.parametrize("hostile", HOSTILE)
@pytest.mark.parametrize(("name", "read"), READERS, ids=[name for name, _ in READERS])
def test_what_is_no_file_of_its_kind_is_one_error(tmp_path: Path, name: str, read, hostile: str):
    HOSTILE[hostile](tmp_path / name)
    with pytest.raises(InvalidInputError) as caught:
        read(tmp_path / name)
    assert len(str(caught.value)) < 5000
    assert "set_int_max_str_digits" not in str(caught.value)


def test_a_file_over_the_limit_is_rejected_with_the_limit(tmp_path: Path):
    path = tmp_path / "scenario.toml"
    with path.open("wb") as file:
        file.truncate(LARGEST_TOML + 1)
    with pytest.raises(InvalidInputError, match="the limit is 16,777,216"):
        load_scenario(path)
    assert len(read_text(path)) == LARGEST_TOML + 1  # others may be larger


# pandapower builds what a file names


@pytest.fixture
def evil(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A file that appears when module ``evil_module`` is imported."""
    (tmp_path / "evil_module.py").write_text(
        f"import pathlib\npathlib.Path({str(tmp_path / 'taken_over')!r}).touch()\nclass Evil: pass\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path / "taken_over"
    sys.modules.pop("evil_module", None)


EVIL = {"_module": "evil_module", "_class": "Evil", "_object": "{}"}
TABLE = {"_module": "pandas.core.frame", "_class": "DataFrame", "orient": "split", "dtype": {}}


def in_a_cell(content: object) -> dict[str, object]:
    return TABLE | {"_object": json.dumps({"columns": ["object"], "index": [0], "data": [[content]]})}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (EVIL, "evil_module"),
        ([[EVIL]], "evil_module"),
        (in_a_cell(EVIL), "evil_module"),
        (in_a_cell(TABLE | {"_object": json.dumps(EVIL)}), "evil_module"),
        (EVIL | {"_class": "function", "_object": "Evil"}, "class 'function'"),
        (EVIL | {"_module": "pandapower.control.basic_controller", "_class": "function"}, "class 'function'"),
        ({"_module": "os", "_class": "system", "_object": "true"}, "'os', class 'system'"),
        ({"_module": ["evil_module"], "_class": "Evil"}, "one text each is expected"),
        (TABLE | {"_object": "/etc/hostname.json"}, "no JSON but '/etc/hostname.json'"),
        (TABLE | {"_object": "{}", "compression": "gzip"}, "the key 'compression'"),
    ],
)
def test_a_pandapower_file_that_names_foreign_objects_is_rejected_unread(
    tmp_path: Path, evil: Path, content, words: str
):
    path = tmp_path / "net.json"
    net = {"_module": "pandapower.auxiliary", "_class": "pandapowerNet", "_object": {"bus": content}}
    path.write_text(json.dumps(net))
    with pytest.raises(InvalidInputError) as caught:
        import_grid(path)
    assert words in str(caught.value)
    assert not evil.exists()
    assert "evil_module" not in sys.modules


def test_a_module_named_twice_or_in_escapes_is_seen_too(tmp_path: Path, evil: Path):
    path = tmp_path / "net.json"
    for text in (
        '{"_module": "builtins", "_module": "evil_module", "_class": "Evil"}',
        '{"_modul\\u0065": "evil_module", "_class": "Evil"}',
    ):
        path.write_text(
            '{"_class": "pandapowerNet", "_module": "pandapower.auxiliary", "_object": {"bus": ' + text + "}}"
        )
        with pytest.raises(InvalidInputError, match=r"evil_module|given twice"):
            import_grid(path)
    assert not evil.exists()


LENIENT = {
    "a number with a zero before it": ("[0]", "[00]"),
    "a raw end of line in a text": ("index_name", "index\nname"),
    "a raw tab in a text": ("index_name", "index\tname"),
    "a key given twice": ('"index":', '"index": [5], "index":'),
    "half of a character": ('"_module"', '"\\ud800_module"'),
    "no number": ("[0]", "[NaN]"),
    "a mark of the order of bytes": ("{", "\ufeff{"),
    "another end of the text": ("}]]}", "}]]} //"),
}


@pytest.mark.parametrize("kind", ["DataFrame", "Series"])
@pytest.mark.parametrize("name", LENIENT)
def test_a_text_that_pandas_reads_and_python_does_not_names_no_module(tmp_path: Path, evil: Path, name: str, kind: str):
    strict, lenient = LENIENT[name]
    text = json.dumps({"index": [0], "columns": ["object"], "data": [[{"index_name": 1} | EVIL]]})
    assert strict in text
    table = TABLE | {"_class": kind, "_module": "pandas", "_object": text.replace(strict, lenient, 1)}
    net = {"_module": "pandapower.auxiliary", "_class": "pandapowerNet", "_object": {"bus": table}}
    path = tmp_path / "net.json"
    path.write_text(json.dumps(net))
    with pytest.raises(InvalidInputError, match=r"evil_module|no JSON"):
        import_grid(path)
    assert not evil.exists()
    assert "evil_module" not in sys.modules


@ONE_WORKER
@pytest.mark.slow
def test_pandapower_is_handed_what_was_written_anew_and_not_the_text_of_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    networks = pytest.importorskip("pandapower.networks")
    make_tables_once()
    pandapower = importlib.import_module("pandapower")
    net = json.loads(pandapower.to_json(networks.case4gs()))
    bus = net["_object"]["bus"]
    bus["_object"] = (
        json.dumps(json.loads(bus["_object"]), indent=3).replace("\n", "\r\n").replace('"geo"', '"\\u0067eo"')
    )
    path = tmp_path / "net.json"
    path.write_text("\n" + json.dumps(net, indent=2))
    handed: list[str] = []
    read = pandapower.from_json_string
    monkeypatch.setattr(pandapower, "from_json_string", lambda text: handed.append(text) or read(text))
    assert len(import_grid(path).network.buses) == 4
    (text,) = handed
    assert text == json.dumps(json.loads(text))
    inner = json.loads(text)["_object"]["bus"]["_object"]
    assert inner == json.dumps(json.loads(inner))


def test_power_grid_model_is_handed_what_was_written_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    utils = pytest.importorskip("power_grid_model.utils")
    handed: list[str] = []
    monkeypatch.setattr(utils, "json_deserialize", lambda text: handed.append(text) or {})
    head = '"version": "1.0", "type": "input", "is_batch": false, "attributes": {}, '
    (tmp_path / "grid.json").write_text("{ " + head + '"data": {"no\\u0064e": [{"id" : 1}]} }')
    with pytest.raises(InvalidInputError):
        import_grid(tmp_path / "grid.json")
    assert handed == ["{" + head + '"data": {"node": [{"id": 1}]}}']
    (tmp_path / "grid.json").write_text("{ " + head + '"data": {"node": [{"id": 1, "id": 2}]} }')
    with pytest.raises(InvalidInputError, match="key 'id' is given twice"):
        import_grid(tmp_path / "grid.json")


@ONE_WORKER
@pytest.mark.slow
def test_a_name_that_only_begins_like_json_is_a_name(tmp_path: Path):
    networks = pytest.importorskip("pandapower.networks")
    make_tables_once()
    net = networks.case4gs()
    net.bus["name"] = ["[old] bus", "{x", '{"_module": "x"}', "[00]"]
    importlib.import_module("pandapower").to_json(net, str(tmp_path / "net.json"))
    assert [bus.name for bus in import_grid(tmp_path / "net.json").network.buses] == list(net.bus["name"])


@ONE_WORKER
@pytest.mark.slow
@pytest.mark.parametrize("index", [10**12, *further([], "a", 1.5, -1)])
def test_an_index_that_is_none_or_would_fill_the_memory_is_named(tmp_path: Path, index):
    networks = pytest.importorskip("pandapower.networks")
    make_tables_once()
    net = json.loads(importlib.import_module("pandapower").to_json(networks.case4gs()))
    table = json.loads(net["_object"]["bus"]["_object"])
    table["index"][0] = index
    net["_object"]["bus"]["_object"] = json.dumps(table)
    path = tmp_path / "net.json"
    path.write_text(json.dumps(net))
    with pytest.raises(InvalidInputError, match=r"an index is a whole number|cannot read it"):
        import_grid(path)


@ONE_WORKER
@pytest.mark.slow
def test_the_module_would_be_imported_by_pandapower_itself(evil: Path):
    """What the allow-list is for; if this fails, pandapower has become careful itself."""
    pandapower = pytest.importorskip("pandapower")
    net = {"_module": "pandapower.auxiliary", "_class": "pandapowerNet", "_object": {"bus": EVIL}}
    with pytest.raises(Exception):  # noqa: B017, PT011  # it rejects to build the class, but only after the import
        pandapower.from_json_string(json.dumps(net))
    assert evil.exists()


def test_a_network_file_of_json_with_a_key_twice_is_rejected(tmp_path: Path):
    path = tmp_path / "network.json"
    path.write_text('{"name": "a", "base_mva": 1, "base_mva": 100}')
    with pytest.raises(InvalidInputError, match="not valid JSON: key 'base_mva' is given twice; keep one of them"):
        load_network(path)


def test_twenty_thousand_unknown_ids_are_not_all_compared_with_all_ids(monkeypatch: pytest.MonkeyPatch):
    compared = []

    def count(word: str, words, n: int) -> list[str]:
        compared.append(len(words))
        return []

    monkeypatch.setattr("dsse_core.files.wording.get_close_matches", count)
    unknown = [f"x{k}" for k in range(20_000)]
    switches = {"areas": {"switches": unknown}}
    with pytest.raises(InvalidInputError) as caught:
        load_scenario("ieee33", changes=switches)
    gross = [{"meter": name, "sigmas": 1.0} for name in unknown]
    with pytest.raises(InvalidInputError) as caught_too:
        load_scenario("ieee33", changes={"telemetry.gross_error": gross})
    assert len(caught.value.problems) == len(caught_too.value.problems) == 20_000
    assert 0 < sum(compared) <= 2 * MOST_COMPARISONS


def test_wrong_names_do_not_each_list_all_right_ones():
    links = [{"from": "x", "to": f"y{k}", "loss": 0.1} for k in range(50)]
    with pytest.raises(InvalidInputError) as caught:
        load_scenario("ieee33", changes={"areas": {"count": 30}, "faults": {"link": links}})
    assert "areas: area1, area2, " in str(caught.value)
    assert all(len(problem) < 300 for problem in caught.value.problems)


@pytest.mark.slow
def test_a_file_of_unknown_keys_is_answered_with_the_first_and_the_number_of_the_others(tmp_path: Path):
    """It took 54 MB of text, and a search for what each may have been."""
    path = tmp_path / "scenario.toml"
    path.write_text("\n".join(f"nam{i} = 1" for i in range(30_000)))
    with pytest.raises(InvalidInputError) as caught:
        load_scenario(path)
    assert len(str(caught.value)) < 50_000
    assert len(caught.value.problems) > 30_000
    assert sum("did you mean" in problem for problem in caught.value.problems) <= MOST_COMPARISONS / 10


def test_readings_of_unknown_kinds_are_answered_as_briefly(tmp_path: Path):
    path = tmp_path / "readings.csv"
    path.write_text("meter,value_pu,sigma_pu\n" + "".join(f"vmm{i}@1,1,1\n" for i in range(30_000)))
    with pytest.raises(InvalidInputError) as caught:
        load_readings(path, load_case("ieee33"))
    assert len(str(caught.value)) < 50_000
    assert sum("did you mean" in problem for problem in caught.value.problems) <= MOST_COMPARISONS / len(
        MeasurementKind
    )
