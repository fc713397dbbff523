"""What the figures of a run show: the data of their lines, not their pixels."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex
from matplotlib.lines import Line2D
from matplotlib.text import Text

from coordinator.lab.evaluation.comparison import Voltages
from coordinator.lab.evaluation.result import RunResult
from coordinator.show.figures.errors_figure import draw_errors
from coordinator.show.figures.feeder_profile import find_distances
from coordinator.show.figures.gap_figure import draw_gap, draw_gaps_of, find_course
from coordinator.show.figures.network_figure import draw_network
from coordinator.show.figures.profile_figures import draw_angles, draw_magnitudes, find_profile
from coordinator.show.figures.residuals_figure import draw_residuals
from coordinator.show.figures.run_figures import draw_run
from coordinator.show.figures.style import COLOURS, INK, PAPER, Drawing
from coordinator.watch.observe.causes import WARNING, Cause
from dsse_core.estimation.state_limits import OperatingLimits
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.results.meters import read_in_own_units
from scenarios.scenario import load_scenario
from tests.support.made_results import AT_S, GAPS, SCAN_AT_S, make_result
from tests.support.rings import tied33

pytestmark = pytest.mark.slow  # drawing takes seconds


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    return make_result(load_scenario("ieee33"), tmp_path_factory.mktemp("run"))


def axes_of(drawing: Drawing) -> list[Axes]:
    return drawing.figure.axes


def line(axis: Axes, label: str) -> Line2D:
    (found,) = [each for each in axis.lines if each.get_label() == label]
    return found


def test_the_gap_is_drawn_on_logarithmic_axes_from_the_first_state_after_the_scan(result: RunResult) -> None:
    magnitude, angle = axes_of(draw_gap(result))
    assert (magnitude.get_xscale(), magnitude.get_yscale()) == ("log", "log")
    assert angle.get_xlabel() == "time since the scan (s)"
    drawn = line(magnitude, "area2")
    times, gaps = np.asarray(drawn.get_xdata()), np.asarray(drawn.get_ydata())
    after = np.array(AT_S) - SCAN_AT_S
    assert times[::2] == pytest.approx(after)
    assert gaps[::2] == pytest.approx(GAPS, rel=1e-4)
    assert times[-1] == pytest.approx(4.0 - SCAN_AT_S)  # it stays until the verdict
    assert 0 < magnitude.get_xlim()[0] < after[0]
    assert magnitude.get_ylim()[0] < GAPS[-1] < GAPS[0] < magnitude.get_ylim()[1]


def test_the_line_of_all_areas_is_the_largest_and_begins_when_each_has_a_state(result: RunResult) -> None:
    late = tuple(
        replace(sample, time=sample.time + 0.1) if sample.area == "area3" else sample for sample in result.history
    )
    course = find_course(replace(result, history=late))
    known = course.all_areas[~np.isnan(course.all_areas[:, 1])]
    assert known[0, 0] == pytest.approx(AT_S[0] + 0.1 - SCAN_AT_S)
    assert known[:, 1] == pytest.approx(np.repeat(GAPS, 2)[:-1], rel=1e-4)


def test_no_panel_cuts_off_what_the_other_one_shows(result: RunResult) -> None:
    """Angles that count from the substation may come later than magnitudes."""
    history = tuple(replace(sample, referenced=sample.time > AT_S[0]) for sample in result.history)
    course = find_course(replace(result, history=history))
    for drawing in (draw_gap(replace(result, history=history)), draw_gaps_of({"one": course})):
        for axis in axes_of(drawing):
            assert axis.get_xlim()[0] < AT_S[0] - SCAN_AT_S
            assert axis.get_xlim()[1] > 4.0 - SCAN_AT_S


def test_areas_that_publish_before_all_others_are_seen(tmp_path: Path) -> None:
    many = make_result(load_scenario("ieee33", changes={"areas": {"count": 12}}), tmp_path)
    history = tuple(replace(s, time=0.26) if (s.area, s.time) == ("area7", AT_S[0]) else s for s in many.history)
    magnitude = axes_of(draw_gap(replace(many, history=tuple(sorted(history, key=lambda s: s.time)))))[0]
    (areas,) = [each for each in magnitude.collections if isinstance(each, LineCollection)]
    assert len(areas.get_segments()) == 12
    assert magnitude.get_xlim()[0] < 0.26 - SCAN_AT_S


def test_strategies_are_lines_of_one_figure(result: RunResult) -> None:
    courses = {name: find_course(result) for name in ("one", "other")}
    axis = axes_of(draw_gaps_of(courses))[0]
    assert np.asarray(line(axis, "one").get_ydata())[::2] == pytest.approx(GAPS, rel=1e-4)
    assert line(axis, "one").get_linestyle() != line(axis, "other").get_linestyle()


@pytest.mark.parametrize("knows_truth", [True, False])
def test_errors_stand_within_the_band_of_their_standard_deviations(result: RunResult, knows_truth: bool) -> None:
    if not knows_truth:
        unknown = np.full(33, np.nan)
        result = replace(result, comparison=replace(result.comparison, truth=Voltages(unknown, unknown)))
    drawing = draw_errors(result)
    comparison, axis = result.comparison, axes_of(drawing)[0]
    reference = comparison.truth if knows_truth else comparison.centralised
    drawn = np.asarray(line(axis, "decentralised estimate").get_ydata())
    assert sorted(drawn) == pytest.approx(sorted(comparison.decentralised.vm - reference.vm), abs=1e-15)
    (band,) = [each for each in axis.collections if isinstance(each, PolyCollection)]
    heights = band.get_paths()[0].vertices[:, 1]
    assert heights.max() == pytest.approx(2 * comparison.sigma.vm.max())
    assert heights.min() == pytest.approx(-2 * comparison.sigma.vm.max())
    inside = int((abs(comparison.decentralised.vm - reference.vm) <= 2 * comparison.sigma.vm).sum())
    assert f"{inside} of 33 magnitudes" in drawing.caption
    assert [text.get_text() for text in axes_of(drawing)[-1].get_xticklabels()][:2] == ["1", "2"]


def test_distances_are_those_along_the_branches() -> None:
    branches = (Branch("a", 1, 2, 0.3, 0.4), Branch("b", 2, 3, 0.6, 0.8), Branch("parallel", 2, 3, 3.0, 4.0))
    buses = tuple(Bus(k, 10.0) for k in (1, 2, 3, 4))
    away = Branch("open", 3, 4, 0.1, 0.1, in_service=False)
    network = Network("chain", 2.0, buses, (*branches, away), (Generator(1, Control.SLACK),))
    distance, name = find_distances(network)
    assert distance[:3] == pytest.approx([0.0, 25.0, 75.0])  # of 50 ohm each p.u.
    assert np.isinf(distance[3])
    assert "Ω" in name
    of_two_levels = replace(network, buses=(*buses[:3], Bus(4, 0.4)))
    distance, name = find_distances(of_two_levels)
    assert distance[:3] == pytest.approx([0.0, 0.5, 1.5])
    assert "p.u. on 2 MVA" in name


@pytest.mark.parametrize(
    ("stated", "drawn"), [(OperatingLimits(), [0.9, 1.1]), (OperatingLimits(0.95, 1.05), [0.95, 1.05])]
)
def test_the_profile_has_every_bus_at_its_distance_and_the_limits(
    result: RunResult, stated: OperatingLimits, drawn: list[float]
) -> None:
    limited = replace(result, scenario=replace(result.scenario, operating_limits=stated))
    drawing = draw_magnitudes(find_profile(limited))
    (axis,) = axes_of(drawing)
    ours = line(axis, "decentralised estimate")
    assert np.asarray(ours.get_xdata()) == pytest.approx(find_distances(result.scenario.network)[0])
    assert np.asarray(ours.get_ydata()) == pytest.approx(result.comparison.decentralised.vm)
    horizontal = [each for each in axis.lines if len(set(np.asarray(each.get_ydata()).tolist())) == 1]
    assert [np.asarray(each.get_ydata())[0] for each in horizontal] == drawn
    (branches,) = [each for each in axis.collections if isinstance(each, LineCollection)]
    assert len(branches.get_segments()) == 32
    assert "Lowest: 0.919" in drawing.caption
    assert "Ω" in axis.get_xlabel()


def test_angles_are_drawn_in_degrees_and_without_limits(result: RunResult) -> None:
    (axis,) = axes_of(draw_angles(find_profile(result)))
    drawn = line(axis, "decentralised estimate")
    assert np.asarray(drawn.get_ydata()) == pytest.approx(np.degrees(result.comparison.decentralised.va))
    assert "limits" not in {each.get_label() for each in axis.lines}


def test_residuals_stand_at_their_kind_beside_the_limit(result: RunResult) -> None:
    (axis,) = axes_of(draw_residuals(result))
    drawn = line(axis, "meter in use")
    assert sorted(np.asarray(drawn.get_ydata())) == pytest.approx(sorted(result.meters.normalised_residual))
    assert set(np.asarray(line(axis, "limit, 3").get_ydata())) == {3.0}
    names = [text.get_text().replace("\n", " ") for text in axis.get_xticklabels()]
    assert names == ["voltage magnitude", "active injection", "reactive injection", "active flow", "reactive flow"]
    first = np.round(np.asarray(drawn.get_xdata())).astype(int)
    assert np.bincount(first).tolist() == [sum(k == kind for k in result.meters.kind) for kind in
                                           ("vm", "p_injection", "q_injection", "p_flow", "q_flow")]  # fmt: skip


def test_a_removed_meter_has_a_mark_and_its_name(tmp_path: Path) -> None:
    changes = {"telemetry.gross_error": [{"meter": "p_injection@24", "sigmas": 30.0}]}
    bad = make_result(load_scenario("ieee33", changes=changes), tmp_path)
    areas = tuple(replace(area, removed=("p_injection@24",) * (area.name == "area1")) for area in bad.area_results)
    drawing = draw_residuals(replace(bad, area_results=areas))
    (axis,) = axes_of(drawing)
    (value,) = np.asarray(line(axis, "removed as bad data").get_ydata())
    assert value > 20
    assert axis.get_ylim()[1] > value
    assert "p_injection@24" in [text.get_text() for text in axis.texts]


def test_without_normalised_residuals_those_by_the_meters_deviation_are_drawn_and_named(result: RunResult) -> None:
    wrong = replace(result.comparison.sigma, vm=2 * result.comparison.sigma.vm)
    drawing = draw_residuals(replace(result, comparison=replace(result.comparison, sigma=wrong)))
    (axis,) = axes_of(drawing)
    meters = result.meters
    own = read_in_own_units(meters)
    known = own["sigma"] > 0
    expected = abs(own["residual"][known]) / own["sigma"][known]
    drawn = np.asarray(line(axis, "meter in use").get_ydata())
    assert sorted(drawn[~np.isnan(drawn)]) == pytest.approx(sorted(expected))
    assert "standard deviation of the meter" in axis.get_ylabel()
    assert "limit, 3" not in {each.get_label() for each in axis.lines}


def test_the_network_is_coloured_by_voltage_and_unknown_buses_are_grey(result: RunResult) -> None:
    vm = result.comparison.decentralised.vm.copy()
    vm[32] = np.nan
    voltages = Voltages(vm, result.comparison.decentralised.va)
    drawing = draw_network(replace(result, comparison=replace(result.comparison, decentralised=voltages)))
    axis = axes_of(drawing)[0]
    lines = [each for each in axis.collections if isinstance(each, LineCollection)]
    table = result.scenario.network.table
    mean = (vm[table.f] + vm[table.t]) / 2
    coloured = np.concatenate([np.asarray(each.get_array()) for each in lines if each.get_array() is not None])
    assert sorted(coloured) == pytest.approx(sorted(mean[~np.isnan(mean)]))
    assert sum(len(each.get_segments()) for each in lines if each.get_array() is None) == 1
    assert "1 buses without a fresh estimate" in drawing.caption
    assert axes_of(drawing)[1].get_ylabel() == "voltage magnitude (p.u.)"


def test_map_and_profile_leave_out_an_area_that_is_not_fresh_and_the_map_marks_what_is_beyond_limits(
    result: RunResult,
) -> None:
    stale = [replace(area, fresh=area.name != "area2") for area in result.area_results]
    scenario = replace(result.scenario, operating_limits=OperatingLimits(lowest_vm=0.93))
    shown = replace(result, scenario=scenario, area_results=tuple(stale))
    of_area2 = np.array(shown.buses.area) == "area2"
    low = (shown.buses.vm_pu < 0.93) & ~of_area2
    drawing = draw_network(shown)
    (marked,) = (each for each in axes_of(drawing)[0].collections if each.get_label() == "beyond the limits")
    assert len(np.asarray(marked.get_offsets())) == low.sum() > 0
    assert f"{of_area2.sum()} buses without a fresh estimate" in drawing.caption
    profile = draw_magnitudes(find_profile(shown))
    drawn = np.asarray(line(axes_of(profile)[0], "decentralised estimate").get_ydata())
    assert np.isnan(drawn).tolist() == of_area2.tolist()
    assert f"Of 33 buses {33 - of_area2.sum()} known." in profile.caption


def words_of(drawing: Drawing) -> Iterator[str]:
    for axis in drawing.figure.axes:
        yield from (axis.get_xlabel(), axis.get_ylabel(), *axis.get_legend_handles_labels()[1])
    yield from (text.get_text() for legend in drawing.figure.legends for text in legend.get_texts())
    yield from (drawing.title, drawing.caption)


def test_labels_are_words_and_axes_have_units(result: RunResult) -> None:
    for drawing in draw_run(result):
        words = [word for word in words_of(drawing) if not re.search(r"_injection@|_flow@", word)]
        assert [word for word in words if "_" in word and not word.startswith("_")] == []
        for axis in drawing.figure.axes:
            for label in (axis.get_xlabel(), axis.get_ylabel()):
                assert not label or re.search(r"\(.+\)|residual", label), label


def test_data_have_colours_that_everybody_can_tell_apart(result: RunResult) -> None:
    allowed = {*COLOURS, INK, PAPER, "#808080"}
    for drawing in draw_run(result):
        for axis in drawing.figure.axes:
            assert {to_hex(each.get_color()) for each in axis.lines} <= allowed, drawing.name


def test_figures_differ_by_name_and_each_says_what_it_shows(result: RunResult) -> None:
    drawings = draw_run(result)
    assert [each.name for each in drawings] == ["gap", "errors", "magnitudes", "angles", "residuals", "network"]
    assert all(len(each.caption) > 40 for each in drawings)
    assert not any(isinstance(text, Text) and "$" in text.get_text() for each in drawings for text in each.figure.texts)


def test_the_network_shows_which_switches_are_open_or_closed_and_which_status_is_in_doubt(result: RunResult):
    network = result.scenario.network
    marked = ("2-3", "18-33", "25-29")
    branches = tuple(replace(branch, switch=branch.id in marked) for branch in tied33(3, ()).network.branches)
    scenario = replace(result.scenario, network=replace(network, branches=branches))
    cause = Cause("wrong status", "", "", WARNING, branches=("18-33",))
    axis = axes_of(draw_network(replace(result, scenario=scenario, causes=(cause,))))[0]
    closed, opened, doubted = (line(axis, name) for name in ("closed switch", "open switch", "status in doubt"))
    assert (len(closed.get_xydata()), len(opened.get_xydata())) == (1, 2)
    assert doubted.get_xydata().tolist()[0] in opened.get_xydata().tolist()
    sound = axes_of(draw_network(replace(result, scenario=scenario)))[0]
    assert [each.get_label() for each in sound.lines if each.get_label() == "status in doubt"] == []
