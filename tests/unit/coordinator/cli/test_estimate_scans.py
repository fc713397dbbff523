"""``dsse estimate --readings``: many scans of one grid in one file, each estimated, each failure named."""

import csv
import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from coordinator.lab.evaluation.scan_estimates import (
    estimate_scans,
    estimate_whole_grid,
    load_scans_of,
    with_one_scan,
)
from dsse_core.errors import InvalidInputError
from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.grid.measurement import Measurement, Meter, Source
from dsse_core.results.results import TABLES, results_of_estimate
from dsse_core.results.table import Table
from scenarios.files.readings.file import save_readings
from scenarios.files.readings.written import as_readings_text
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry

Dsse = Callable[..., tuple[int, str, str]]
SCENARIO = load_scenario("ieee33")


def readings_of(scan: int) -> list[Measurement]:
    return [m for m in make_telemetry(SCENARIO, scan).union if m.meter.source is not Source.VIRTUAL]


def write_scans(folder: Path, scans: dict[str, list[Measurement]]) -> Path:
    path, rows = folder / "many.csv", []
    for name, readings in scans.items():
        save_readings(folder / "one.csv", SCENARIO.network, readings)
        rows += [{"meter": row["meter"], "scan": name} | row for row in table_of((folder / "one.csv").read_text())]
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, max(rows, key=len).keys(), restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return path


