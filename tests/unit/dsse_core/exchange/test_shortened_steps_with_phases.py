"""Coarse meters and far starts: areas shorten steps and begin anew as the centre does, on either side of a bank."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from dsse_core.estimation.decision import Decision, IterationLostError
from dsse_core.estimation.estimator import iterate_with_plan, plan_scan
from dsse_core.grid.admittance import flat_start
from dsse_core.grid.division import build_partition
from dsse_core.grid.measurement import Measurement
from dsse_core.grid.network import Network
from tests.support.centre import GAP, traced_centre
from tests.support.ieee_feeders import load_feeder
from tests.support.ieee_feeders.placing import cut_at, place_meters
from tests.support.levels import some_further
from tests.support.phases import run_rounds

ALONG = 1e-7  # p.u. and rad: the largest difference of x_k
MOVED = 1e-11  # p.u. and rad, of readings: the centre that then parts from itself has no way that others could go
N_MOVED = 5
N_DRAWS = 25
MOST, MOST_FAR = 0.9, 0.5  # shares of draws in which areas go the centre's way
CUTS = [(f"4bus-{name}", bus) for name in ("dy", "yd", "grdyd", "yy") for bus in (2, 3)]
FAR = 0.9  # of magnitudes, and rad
ANEW_SOON = {"4bus-dy": 5, "4bus-yd": 2, "4bus-grdyd": 2, "4bus-yy": 7}  # seeds whose start leads nowhere in few steps
SHORTENED = [(*cut, decades) for decades in (0.0, 2.0, 4.0) for cut in CUTS]
DRAWS = [*((*draw, 0.0) for draw in SHORTENED), *((*cut, 4.0, FAR) for cut in CUTS)]

Start = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Way:
    """Verdicts up to the first estimate, or to the end without one, and x after each."""

    verdicts: list[str]
    states: list[np.ndarray]

    @property
    def decisions(self) -> list[str]:
        return [verdict.split()[0] for verdict in self.verdicts]

    def find_gaps(self, other: Way) -> list[float]:
        return [float(abs(x - y).max()) for x, y in zip(self.states, other.states, strict=False)]

    def ends_as(self, other: Way) -> bool:
        return self.decisions == other.decisions and self.find_gaps(other)[-1] < GAP


def find_centres_way(network: Network, readings: Sequence[Measurement], start: Start | None) -> Way:
    with traced_centre() as (verdicts, states):
        plan, z, sigma = plan_scan(network, readings, reference=None, backend="auto")
        try:
            iterate_with_plan(plan, z, sigma, start=start)
        except IterationLostError as lost:
            verdicts.append(f"final {lost.reason}")
    return Way(verdicts, states)


def find_areas_way(network: Network, cut: int, readings: Sequence[Measurement], start: Start | None) -> Way:
    partition, states, n = build_partition(network, cut_at(network, (cut,))), [], network.n_nodes
    rounds = run_rounds(partition, readings, start=start, last=(Decision.EVALUATE, Decision.FINAL))
    for of_areas in rounds.states:
        x = np.empty(2 * n)
        for name, rows in partition.rows_of_nodes.items():
            x[np.r_[rows, n + rows]] = of_areas[name]
        states.append(x)
    return Way(rounds.verdicts, states)


def draw_start(network: Network, seed: int, far: float) -> Start | None:
    """Voltages without load, each moved by up to ``far`` of its magnitude, and rad; None where that is 0."""
    assert network.slack is not None
    rng, (vm, va) = np.random.default_rng(seed), flat_start(network, network.slack.bus)
    moved = vm * (1 + far * rng.uniform(-1, 1, len(vm))), va + far * rng.uniform(-1, 1, len(va))
    return moved if far else None


def parts_from_itself(way: Way, network: Network, readings: Sequence[Measurement], start: Start | None) -> bool:
    for seed in range(N_MOVED):
        moved = MOVED * np.random.default_rng(seed).choice([-1.0, 1.0], len(readings))
        others = [replace(m, value=m.value + by) if m.sigma else m for m, by in zip(readings, moved, strict=True)]
        other = find_centres_way(network, others, start)
        if not other.ends_as(way) or max(other.find_gaps(way)) > ALONG:
            return True
    return False


@pytest.mark.parametrize("draw", [draw for draw in SHORTENED if draw[-1] != 2.0], ids=str)
def test_areas_shorten_the_steps_that_the_centre_shortens(draw: tuple[str, int, float]) -> None:
    name, cut, decades = draw
    network = load_feeder(name)
    readings = place_meters(network, 4, decades, is_rich=False)
    way = find_centres_way(network, readings, None)
    assert "shorten" in way.decisions
    assert find_areas_way(network, cut, readings, None).ends_as(way)


@pytest.mark.parametrize("cut", CUTS, ids=str)
def test_areas_begin_anew_where_the_centre_does(cut: tuple[str, int]) -> None:
    network, seed = load_feeder(cut[0]), ANEW_SOON[cut[0]]
    readings, start = place_meters(network, seed, 4.0, is_rich=False), draw_start(network, seed, FAR)
    way = find_centres_way(network, readings, start)
    assert {"shorten", "anew"} <= {*way.decisions}
    assert find_areas_way(network, cut[1], readings, start).ends_as(way)


@pytest.mark.parametrize("draw", some_further(DRAWS, 6), ids=str)
def test_areas_go_another_way_only_where_the_centre_parts_from_itself(draw: tuple[str, int, float, float]) -> None:
    """Where steps wander, down to no voltage, rounding alone decides where they lead."""
    name, cut, decades, far = draw
    network, n_alike = load_feeder(name), 0
    for seed in range(N_DRAWS):
        readings, start = place_meters(network, seed, decades, is_rich=False), draw_start(network, seed, far)
        way = find_centres_way(network, readings, start)
        is_alike = find_areas_way(network, cut, readings, start).ends_as(way)
        assert is_alike or parts_from_itself(way, network, readings, start), seed
        n_alike += is_alike
    assert n_alike >= (MOST_FAR if far else MOST) * N_DRAWS
