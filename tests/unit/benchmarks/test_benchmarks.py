"""The benchmarks compare like with like: one minimum, found by every tool that looks for it. No time is asserted."""

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.estimates import comparison
from benchmarks.estimates.batch import format_batches, measure_batches
from benchmarks.estimates.cases import build_case, build_network
from benchmarks.measuring.limits import GIB, LimitedCallError, call_limited
from benchmarks.methods.compared import OURS, OURS_WITH_RESIDUALS, PEERS
from benchmarks.methods.physical import describe_lines
from dsse_core.errors import InvalidInputError

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("benchmarks")]

ROOT = Path(__file__).parents[3]
OTHER_MINIMUM = "power-grid-model iterative_linear"
SAME_MINIMUM = [method for method in (*OURS, *OURS_WITH_RESIDUALS, *PEERS) if method.name != OTHER_MINIMUM]
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="only Linux keeps a process to its address space")
MODULE = {"power-grid-model": "power_grid_model", "consensus-dsse": "dsse_core"}


def run_reduced(out: Path, *options: str) -> list[dict]:
    """The estimates of the reduced run of the command, on 33 buses."""
    command = [sys.executable, "-m", "benchmarks", "--reduced", "--sizes", "33", "--sets", "full", "--runs", "1"]
    finished = subprocess.run(
        [*command, *options, "--out", str(out)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=1800,
        check=False,
    )
    assert finished.returncode == 0, finished.stderr
    return json.loads((out / "results.json").read_text())["estimates"]


@pytest.fixture(scope="module")
def run(tmp_path_factory, request):
    """Processes that load the peers take most of a minute: with ``--thorough`` only."""
    out = tmp_path_factory.mktemp("benchmarks")
    run_reduced(out, "--draws", "1", *([] if request.config.getoption("--thorough") else ["--no-peers"]))
    return out


@pytest.fixture(scope="module")
def results(run):
    return json.loads((run / "results.json").read_text())


@pytest.mark.long
def test_all_objectives_of_the_reduced_run_agree(results):
    found = [row for row in results["estimates"] if row["outcome"] and row["method"] != OTHER_MINIMUM]
    assert {row["method"] for row in found} >= {method.name for method in OURS}
    for row in found:
        assert row["excess"] < 1e-9, row["method"]
        assert row["outcome"]["difference"] < 1e-6, row["method"]


@pytest.mark.long
def test_every_method_has_a_row_and_without_peers_ours_alone_are_timed(results, request):
    peers = PEERS if request.config.getoption("--thorough") else ()
    assert [row["method"] for row in results["estimates"]] == [m.name for m in (*OURS, *OURS_WITH_RESIDUALS, *peers)]


@pytest.fixture
def compared(monkeypatch):
    """All methods on the case of the reduced run, in this process."""
    monkeypatch.setattr(comparison, "call_limited", lambda function, *arguments, **_: function(*arguments))
    return comparison.compare([33], ["full"], OURS, PEERS, comparison.Limits(1, 1.0, 8.0), lambda _: None)


@pytest.mark.long
def test_a_peer_has_a_row_with_its_ratio_to_every_back_end_of_ours_or_how_to_install_it(compared):
    assert [row.method for row in compared] == [method.name for method in (*OURS, *PEERS)]
    for row in compared:
        assert row.outcome or "pip install" in row.remark, row.remark
        if row.outcome:
            assert row.ratios.keys() == {method.name for method in OURS}
        if row.outcome and row.method != OTHER_MINIMUM:
            assert row.excess < 1e-9, row.method
            assert row.outcome.difference < 1e-6, row.method


@pytest.mark.long
def test_our_estimate_solves_the_random_draw_of_the_reduced_run(results):
    assert all(
        row["estimated"] == row["tried"] == 1 for row in results["random_draws"] if row["method"] == OURS[0].name
    )


@pytest.mark.long
def test_table_and_plot_are_written(run, results):
    table = (run / "results.md").read_text()
    assert all(row["method"] in table for row in results["estimates"])
    assert results["machine"]["numpy"] == np.__version__
    assert (run / "times.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("method", SAME_MINIMUM, ids=lambda method: method.name)
@pytest.mark.parametrize(
    ("n_bus", "set_name"),
    [(33, "dist"), *(pytest.param(60, name, marks=pytest.mark.long) for name in ("full", "full-sharp"))],
)
def test_a_method_finds_the_minimum(method, n_bus, set_name):
    pytest.importorskip(MODULE.get(method.package, method.package))
    case = build_case(build_network(n_bus), set_name)
    state = method.read(case, method.solve(method.build(method.translate(case))))
    ours = OURS[0].read(case, OURS[0].solve(OURS[0].build(OURS[0].translate(case))))
    assert case.objective(state.vm, state.va) == pytest.approx(case.objective(ours.vm, ours.va), rel=1e-9)


def test_a_draw_is_the_same_every_time_and_has_the_meters_of_every_other_draw():
    network = build_network(33)
    first, again, other = (build_case(network, "dist", draw) for draw in (3, 3, 4))
    assert first.measurements == again.measurements
    assert [m.meter for m in first.measurements] == [m.meter for m in other.measurements]
    assert [m.value for m in first.measurements] != [m.value for m in other.measurements]


@pytest.mark.parametrize(
    ("function", "argument", "why"),
    [
        (time.sleep, 600, "out of time"),
        pytest.param(bytearray, 64 * GIB, "out of memory", marks=LINUX),
        (os._exit, 3, "exit code 3"),
        (int, "seven", "fails: ValueError: invalid literal"),
    ],
)
def test_a_call_that_fails_says_why_and_leaves_the_others_alone(function, argument, why):
    with pytest.raises(LimitedCallError, match=why):
        call_limited(function, argument, limit_s=0.1 if function is time.sleep else 60, limit_gib=4)


def test_a_network_that_the_peers_cannot_be_given_is_rejected():
    network = build_network(33)
    first, *others = network.buses
    changed = replace(network, buses=(replace(first, b_shunt=0.1), *others), generators=())
    with pytest.raises(InvalidInputError, match=r"(?s)bus 1 has a shunt.*no slack"):
        describe_lines(changed)


@pytest.mark.parametrize(("option", "value"), [("--sizes", "33,two"), ("--sets", "half"), ("--sizes", "2")])
def test_a_wrong_option_is_rejected_with_what_to_give(option, value):
    finished = subprocess.run(
        [sys.executable, "-m", "benchmarks", option, value], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert finished.returncode == 2
    assert "give numbers of buses" in finished.stderr or "choose from full" in finished.stderr


@pytest.mark.long
def test_a_batch_is_timed_on_every_number_of_threads_and_no_scan_of_ours_fails():
    pytest.importorskip("numba", reason="the radial back end needs numba: pip install 'consensus-dsse[fast]'")
    rows = measure_batches(build_case(build_network(33), "full"), runs=1)
    of_ours = [row for row in rows if row.method == "ours, radial"]
    assert {row.threads for row in of_ours} >= {1}
    assert all(row.failed == 0 and row.wall_s > 0 and row.scans == rows[0].scans for row in of_ours)
    lines = format_batches(rows).splitlines()
    assert len(lines) == len(rows) + 2