def table_of(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_each_scan_has_the_estimate_that_it_has_alone(tmp_path: Path, dsse: Dsse) -> None:
    spoilt = [Measurement(m.meter, m.value + 30 * m.sigma * (k == 5), m.sigma) for k, m in enumerate(readings_of(3))]
    scans = {"10:00": readings_of(1), "10:15": readings_of(2), "10:30": spoilt}
    path = write_scans(tmp_path, scans)
    code, out, err = dsse("estimate", "ieee33", "--readings", str(path), "--csv", "scans")
    buses = table_of(dsse("estimate", "ieee33", "--readings", str(path), "--csv", "buses")[1])
    assert (code, err) == (0, "")
    virtual = [m for m in make_telemetry(SCENARIO).union if m.meter.source is Source.VIRTUAL]
    for row, (name, readings) in zip(table_of(out), scans.items(), strict=True):
        alone = process_bad_data(SCENARIO.network, [*readings, *virtual], tolerance=SCENARIO.tolerances.estimator)
        assert row["scan"] == name
        assert float(row["objective"]) == pytest.approx(alone.objective, rel=1e-9)
        assert row["removed_meters"].split() == [removed.measurement.meter.id for removed in alone.removed]
        assert row["undecided_meters"].split() == [meter for _, *others in alone.undecided for meter in others]
        found = [float(bus["vm_pu"]) for bus in buses if bus["scan"] == name]
        np.testing.assert_allclose(found, alone.result.vm, rtol=0, atol=1e-9)
    assert table_of(out)[2]["removed"] != "0"


def test_the_tables_of_many_scans_are_those_of_each_scan_alone_to_the_bit(tmp_path: Path) -> None:
    spoilt = [replace(m, value=m.value + 30 * m.sigma * (k == 5)) for k, m in enumerate(readings_of(3))]
    scans = {"2026-11-26T10:00Z": readings_of(1), "2026-11-26T10:15Z": readings_of(2)[:-1], "third": spoilt}
    many = estimate_scans(SCENARIO, load_scans_of(SCENARIO, write_scans(tmp_path, scans))).tables
    assert len(many.scans) == 3
    for k, (name, readings) in enumerate(scans.items()):
        save_readings(tmp_path / "one.csv", SCENARIO.network, readings)
        loaded = with_one_scan(SCENARIO, load_scans_of(SCENARIO, tmp_path / "one.csv"))
        alone = results_of_estimate(
            estimate_whole_grid(loaded)[0], partition=SCENARIO.partition, meters=many_meters(many.meters)
        )
        for title in TABLES:
            whole, one = getattr(many, title), getattr(alone, title)
            here = slice(k * len(one), (k + 1) * len(one))
            assert len(whole) == 3 * len(one)
            assert whole.columns == one.columns
            assert set(whole.scan[here]) == {name}
            for column in set(one.columns) - {"scan", "time", "quality"}:
                assert np.array_equal(whole[column][here], one[column], equal_nan=is_number(one[column])), column
    assert many.buses.time[0] == np.datetime64("2026-11-26T10:00:00.000")
    assert np.isnat(many.buses.time[-1])
    assert set(many.meters.status[: len(many.meters) // 3]) == {"used"}
    assert many.meters.status.count("silent") == many.meters.status.count("removed") == 1
    assert set(many.areas.quality) == {"good"}


def many_meters(meters: Table) -> list[Meter]:
    ids = dict.fromkeys(meters.meter)
    by_id = {meter.id: meter for meter in SCENARIO.meters}
    return [by_id[each] for each in ids]


def is_number(column: object) -> bool:
    return isinstance(column, np.ndarray) and column.dtype.kind == "f"


def test_a_scan_without_estimate_has_its_readings_and_nothing_that_follows(tmp_path: Path) -> None:
    few = [m for m in readings_of(2) if m.meter.kind == "vm"]
    path = write_scans(tmp_path, {"a": readings_of(1), "b": few})
    many = estimate_scans(SCENARIO, load_scans_of(SCENARIO, path)).tables
    assert np.isnan(many.buses.vm_pu[33:]).all()
    assert not np.isnan(many.buses.vm_pu[:33]).any()
    assert np.isnan(many.branches.p_from_kw[len(many.branches) // 2 :][SCENARIO.network.table.in_service]).all()
    second = [k for k, scan in enumerate(many.meters.scan) if scan == "b"]
    assert (~np.isnan(many.meters.value_pu[second])).sum() == len(few)
    assert np.isnan(many.meters.estimate_pu[second]).all()
    assert many.areas.quality == ("good",) * 3 + ("none",) * 3


def test_tables_of_many_scans_are_written_and_the_meters_are_readings_again(tmp_path: Path, dsse: Dsse) -> None:
    path = write_scans(tmp_path, {"2026-11-26T10:00": readings_of(1), "2026-11-26T10:15": readings_of(2)})
    out = tmp_path / "out"
    assert dsse("estimate", "ieee33", "--readings", str(path), "--out", str(out), "--parquet")[0] == 0
    names = {"scans", "buses", "branches", "meters", "areas"}
    assert len(table_of((out / "areas.csv").read_text())) == 2 * len(SCENARIO.partition.areas)
    assert {each.stem for each in out.glob("*.csv")} == {each.stem for each in out.glob("*.parquet")} == names
    again = dsse("estimate", "ieee33", "--readings", str(out / "meters.csv"), "--csv", "scans")[1]
    first, second = (table_of(text) for text in ((out / "scans.csv").read_text(), again))
    for ours, theirs in zip(first, second, strict=True):
        assert ours["time"] == theirs["time"] == theirs["scan"]
        assert float(ours["objective"]) == pytest.approx(float(theirs["objective"]), rel=1e-9)


@pytest.mark.parametrize(("named", "words"), [(True, "say where with --out DIR"), (False, "a single scan has no")])
def test_figures_need_a_folder_and_many_scans(tmp_path: Path, dsse: Dsse, named: bool, words: str) -> None:
    path = tmp_path / "one.csv"
    save_readings(path, SCENARIO.network, readings_of(1))
    if named:
        path = write_scans(tmp_path, {"a": readings_of(1)})
    code, _, err = dsse("estimate", "ieee33", "--readings", str(path), "--format", "pdf")
    assert code == 2
    assert words in err


def test_tables_that_are_too_large_are_one_error_before_anything_is_written(
    tmp_path: Path, dsse: Dsse, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_scans(tmp_path, {"a": readings_of(1), "b": readings_of(2)})
    monkeypatch.setattr("dsse_core.results.scans.MOST_CELLS", 10_000)
    code, _, err = dsse("estimate", "ieee33", "--readings", str(path), "--out", str(tmp_path / "out"))
    assert code == 2
    assert "the limit is 10,000; divide the readings" in err
    assert not (tmp_path / "out").exists()
    assert dsse("estimate", "ieee33", "--readings", str(path), "--csv", "scans")[0] == 0


def test_a_scan_without_estimate_is_named_and_the_others_are_estimated(tmp_path: Path, dsse: Dsse) -> None:
    few = [m for m in readings_of(2) if m.meter.kind == "vm"]
    path = write_scans(tmp_path, {"a": readings_of(1), "b": few, "c": readings_of(3)})
    code, out, _ = dsse("estimate", "ieee33", "--readings", str(path), "--out", str(tmp_path / "out"))
    assert code == 1
    assert "2 of 3 scans estimated" in out
    assert "no estimate of scan b: " in out
    content = json.loads((tmp_path / "out" / "result.json").read_text())
    assert content["estimates"]["failed"] == {"b": "unobservable"}
    rows = table_of((tmp_path / "out" / "scans.csv").read_text())
    assert [row["status"] for row in rows] == ["estimated", "failed", "estimated"]
    assert rows[1]["objective"] == rows[1]["lowest_vm_pu"] == ""


def test_a_dead_voltmeter_is_left_out_of_its_scan(tmp_path: Path, dsse: Dsse) -> None:
    dead = [Measurement(m.meter, 0.0, m.sigma) if m.meter.id == "vm@1" else m for m in readings_of(2)]
    path = write_scans(tmp_path, {"a": readings_of(1), "b": dead})
    code, out, _ = dsse("estimate", "ieee33", "--readings", str(path), "--csv", "scans")
    assert code == 0
    assert [row["removed_meters"] for row in table_of(out)] == ["", "vm@1"]


def test_readings_without_scans_are_one_scan_with_all_tables(tmp_path: Path, dsse: Dsse) -> None:
    save_readings(tmp_path / "one.csv", SCENARIO.network, readings_of(1))
    code, out, _ = dsse("estimate", "ieee33", "--readings", str(tmp_path / "one.csv"), "--csv", "branches")
    assert code == 0
    assert len(table_of(out)) == len(SCENARIO.network.branches)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("meter,scan,value_pu,sigma_pu\nvm@1,,1,0.01\n", "line 2: column scan is empty"),
        (
            "meter,scan,value_pu,sigma_pu\nvm@1,a,1,0.01\nvm@1,b,1,0.01\nvm@1,a,1,0.01\n",
            "line 4: meter vm@1 has a reading of scan 'a' in line 2 already",
        ),
        (
            "meter,value_pu,scan,sigma_pu\nvm@1,1,a,0.01\n",
            "line 1: after 'meter' and, of many scans, 'scan' come pairs",
        ),
        ("meter,scan,value_pu,sigma_pu\n", "there is no reading"),
    ],
)
def test_mistakes_in_a_file_of_scans_are_named(tmp_path: Path, dsse: Dsse, text: str, problem: str) -> None:
    (tmp_path / "many.csv").write_text(text)
    code, _, err = dsse("estimate", "ieee33", "--readings", str(tmp_path / "many.csv"))
    assert code == 2
    assert problem in err


@pytest.mark.parametrize("command", [("powerflow", "ieee33"), ("estimate", "ieee33")])
def test_there_are_no_scans_without_a_file_of_scans(dsse: Dsse, command: tuple[str, ...]) -> None:
    code, _, err = dsse(*command, "--csv", "scans")
    assert code == 2
    assert "--csv scans" in err


def test_a_scenario_is_not_a_file_of_scans(tmp_path: Path, dsse: Dsse) -> None:
    write_scans(tmp_path, {"a": readings_of(1)})
    text = 'version = 1\ndescription = "x"\nnetwork = "ieee33"\nareas = { count = 1 }\nstrategy = "information"\n'
    (tmp_path / "x.toml").write_text(f'{text}[telemetry]\nsource = "file"\nfile = "many.csv"\n')
    code, _, err = dsse("estimate", str(tmp_path / "x.toml"))
    assert code == 2
    assert "--readings" in err


def test_scans_are_in_the_order_of_their_times_and_two_of_one_time_are_an_error(tmp_path: Path) -> None:
    late, early = "2026-11-26T10:15+01:00", "2026-11-26T09:00Z"
    assert load_scans_of(SCENARIO, write_scans(tmp_path, {late: readings_of(1), early: readings_of(2)})).names == (
        early,
        late,
    )
    unordered = {late: readings_of(1), "b": readings_of(2), "a": readings_of(3), early: readings_of(4)}
    assert load_scans_of(SCENARIO, write_scans(tmp_path, unordered)).names == tuple(unordered)
    same = {"b": readings_of(1), "2026-11-26T10:00+01:00": readings_of(2), early: readings_of(3)}
    with pytest.raises(InvalidInputError, match=r"10:00\+01:00' and '2026-11-26T09:00Z' are at the same time"):
        load_scans_of(SCENARIO, write_scans(tmp_path, same))


def test_a_table_of_meters_names_scans_of_one_time_by_their_scan() -> None:
    ends = ["1,2026-11-26T10:00", "2,2026-11-26T10:00", "3,", "4,2026-11-26T11:00"]
    rows = [f"vm@1,telemetered,1.0,0.01,{end}" for end in ends]
    text = as_readings_text("\n".join(["meter,source,value_pu,sigma_pu,scan,time", *rows]))
    assert [row["scan"] for row in table_of(text)] == ["1", "2", "3", "2026-11-26T11:00"]
