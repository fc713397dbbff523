"""The files of a run: their schema and what stands in them when something is missing."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes

from agents.messages.packing import Incarnation, StateMessage
from coordinator.lab.evaluation.comparison import Voltages, compare, largest_gap
from coordinator.lab.evaluation.result import RunResult, as_json, make_area_results, write_result
from coordinator.lab.evaluation.verdict import make_verdict
from coordinator.lab.simulator.simulate import simulate_scenario
from coordinator.show.report.run_report import make_run_page, write_report
from coordinator.show.report.text import format_verdict
from coordinator.watch.observe.observer import Observer
from dsse_core.estimation.bad_data import process_bad_data
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.levels import further
from tests.support.shown_states import published_by

ROOT = Path(__file__).parents[5]
FIGURES = {"gap", "errors", "magnitudes", "angles", "residuals", "network"}
SHIFT = np.radians(0.5)  # of area2's published angles


def a_state_of(area, central, va_shift: float = 0.0) -> StateMessage:
    """The area publishes the centralised estimate, its angles off by ``va_shift``."""
    rows = [central.network.row[bus.id] for bus in area.network.buses]
    n = len(rows)
    sent = {neighbour.area: (1, 2) for neighbour in area.neighbours}
    return published_by(
        area.name,
        Incarnation(1, 1),
        buses=tuple(bus.id for bus in area.network.buses),
        vm=tuple(central.vm[rows].tolist()),
        va=tuple((central.va[rows] + va_shift).tolist()),
        sigma_vm=(0.001,) * n,
        sigma_va=(0.001,) * n,
        degrees_of_freedom=2,
        removed=("vm@6",),
        critical=("vm@1",),
        sent=sent,
        received=sent,
        lost=1,
        notes=("neighbour area3 is gone",) if area.name == "area1" else (),
        quality="degraded" if area.name == "area1" else "good",
        telemetry_age=0.0,
        ages={},
    )


def a_result(folder: Path, missing: str | None = None, relative: str | None = None) -> RunResult:
    scenario = load_scenario("ieee33")
    telemetry = make_telemetry(scenario)
    central = process_bad_data(scenario.network, telemetry.union)
    observer = Observer("run", scenario.partition, 1e-6, 1e-6, 0.2, False)
    for area in scenario.partition.areas:
        state = a_state_of(area, central.result, SHIFT if area.name == "area2" else 0.0)
        observer.take_presence(area.name, True, 0.0)
        if area.name != missing:
            observer.take_state(replace(state, referenced=area.name != relative), 0.5)
    comparison = compare(scenario.partition, observer.states, telemetry.truth, central)
    return RunResult(
        scenario=scenario,
        run="run",
        folder=folder,
        verdict=make_verdict(observer, comparison, None if missing is None else "not", 1.0),
        area_results=make_area_results(observer, comparison, now=0.0),
        comparison=comparison,
        centralised=central,
        centralised_failure=None,
        history=tuple(observer.history),
        timing_s={"verdict": 1.0},
        faults={"lost": 3, "kill": 1},
        duplicates=(),
    )


def test_the_verdict_has_every_documented_key_and_the_gap_that_was_put_in(tmp_path: Path):
    write_result(a_result(tmp_path))
    content = json.loads((tmp_path / "result.json").read_text())
    assert content["version"] == 2
    verdict = content["verdict"]
    assert verdict["consensus"] is True
    assert verdict["gap_vm_pu"] == pytest.approx(0.0, abs=1e-12)
    assert verdict["gap_va_deg"] == pytest.approx(0.5)
    assert verdict["error_vm_pu"] == content["centralised"]["error_vm_pu"]
    assert (verdict["exchanges"], verdict["messages"], verdict["bytes"], verdict["lost"]) == (3, 15, 1500, 3)
    assert verdict["wall_s"] == 1.0


def test_numbers_of_an_area_that_has_published_nothing_are_not_fresh_and_counted_as_unknown(tmp_path: Path):
    result = a_result(tmp_path, missing="area2")
    content = as_json(result)
    fresh = {name: (area["fresh"], area["value_age_s"] is None) for name, area in content["areas"].items()}
    assert fresh == {"area1": (True, False), "area2": (False, True), "area3": (True, False)}
    buses = result.buses
    of_area2 = np.array(buses.area) == "area2"
    assert buses.fresh.tolist() == (~of_area2).tolist()
    assert {quality for area, quality in zip(buses.area, buses.quality, strict=True) if area == "area2"} == {"none"}
    voltage = content["summary"]["voltage"]
    assert (voltage["known"], voltage["total"]) == (33 - of_area2.sum(), 33)
    assert content["summary"]["loss"]["known"] < content["summary"]["loss"]["total"]
    page = make_run_page(result, [], [])
    assert any(line.startswith(f"of 33 buses {voltage['known']} known, within 0.9 to 1.1") for line in page.findings)


def test_no_gap_of_the_verdict_is_lost_by_rounding_in_a_file(tmp_path: Path):
    result = simulate_scenario("ieee33", tmp_path / "run")
    with (result.folder / "buses.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    verdict = json.loads((result.folder / "result.json").read_text())["verdict"]
    assert 0 < verdict["gap_vm_pu"] < 1e-9
    for gap, column in (("gap", "centralised"), ("error", "true")):
        vm, va = (
            max(abs(float(row[f"decentralised_{of}"]) - float(row[f"{column}_{of}"])) for row in rows)
            for of in ("vm_pu", "va_deg")
        )
        assert vm == verdict[f"{gap}_vm_pu"]
        assert va == pytest.approx(verdict[f"{gap}_va_deg"], abs=2 * np.spacing(180.0))  # a wrapped angle passes 180


def test_gaps_are_reported_per_area(tmp_path: Path):
    areas = as_json(a_result(tmp_path))["areas"]
    assert areas["area2"]["gap_va_deg"] == pytest.approx(0.5)
    assert areas["area1"]["gap_va_deg"] == pytest.approx(0.0, abs=1e-9)
    assert areas["area1"]["degraded"] is True
    assert areas["area3"]["degraded"] is False
    assert areas["area1"]["critical"] == ("vm@1",)


def test_every_key_of_result_json_is_documented(tmp_path: Path):
    documented = set(re.findall(r"`([^`]+)`", (ROOT / "docs" / "reference" / "run-folder.md").read_text()))
    words = {word for name in documented for word in name.split(".")}

    def keys(table: dict[str, object]) -> set[str]:
        named = {key for key in table if key not in {"area1", "area2", "area3"}}
        return named.union(*(keys(value) for value in table.values() if isinstance(value, dict)))

    content = as_json(a_result(tmp_path))
    del content["versions"], content["faults"]["kill"], content["faults"]["lost"]
    assert keys(content) - words == set()


def test_an_area_without_a_state_is_null_and_not_zero(tmp_path: Path):
    result = a_result(tmp_path, missing="area3")
    write_result(result)
    content = json.loads((tmp_path / "result.json").read_text())
    assert content["verdict"]["gap_vm_pu"] is None
    assert content["areas"]["area3"]["gap_vm_pu"] is None
    assert content["areas"]["area1"]["gap_vm_pu"] is not None
    assert "area3" in format_verdict(result)


def test_angles_that_do_not_count_from_the_substation_have_no_gap(tmp_path: Path):
    verdict = a_result(tmp_path, relative="area3").verdict
    assert verdict.gap_va_deg is None
    assert verdict.gap_vm_pu == pytest.approx(0.0, abs=1e-12)


def test_buses_csv_has_one_row_per_bus_from_its_owner(tmp_path: Path):
    write_result(a_result(tmp_path))
    with (tmp_path / "buses.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0])[:10] == (
        "bus", "area", "true_vm_pu", "true_va_deg", "centralised_vm_pu", "centralised_va_deg",
        "decentralised_vm_pu", "decentralised_va_deg", "sigma_vm_pu", "sigma_va_deg",
    )  # fmt: skip
    assert [int(row["bus"]) for row in rows] == list(range(1, 34))
    boundary = rows[5]
    assert boundary["area"] == "area1"
    assert boundary["decentralised_va_deg"] == boundary["centralised_va_deg"]  # not area2's shifted one
    assert float(rows[6]["decentralised_va_deg"]) == pytest.approx(float(rows[6]["centralised_va_deg"]) + 0.5)


def test_a_bus_that_nobody_knows_is_an_empty_cell(tmp_path: Path):
    write_result(a_result(tmp_path, missing="area3"))
    with (tmp_path / "buses.csv").open() as file:
        row = list(csv.DictReader(file))[32]
    assert row["decentralised_vm_pu"] == ""
    assert row["true_vm_pu"] != ""


def test_relative_angles_and_their_sigma_are_empty_cells(tmp_path: Path):
    write_result(a_result(tmp_path, relative="area3"))
    with (tmp_path / "buses.csv").open() as file:
        rows = list(csv.DictReader(file))
    of_area3 = [row for row in rows if row["area"] == "area3"]
    assert {(row["decentralised_va_deg"], row["sigma_va_deg"]) for row in of_area3} == {("", "")}
    assert {row["sigma_vm_pu"] for row in of_area3} == {"0.001"}
    assert {row["sigma_va_deg"] for row in rows if row["area"] != "area3"} == {"0.057295779513082325"}


def test_a_gap_of_angles_is_wrapped():
    one, other = (Voltages(np.ones(1), np.array([va])) for va in (np.pi - 0.01, -np.pi + 0.01))
    assert largest_gap(one, other).va_deg == pytest.approx(np.degrees(0.02))


@pytest.mark.slow
@pytest.mark.parametrize("missing", ["area3", *further(None)])
def test_plots_are_drawn_also_where_an_area_is_missing(tmp_path: Path, missing: str | None):
    assert write_report(a_result(tmp_path, missing=missing), ["png"], ["run", "ieee33"]).unwritten is None
    assert {path.stem for path in tmp_path.glob("*.png")} == FIGURES
    assert all(path.stat().st_size > 10_000 for path in tmp_path.glob("*.png"))


def a_result_without_states(folder: Path) -> RunResult:
    result = a_result(folder)
    return replace(result, history=())


def a_result_without_centralised_estimate(folder: Path) -> RunResult:
    result, unknown = a_result(folder), np.full(33, np.nan)
    comparison = replace(result.comparison, centralised=Voltages(unknown, unknown))
    return replace(result, comparison=comparison, centralised=None, centralised_failure="diverged")


def a_result_with_relative_angles_only(folder: Path) -> RunResult:
    result = a_result(folder)
    return replace(result, history=tuple(replace(sample, referenced=False) for sample in result.history))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make_result", "words", "times"),
    [
        (a_result_without_states, "no area has published a state", 2),
        pytest.param(
            a_result_without_centralised_estimate, "there is no centralised estimate", 2, marks=pytest.mark.long
        ),
        pytest.param(
            a_result_with_relative_angles_only, "no area's angles count from the substation", 1, marks=pytest.mark.long
        ),
    ],
)
def test_where_no_gap_is_known_the_picture_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make_result: Callable[[Path], RunResult], words: str, times: int
):
    written: list[str] = []
    text = Axes.text
    monkeypatch.setattr(Axes, "text", lambda self, *a, **k: written.append(a[2]) or text(self, *a, **k))
    write_report(make_result(tmp_path), ["png"], ["run", "ieee33"])
    assert {path.stem for path in tmp_path.glob("*.png")} == FIGURES
    assert written == [*[words] * times, "no residual is known"]  # of a result without readings
