"""The tables of a run: flows and injections of the areas' states, and what is empty where an area is silent."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import asdict, fields, replace
from pathlib import Path

import numpy as np
import pytest

from coordinator.lab.evaluation.result import RunResult, write_files
from coordinator.lab.evaluation.run_tables import make_run_tables
from coordinator.lab.simulator.simulate import simulate_scenario
from coordinator.watch.tables import tables_as_json, write_parquet
from dsse_core.errors import InvalidInputError
from dsse_core.grid.columns import Records
from dsse_core.grid.measurement import Measurement
from dsse_core.results.results import TABLES, results_of_estimate
from dsse_core.results.table import Table


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    return simulate_scenario("ieee33", tmp_path_factory.mktemp("run") / "out")


def without(ran: RunResult, area: str) -> RunResult:
    """The same run, in which nobody has heard of ``area``."""
    published = {name: state for name, state in ran.comparison.published.items() if name != area}
    return fresh(ran, published)


def fresh(ran: RunResult, published) -> RunResult:
    values = {field.name: getattr(ran, field.name) for field in fields(ran)}
    return RunResult(**values | {"comparison": replace(ran.comparison, published=published)})


def assert_close(ours: Table, theirs: Table, columns: list[str], atol: float) -> None:
    for column in columns:
        np.testing.assert_allclose(ours[column], theirs[column], rtol=0, atol=atol, err_msg=column)


def test_areas_that_agree_have_the_tables_of_the_centralised_estimate(ran: RunResult):
    partition, meters = ran.scenario.partition, ran.scenario.meters
    central = results_of_estimate(ran.centralised, partition=partition, meters=meters)
    for name in TABLES:
        ours, theirs = getattr(ran.tables, name), getattr(central, name)
        assert ours.columns == theirs.columns
        numbers = [c for c in ours.columns if isinstance(ours[c], np.ndarray) and ours[c].dtype.kind == "f"]
        in_si = [c for c in numbers if c.endswith(("_kw", "_kvar", "_a"))]
        assert_close(ours, theirs, in_si, 1e-4)
    sigmas = [c for c in ran.tables.branches.columns if c.startswith("sigma_")]
    assert len(sigmas) == 8
    assert not any(np.isnan(ran.tables.branches[c]).any() for c in sigmas)
    assert ran.tables.meters.status == central.meters.status
    sigmas = [c for c in ran.tables.areas.columns if c.startswith("sigma_")]
    assert len(sigmas) == 8
    assert not any(np.isnan(ran.tables.areas[c]).any() for c in sigmas)


def test_a_centralised_estimate_by_other_statuses_of_switches_lends_no_standard_deviations(ran: RunResult):
    network, report = ran.scenario.network, ran.centralised
    branches = tuple(replace(b, switch=b.id == "18-33") for b in network.branches)
    plan = replace(report.result.plan, network=replace(network, branches=branches))
    tables = replace(ran, centralised=replace(report, result=replace(report.result, plan=plan))).tables
    assert np.isnan(tables.branches.sigma_p_from_kw).all()
    assert not np.isnan(tables.buses.sigma_vm_kv).any()


def test_the_balance_of_every_area_is_even_and_imports_add_up_to_nothing(ran: RunResult):
    areas = ran.tables.areas
    for unit in ("kw", "kvar"):
        made, drawn, lost, came = (areas[f"{what}_{unit}"] for what in ("generation", "load", "loss", "import"))
        np.testing.assert_allclose(made + came, drawn + lost, rtol=0, atol=1e-3)  # of the mismatch at boundaries
        assert came.sum() == pytest.approx(0.0, abs=1e-9)


def test_an_area_without_estimate_is_unknown_and_spoils_no_other(ran: RunResult):
    whole, tables = ran.tables, without(ran, "area3").tables
    in_area3 = np.array([area == "area3" for area in tables.buses.area])
    assert np.isnan(tables.buses.vm_kv[in_area3]).all()
    assert np.isnan(tables.buses.sigma_p_kw[in_area3]).all()
    assert not np.isnan(tables.buses.vm_kv[~in_area3]).any()
    assert np.isnan(tables.areas.loss_kw).tolist() == [False, False, True]
    assert tables.areas.loss_kw[1] == whole.areas.loss_kw[1]
    assert np.isnan(tables.areas.sigma_loss_kw).tolist() == np.isnan(tables.areas.load_kw).tolist()
    branches = {branch.id for branch in ran.scenario.partition.area("area3").network.branches}
    unknown = [branch for branch, p in zip(tables.branches.branch, tables.branches.p_from_kw, strict=True) if p != p]
    assert set(unknown) == branches
    owned = [area == "area3" for area in tables.buses.area]
    boundary = np.isnan(tables.buses.p_kw) & ~np.array(owned)
    assert boundary.sum() == 1  # what goes on from there is not known


def test_angles_that_count_from_nowhere_still_give_flows(ran: RunResult):
    published = dict(ran.comparison.published)
    state = published["area2"]
    published["area2"] = replace(state, va=state.va + 1.0, referenced=False)
    tables = fresh(ran, published).tables
    in_area2 = np.array([area == "area2" for area in tables.buses.area])
    assert np.isnan(tables.buses.va_deg).tolist() == in_area2.tolist()
    assert_close(tables.branches, ran.tables.branches, ["p_from_kw", "i_to_a", "loss_kvar"], 1e-6)
    assert_close(tables.areas, ran.tables.areas, ["import_kw", "load_kvar"], 1e-6)


def test_where_an_area_states_another_deviation_nothing_is_derived_from_the_centralised_one(ran: RunResult):
    sigma = replace(ran.comparison.sigma, vm=ran.comparison.sigma.vm * np.where(np.arange(33) == 17, 1.01, 1.0))
    values = {field.name: getattr(ran, field.name) for field in fields(ran)}
    tables = RunResult(**values | {"comparison": replace(ran.comparison, sigma=sigma)}).tables
    assert np.isnan(tables.buses.sigma_p_kw).nonzero()[0].tolist() == [17]
    unknown = np.isnan(tables.branches.sigma_p_from_kw).nonzero()[0]
    ends = [(tables.branches.from_bus[k], tables.branches.to_bus[k]) for k in unknown]
    assert ends
    assert all(18 in pair for pair in ends)
    of_area = [area == tables.buses.area[17] for area in tables.areas.area]
    assert np.isnan(tables.areas.sigma_load_kw).tolist() == of_area
    assert not np.isnan(tables.areas.load_kw).any()


def test_every_table_of_a_run_folder_reads_back_to_the_last_digit(ran: RunResult):
    for name in TABLES:
        table = getattr(ran.tables, name)
        with (ran.folder / f"{name}.csv").open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        assert tuple(rows[0]) == table.columns
        assert len(rows) == len(table)
        for column in table.columns:
            kept = table[column]
            if isinstance(kept, tuple):
                assert tuple(row[column] for row in rows) == kept
            elif kept.dtype.kind == "f":
                read = [float(row[column]) if row[column] else math.nan for row in rows]
                assert np.array_equal(read, kept, equal_nan=True)
        assert set(table.phase) == {"abc"}


def test_json_has_null_and_no_nan_where_nothing_is_known(ran: RunResult):
    content = json.loads(json.dumps(tables_as_json(without(ran, "area3").tables), allow_nan=False))
    assert list(content) == list(TABLES)
    assert content["areas"][2]["loss_kw"] is None
    assert content["branches"][0]["in_service"] is True
    assert content["buses"][0]["bus"] == 1


def test_parquet_has_the_same_columns_and_null_for_what_is_unknown(ran: RunResult, tmp_path: Path):
    parquet = pytest.importorskip("pyarrow.parquet")
    write_parquet(tmp_path, without(ran, "area3").tables)
    for name in TABLES:
        read = parquet.read_table(tmp_path / f"{name}.parquet")
        assert tuple(read.column_names) == getattr(ran.tables, name).columns
    assert parquet.read_table(tmp_path / "areas.parquet")["loss_kw"].null_count == 1


def test_without_pyarrow_the_cure_is_named(ran: RunResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(InvalidInputError, match=r"pip install .*\[parquet\]'"):
        write_parquet(tmp_path, ran.tables)
    assert not list(tmp_path.iterdir())


def test_a_full_disk_costs_files_and_not_the_result(ran: RunResult, tmp_path: Path):
    (tmp_path / "branches.csv").mkdir()  # a file that cannot be opened
    again = write_files(replace(ran, folder=tmp_path), None)
    assert again.unwritten is not None
    assert "branches.csv" in again.unwritten
    assert (tmp_path / "result.json").exists()


def test_a_name_with_commas_and_line_ends_stays_in_its_cell():
    table = Table("buses", {"bus": np.array([1, 2]), "name": ['say "no", please', "two\nlines"]})
    rows = list(csv.reader(table.to_csv().split("\n", 1)[1].splitlines(keepends=True)))
    assert rows == [["1", 'say "no", please'], ["2", "two\nlines"]]


def test_no_meter_becomes_an_object_for_the_tables_of_a_run(ran: RunResult):
    meters = ran.scenario.meters
    assert isinstance(meters, Records)
    meters = meters.take(np.arange(len(meters)))  # of which nobody has asked for any
    readings = Records(Measurement, {**ran.readings.columns, "meter": meters})  # type: ignore[attr-defined]
    figures = [asdict(area) for area in ran.area_results]
    tables = make_run_tables(ran.comparison, meters, readings, ran.centralised, figures)
    assert tables.meters.to_csv() == ran.tables.meters.to_csv()
    assert "objects" not in vars(meters)
    assert meters._asked == 0
