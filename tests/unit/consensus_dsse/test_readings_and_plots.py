"""Readings from Python, as frames and arrays, and results that draw themselves."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import consensus_dsse as dsse
from dsse_core.results.meters import read_in_own_units

pytestmark = pytest.mark.quick
PNG = b"\x89PNG"


@pytest.fixture(scope="module")
def found() -> dsse.Estimate:
    return dsse.estimate("ieee33", seed=7)


def by_meter(found: dsse.Estimate) -> dict[str, float]:
    """The readings of all meters that are not virtual, in their units."""
    values = read_in_own_units(found.meters)["value"]
    rows = zip(found.meters.meter, values.tolist(), found.meters.source, strict=True)
    return {meter: value for meter, value, source in rows if source != "virtual"}


def as_frame(columns: Any) -> Any:
    return pytest.importorskip("pandas").DataFrame(columns)


class Arrow:
    """A table whose names of columns are ``column_names``, as those of pyarrow."""

    def __init__(self, columns: dict[str, Any]) -> None:
        self.column_names, self.columns = list(columns), list(columns.values())

    def __getitem__(self, name: str) -> Any:
        return self.columns[self.column_names.index(name)]


@pytest.mark.parametrize("make", [dict, as_frame, Arrow])
def test_readings_in_columns_give_the_estimate_of_their_file(
    found: dsse.Estimate, make: Callable[[Any], Any], tmp_path: Path
):
    found.meters.to_csv(tmp_path / "meters.csv")
    given = make({name: found.meters[name] for name in found.meters.columns if name != "time"})
    for same in (dsse.estimate("ieee33", readings=x) for x in (given, tmp_path / "meters.csv", found.meters)):
        assert isinstance(same, dsse.Estimate)
        np.testing.assert_allclose(same.buses.vm_pu, found.buses.vm_pu, rtol=0, atol=1e-12)
        np.testing.assert_allclose(same.meters.sigma_kw, found.meters.sigma_kw, rtol=1e-12)


def test_columns_may_stand_in_any_order_and_lack_readings():
    columns = {"value_pu": [1.0, np.nan], "sigma_pu": [0.01, np.nan], "value_kw": [None, 3.0], "sigma_kw": [None, 1.0]}
    with pytest.raises(dsse.InvalidInputError, match=r"readings: .*\n.*line 3: meter vm@2 cannot be in kw"):
        dsse.estimate("ieee33", readings={**columns, "meter": ["vm@1", "vm@2"]})


def test_a_number_for_each_meter_is_a_scan_with_the_standard_deviations_of_the_scenario(found: dsse.Estimate):
    same = dsse.estimate("ieee33", readings=by_meter(found))
    np.testing.assert_allclose(same.buses.sigma_vm_pu, found.buses.sigma_vm_pu, rtol=1e-9)
    np.testing.assert_allclose(same.buses.vm_pu, found.buses.vm_pu, rtol=0, atol=1e-12)


@pytest.mark.parametrize("make", [dict, as_frame])
def test_an_array_for_each_meter_is_many_scans(found: dsse.Estimate, make: Callable[[Any], Any]):
    arrays = {meter: np.array([value, 0.9999 * value, value]) for meter, value in by_meter(found).items()}
    arrays["p_flow@6:6-7"][2] = np.nan
    many = dsse.estimate("ieee33", readings=make(arrays))
    assert [len(many.buses), len(many.scans)] == [99, 3]
    np.testing.assert_allclose(many.buses.vm_pu[:33], found.buses.vm_pu, rtol=0, atol=1e-9)
    assert (many.scans.readings[0] - many.scans.readings).tolist() == [0, 0, 1]
    assert "3 scans" in many._repr_html_()


def test_the_rows_of_a_frame_name_the_scans(found: dsse.Estimate):
    pandas = pytest.importorskip("pandas")
    index = pandas.date_range("2026-03-01", periods=2, freq="h")
    frame = pandas.DataFrame({meter: [value, value] for meter, value in by_meter(found).items()}, index=index)
    many = dsse.estimate("ieee33", readings=frame)
    assert many.scans.scan == ("2026-03-01 00:00:00", "2026-03-01 01:00:00")
    assert many.scans.time.astype("M8[h]").tolist() == index.to_numpy().astype("M8[h]").tolist()


@pytest.mark.parametrize(
    ("readings", "message"),
    [
        ({"vm@1": 1.0, "vm@333": 1.0}, "'vm@333' is no meter of 'ieee33'; did you mean"),
        (
            {"p_injection@1": 1.0, "p_injectoin@2": 2.0},
            "'p_injectoin@2' is no meter of 'ieee33'; did you mean 'p_injec",
        ),
        ({"vm@1": [1.0, 1.0], "vm@16": [1.0]}, r"shapes \[\(1,\), \(2,\)\]"),
        ({"meter": ["vm@1"], "value_pu": [1.0, 1.0]}, r"columns have different lengths: \[1, 2\]"),
        ({"meter": ["vm@1"], "value_pu": [1.0]}, "pairs value_UNIT,sigma_UNIT"),
        ({}, "there are none; give meters"),
        ([1.0, 2.0], "found list; give a path"),
        ({"vm@1": "high"}, "a number or an array of numbers"),
        ({"vm@1": np.ones((2, 2))}, "one number for each scan"),
        ({"vm@1": np.ma.array([1.0, 1.0], mask=True)}, "there is no reading"),
        (Path("nowhere.csv"), "cannot be read"),
    ],
)
def test_a_mistake_in_readings_is_one_clear_error(readings: Any, message: str):
    with pytest.raises(dsse.InvalidInputError, match=message):
        dsse.estimate("ieee33", readings=readings)


@pytest.mark.parametrize("names", [["a", "a"], ["a", None]])
def test_a_row_of_a_frame_that_has_no_name_of_its_own_is_an_error(names: list[str | None]):
    frame = pytest.importorskip("pandas").DataFrame({"vm@1": [1.0, 1.0]}, index=names)
    with pytest.raises(
        dsse.InvalidInputError, match=f"readings: 1 problem\n  - '{names[-1]}' names no row, or several"
    ):
        dsse.estimate("ieee33", readings=frame)


def test_what_is_masked_is_no_reading(found: dsse.Estimate):
    arrays = {meter: np.ma.array([value, 0.9 * value]) for meter, value in by_meter(found).items()}
    arrays["p_flow@6:6-7"][1] = np.ma.masked
    assert (np.diff(dsse.estimate("ieee33", readings=arrays).scans.readings)).tolist() == [-1]
    columns = {name: found.meters[name] for name in found.meters.columns if name not in {"time", "scan"}}
    hidden = np.ma.array(columns["value_kw"], mask=[meter == "p_flow@6:6-7" for meter in found.meters.meter])
    fewer = dsse.estimate("ieee33", readings=columns | {"value_kw": hidden})
    assert len(fewer.meters) == len(found.meters) - 1


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: dsse.sweep("ieee33", {"faults.loss": 0.3}), "'faults.loss': 0.3; give"),
        (lambda: dsse.sweep("ieee33", {"faults.loss": "0:0.3:2"}), "a list of values"),
        (lambda: dsse.sweep("ieee33", {("faults.loss", "faults.duplicate"): [0]}), "a key with commas"),
        (lambda: dsse.sweep("ieee33", {"faults.loss": []}), "faults.loss has no value; give at least one"),
        (lambda: dsse.sweep("ieee33", {"faults.loss": [0.3]}, seeds=0), "0 seeds; give at least one"),
        (lambda: dsse.compare("ieee33", strategies="admn"), "1 problem\n.*unknown strategy 'admn'"),
        (lambda: dsse.estimate("ieee33", seed="7"), "seed: 1 problem\n  - must be an integer"),
    ],
)
def test_a_mistake_in_a_study_is_one_clear_error(call: Callable[[], object], message: str):
    with pytest.raises(dsse.InvalidInputError, match=message):
        call()


def test_changes_hold_in_a_run_and_are_refused_for_a_loaded_scenario(tmp_path: Path):
    changes = {"faults.loss": 0.3}
    result = dsse.simulate("industrial13", changes=changes, out=tmp_path / "a", plots=False)
    assert result.verdict.lost > 0
    assert dict(result.scenario.changes) == changes
    for call in (dsse.simulate, dsse.run, dsse.compare, dsse.estimate, dsse.power_flow):
        with pytest.raises(dsse.InvalidInputError, match="loaded already"):
            call(result.scenario, changes=changes)
    with pytest.raises(dsse.InvalidInputError, match="loaded already"):
        dsse.sweep(result.scenario, {"faults.loss": [0.1]})


def test_results_draw_themselves_in_notebooks_and_files(found: dsse.Estimate, tmp_path: Path):
    run = dsse.simulate("industrial13", out=tmp_path / "run", plots=False)
    assert isinstance(run, dsse.RunResult)
    flow = dsse.power_flow(dsse.load_network("case33bw"))
    for k, (drawn, figure) in enumerate([(run, "gap"), (run, "network"), (found, "magnitudes"), (flow, "angles")]):
        drawing = drawn.plot(figure)
        assert drawing.name == figure
        assert drawing._repr_png_().startswith(PNG)
        drawing.save(tmp_path / f"{k}.pdf")
        assert (tmp_path / f"{k}.pdf").read_bytes().startswith(b"%PDF")
        assert "<table" in drawn._repr_html_()
    assert [text.get_text() for text in found.plot().figure.legends[0].get_texts()][1:3] == [
        *("true (power flow)", "centralised estimate"),
    ]


def test_an_unknown_figure_or_ending_is_one_clear_error(found: dsse.Estimate, tmp_path: Path):
    with pytest.raises(dsse.InvalidInputError, match=r"unknown figure 'magnitude'.*did you mean 'magnitudes'"):
        found.plot("magnitude")
    with pytest.raises(dsse.InvalidInputError, match=r"unknown ending 'pgn'.*did you mean 'png'"):
        found.plot().save(tmp_path / "a.pgn")
    assert list(tmp_path.iterdir()) == []


def test_plotting_leaves_the_back_end_of_the_user_alone():
    matplotlib = pytest.importorskip("matplotlib")
    before = matplotlib.rcParams._get_backend_or_none()
    dsse.estimate("industrial13").plot()._repr_png_()
    assert matplotlib.rcParams._get_backend_or_none() == before
