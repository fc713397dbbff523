"""Parts that unlike shunts alone join to ground, as behind a delta winding: one phase may be near to ground."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from dsse_core.errors import EstimationDivergedError, InvalidInputError
from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.estimation.batch import estimate_batch
from dsse_core.estimation.estimator import estimate_with_plan, plan_scan
from dsse_core.grid.admittance import find_no_load
from dsse_core.grid.division import build_partition
from dsse_core.grid.loads import Shunt
from dsse_core.grid.network import Network
from dsse_core.power_flow.newton_raphson import solve_power_flow
from tests.support.centre import GAP
from tests.support.ieee_feeders import load_feeder
from tests.support.ieee_feeders.placing import cut_at, place_meters
from tests.support.phases import run_rounds

CAPACITOR, RESISTOR = 1j, 1.0


def grounded_by(shunts: Mapping[str, float], unit: complex, load: float = 0.2) -> Network:
    """The 4-bus feeder with a grounded-wye/delta bank, ``shunts`` in kW or kvar behind it, and a share of its load."""
    whole = load_feeder("4bus-grdyd")
    legs = tuple(Shunt(3, phase, unit * size * 3e-3 / whole.base_mva) for phase, size in shunts.items())
    return replace(whole, loads=tuple(replace(leg, s=leg.s * load) for leg in whole.loads), shunts=legs)


TWO_ALIKE = grounded_by({"a": 20, "b": 20}, CAPACITOR)
ONE_FIRMER = grounded_by({"b": 400, "c": 60}, RESISTOR)
ALL_UNLIKE = grounded_by({"a": 10, "b": 80, "c": 600}, CAPACITOR)


@pytest.mark.parametrize("network", [TWO_ALIKE, ONE_FIRMER, ALL_UNLIKE])
def test_centre_and_areas_find_the_voltages_of_parts_grounded_by_unlike_shunts(network: Network) -> None:
    true, readings = solve_power_flow(network), place_meters(network, 1, None, is_rich=False)
    result = process_bad_data(network, readings).result
    v, v_true = (of.vm * np.exp(1j * of.va) for of in (result, true))
    assert abs(v - v_true).max() < 0.01
    assert result.vm.min() > 0
    for bus in (2, 3):  # either side of the bank
        partition = build_partition(network, cut_at(network, (bus,)))
        rounds = run_rounds(partition, readings)
        for name, rows in partition.rows_of_nodes.items():
            assert abs(rounds.states[-1][name] - np.r_[result.va[rows], result.vm[rows]]).max() < GAP


def test_the_unloaded_state_is_that_in_which_currents_through_shunts_add_up_to_zero() -> None:
    vm, va = find_no_load(ALL_UNLIKE, 1001)
    v = (vm * np.exp(1j * va))[ALL_UNLIKE.nodes_at(3)]
    assert abs(v @ np.array([10, 80, 600])) < 1e-3 * 690  # lines have charging, too
    assert abs(v - np.roll(v, 1)) == pytest.approx(np.sqrt(3), abs=1e-3)
    assert vm[ALL_UNLIKE.nodes_at(4)] == pytest.approx(abs(v))


def test_an_image_with_a_negative_magnitude_is_no_estimate() -> None:
    readings = place_meters(TWO_ALIKE, 1, None, is_rich=False)
    plan, values, sigmas = plan_scan(TWO_ALIKE, readings, reference=None, backend="auto")
    found, row = estimate_with_plan(plan, values, sigmas), TWO_ALIKE.node(4, "c")
    assert f"vm@{TWO_ALIKE.node_names[row]}" not in {meter.id for meter in plan.meters}
    vm, va = found.vm.copy(), found.va.copy()
    vm[row], va[row] = -vm[row], va[row] + np.pi
    again = estimate_with_plan(plan, values, sigmas, start=(vm, va))
    assert again.memory.from_flat_start
    assert again.vm == pytest.approx(found.vm, abs=GAP)


def test_an_iteration_that_ends_below_a_magnitude_of_0_names_the_node() -> None:
    network = grounded_by({"a": 181, "b": 1.4}, CAPACITOR, load=1.0)
    with pytest.raises(EstimationDivergedError, match=r"it has come to -0\.\d+ p\.u\. at bus 4\.a, where no grid is"):
        process_bad_data(network, place_meters(network, 13, None, is_rich=False))


def test_a_row_of_a_batch_that_ends_below_a_magnitude_of_0_is_a_failure_though_bad_data_are_looked_for() -> None:
    network = grounded_by({"a": 181, "b": 1.4}, CAPACITOR, load=1.0)
    readings = place_meters(network, 13, None, is_rich=False)
    plan, values, sigmas = plan_scan(network, readings, reference=None, backend="auto")
    k = [meter.id for meter in plan.meters].index("p_injection@4.a")
    values[k] += 15 * sigmas[k]
    assert estimate_with_plan(plan, values, sigmas).vm.min() < 0
    batch = estimate_batch(plan, values[np.newaxis], sigmas)
    assert "p.u. at bus 4.a, where no grid is" in batch.failures[0].text
    assert np.isnan(batch.vm).all()


def test_a_corner_that_shunts_hold_at_ground_is_refused_by_name() -> None:
    network = grounded_by({"b": 400}, RESISTOR)
    cure = "give their other phases shunts to ground, too, or none of them"
    with pytest.raises(InvalidInputError, match=rf"shunts to ground hold 3\.b, 4\.b at a voltage of 0.*; {cure}"):
        solve_power_flow(network)
