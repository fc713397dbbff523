"""The benchmark of the exchange runs, and what it counts and times holds together; the same every time."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.exchange.command import QUICK, predict, summarise, write_line
from benchmarks.exchange.watch import WatchedBus
from benchmarks.exchange.worlds import draw_feeder, draw_row

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("exchange")]

ROOT = Path(__file__).parents[3]
EXACT = "information"
ROUNDING_S = 1e-9


@pytest.fixture(scope="module")
def rows() -> list[dict]:
    command = [sys.executable, "-m", "benchmarks.exchange", "--quick", "--json"]
    finished = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=1800, check=False)
    assert finished.returncode == 0, finished.stderr
    found = json.loads(finished.stdout)
    assert {"processor", "date", "Python", "numpy"} <= found["machine"].keys()
    return found["rows"]


@pytest.mark.long
def test_every_case_has_its_rows(rows):
    cases = {(row["case"], row["strategy"]) for row in rows}
    feeders = f"{QUICK.feeders} random feeders"
    assert {(feeders, strategy) for strategy in ("information", "admm", "angle-offset")} < cases
    assert {("6 areas in a row", EXACT), ("ieee33, 30% lost", EXACT), ("8 areas, 50 ms a hop", EXACT)} < cases


@pytest.mark.long
def test_under_rounds_an_edge_carries_two_boundary_messages_a_round(rows):
    sound = [row for row in rows if row["strategy"] == EXACT and "lost" not in row["case"]]
    assert sound
    for row in sound:
        assert row["boundary"] == [2 * rounds for rounds in row["rounds"]], row["case"]


@pytest.mark.long
def test_all_areas_agree_before_all_are_good_and_end_at_the_centralised_estimate(rows):
    for row in (row for row in rows if row["strategy"] == EXACT):
        assert row["agree_s"][0] <= row["good_s"][0], row["case"]
        assert row["gap"] < 1e-8, row["case"]


@pytest.mark.long
def test_areas_agree_after_rounds_times_the_path(rows):
    predicted = [row for row in rows if row["predicted_s"] is not None]
    assert {row["case"] for row in predicted} == {"6 areas in a row", "8 areas, 50 ms a hop"}
    for row in predicted:
        assert row["agree_s"][1] == pytest.approx(row["predicted_s"], abs=ROUNDING_S), row["case"]


@pytest.mark.long
def test_at_rest_loss_leaves_areas_good(rows):
    (rest,) = (row for row in rows if row["good_share"] is not None)
    assert rest["case"] == "ieee33 in 12 areas, 30% lost"
    assert rest["good_share"] > 0.99


def test_all_are_good_one_longest_path_after_they_agree():
    hop_s, world = 0.05, draw_feeder(7, areas=8)
    bus = WatchedBus(world, EXACT, hop_s=hop_s)
    path_s = hop_s * (len(world.partition.longest_path) - 1)
    for scan in range(3):
        if scan:
            bus.go_on()
        figures = bus.watch(10.0)
        assert figures.good_s - figures.agree_s <= path_s + ROUNDING_S
        assert figures.agree_s == pytest.approx(predict(world, figures.rounds, hop_s), abs=ROUNDING_S)


def test_who_is_never_good_is_reported_as_never_good():
    bus = WatchedBus(draw_row(3), EXACT, loss=1.0)
    line = write_line(summarise("silence", EXACT, "cold", [bus.watch(1.0)]))
    assert "never, never" in line
    assert math.isnan(bus.watch(1.0).good_s)
