"""A tap that is not where the file has it is named with its steps, by centre and areas alike, and no meter goes."""

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest

from dsse_core.estimation import result
from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.estimation.residuals import describe_tap
from dsse_core.estimation.taps import find_wrong_taps
from dsse_core.grid.division import build_partition
from dsse_core.grid.measurement import Meter
from dsse_core.power_flow.newton_raphson import solve_power_flow
from tests.support.exact_exchange import assert_equals_centralised, run_feeder
from tests.support.feeders import KIND, Feeder, make_feeder, read_with_noise

STEP = 0.0125  # of the tap ratio


def draw_wrong_tap(seed: int) -> tuple[Feeder, str, int]:
    """A feeder with voltmeters of 0.2 % at every bus, a branch, and by how many steps its tap is off."""
    feeder, rng = make_feeder(seed, 30, 5, 0.5, 0.0, 0.8), np.random.default_rng([seed, 5])
    branches = feeder.network.branches
    tapped = [branch.id for branch in branches if branch.tap != 1.0] or [branches[0].id]
    network = replace(
        feeder.network, branches=tuple(replace(b, tap_steps=STEP) if b.id in tapped else b for b in branches)
    )
    wrong, steps = str(rng.choice(tapped)), int(rng.choice([-2, 2]))
    moved = [replace(b, tap=b.tap + steps * STEP) if b.id == wrong else b for b in network.branches]
    flow = solve_power_flow(replace(network, branches=tuple(moved)))
    meters = [m.meter for m in feeder.measurements if m.meter.kind is not KIND.VM]
    meters += [Meter(KIND.VM, bus.id) for bus in network.buses]
    largest = abs(flow.injection).max()
    read = tuple(read_with_noise(rng, meter, flow, largest, 0.0) for meter in meters)
    areas = {area.name: [bus.id for bus in area.network.buses] for area in feeder.partition.areas}
    return Feeder(network, build_partition(network, areas), read), wrong, steps


def test_areas_name_it_as_the_centre_does_and_are_degraded():
    feeder, wrong, steps = draw_wrong_tap(0)
    bus, report = run_feeder(feeder, 0.0, 0)
    assert (report.taps, report.removed, report.suspect) == ({wrong: steps}, (), None)
    assert_equals_centralised(bus, report)
    for state in bus.states.values():
        assert state.quality == "degraded"
        assert describe_tap(wrong, steps) in state.notes[0]


def test_the_estimate_of_the_whole_grid_looks_for_taps_once_at_each_end():
    feeder, wrong, steps = draw_wrong_tap(0)
    with mock.patch.object(result, "find_wrong_taps", wraps=find_wrong_taps) as find:
        report = process_bad_data(feeder.network, feeder.measurements)
    assert report.taps == {wrong: steps}
    assert find.call_count == 1 + len(report.removed)


@pytest.mark.n_cases(few=1, long=5, many=100)
def test_voltmeters_at_every_bus_tell_the_steps_of_any_tap(n_cases):
    right = 0
    for seed in range(n_cases):
        feeder, wrong, steps = draw_wrong_tap(seed)
        report = process_bad_data(feeder.network, feeder.measurements)
        right += report.taps == {wrong: steps} and not report.removed
    assert right >= 0.95 * n_cases
