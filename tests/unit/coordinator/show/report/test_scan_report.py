"""``report.html`` of many scans: figures over time, the meters removed most, the scans without an estimate."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from coordinator.lab.evaluation.scan_estimates import estimate_scans
from coordinator.show.figures.scan_figures import ScanSeries, draw_scans
from coordinator.show.report.scan_report import make_scan_page, write_scan_report
from dsse_core.grid.columns import read_column
from dsse_core.grid.meter_table import read_meters_of
from scenarios.files.readings.file import Scans
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry

pytestmark = pytest.mark.slow  # drawing takes seconds
SCENARIO = load_scenario("ieee33")
WRONG, FEW = 5, 3  # meters: the one with gross errors, and those that are left of a scan without an estimate


def make_course(names: tuple[str, ...], wrong: tuple[int, ...] = (), failed: tuple[int, ...] = ()) -> ScanSeries:
    union = make_telemetry(SCENARIO, 1).union
    present = np.flatnonzero(read_column(union, "sigma", float) > 0)
    meters = [read_meters_of(union)[k] for k in present.tolist()]
    scans = [make_telemetry(SCENARIO, k + 1).union for k in range(len(names))]
    values = np.array([read_column(scan, "value", float)[present] for scan in scans])
    sigmas = np.array([read_column(scan, "sigma", float)[present] for scan in scans])
    values[list(wrong), WRONG] += 40 * sigmas[list(wrong), WRONG]
    values[list(failed), FEW:] = np.nan
    return ScanSeries(SCENARIO, estimate_scans(SCENARIO, Scans(names, meters, values, sigmas)).tables)


@pytest.fixture(scope="module")
def course() -> ScanSeries:
    return make_course(("10:00", "10:15", "10:30", "10:45"), wrong=(1, 2), failed=(3,))


def test_the_meters_removed_most_stand_first_with_their_scans(course: ScanSeries) -> None:
    page = make_scan_page(course, ["estimate", "ieee33"])
    (table,) = page.tables
    (meter, count), *_ = course.removals.most_common()
    assert meter == course.tables.meters.meter[WRONG]
    assert count == 2
    assert table.rows[0][:3] == (meter, "2", "50.0")
    assert table.rows[0][-2:] == ("10:15", "10:30")


def test_a_scan_without_an_estimate_is_named_with_its_reason(course: ScanSeries) -> None:
    page = make_scan_page(course, ["estimate", "ieee33"])
    assert page.outcome == "3 of 4 scans estimated"
    assert page.good is False
    assert len(page.reasons) == 1
    assert page.reasons[0].startswith("no estimate of scan 10:45: ")


def test_figures_show_quantities_of_all_scans_and_a_gap_where_there_is_no_estimate(course: ScanSeries) -> None:
    drawings = {drawing.name: drawing for drawing in draw_scans(course)}
    assert list(drawings) == ["voltages", "profile", "power", "quality", "removed"]
    highest = drawings["voltages"].figure.axes[0].lines[0].get_ydata()
    expected = [*course.vm[:3].max(axis=1), np.nan]
    np.testing.assert_array_equal(np.asarray(highest), expected)
    lowest = np.unravel_index(np.nanargmin(course.vm), course.vm.shape)
    assert f"{course.vm[lowest]:.4f} p.u. at bus {lowest[1] + 1}, scan " in drawings["voltages"].caption
    assert course.head[0, 0] == pytest.approx(course.tables.buses.p_kw[0])
    assert course.loss_kw[0] == pytest.approx(np.nansum(course.tables.branches.loss_kw[:37]), rel=1e-9)


def test_a_bus_that_one_scan_lacks_keeps_its_band_and_is_not_taken_as_within_limits(course: ScanSeries) -> None:
    vm = course.vm.copy()
    vm[1, -1] = np.nan
    partly = ScanSeries(SCENARIO, course.tables)
    vars(partly)["vm"] = vm
    voltages, profile, *_ = draw_scans(partly)
    assert voltages.caption.endswith(" Not all buses are known in 2 of them.")
    assert np.isfinite(profile.figure.axes[0].lines[0].get_ydata()).all()


def test_the_axis_of_time_has_times_where_all_are_known() -> None:
    timed = make_course(("2026-11-26T10:00Z", "2026-11-26T10:15Z"))
    assert timed.has_times
    assert {
        d.figure.axes[-1].get_xlabel() for d in draw_scans(timed) if d.name in ("voltages", "power", "quality")
    } == {"time (UTC)"}


def test_the_report_and_its_figures_are_written(course: ScanSeries, tmp_path: Path) -> None:
    named = replace(SCENARIO, name="<feeder>")
    write_scan_report(tmp_path, named, course.tables, ("png",), ["estimate", "ieee33"])
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "&lt;feeder&gt;: 4 scans" in text
    assert "<feeder>" not in text
    assert {path.stem for path in tmp_path.glob("*.png")} == {"voltages", "profile", "power", "quality", "removed"}
