"""The exact exchange on grids of every kind that the estimators know, with any meters, drawn by hypothesis."""

from dataclasses import replace

import numpy as np
from hypothesis import example, given, reject, seed
from hypothesis import strategies as st

from dsse_core.errors import EstimationDivergedError, NotObservableError
from dsse_core.estimation.bad_data import process_bad_data
from tests.support.back_ends import BACK_ENDS, back_end
from tests.support.exact_exchange import assert_equals_centralised, assert_same_decisions, run_feeder
from tests.support.grids import MeterShares, make_grid, with_gross_errors

GRIDS = st.fixed_dictionaries(
    dict(
        seed=st.integers(0, 10**6),
        n_bus=st.integers(3, 40),
        n_area=st.integers(2, 9),
        chain=st.sampled_from([0.3, 0.6, 0.9]),
        decades=st.sampled_from([0.0, 1.0, 2.0]),
        loops=st.integers(0, 3),
        transformers=st.sampled_from([0.0, 0.15]),
        short=st.sampled_from([None, 1e-4, 1e-6]),
        slack_at_root=st.booleans(),
        shares=st.builds(
            MeterShares,
            voltage=st.sampled_from([0.0, 0.1, 0.3]),
            angle=st.sampled_from([0.0, 0.1, 0.3]),
            flow=st.sampled_from([0.3, 0.6, 1.0]),
            current=st.sampled_from([0.0, 0.2, 0.5]),
            injection=st.sampled_from([0.7, 0.9, 1.0]),
            boundary_injection=st.sampled_from([0.0, 0.5, 1.0]),
        ),
    )
)


PLAIN = {"chain": 0.6, "decades": 2.0, "loops": 0, "transformers": 0.0, "short": None, "slack_at_root": True}

NO_VOLTAGES = MeterShares(voltage=0.0, flow=0.3, injection=0.7, boundary_injection=0.5)
NOTHING_KNOWN = {"seed": 218074, "n_bus": 3, "n_area": 2, "decades": 1.0, "short": 1e-6, "shares": NO_VOLTAGES}

WEAK = MeterShares(flow=0.3, current=0.5)
THREE_BUSES = {"seed": 467362, "n_bus": 3, "n_area": 3, "chain": 0.9, "decades": 1.0, "loops": 2, "transformers": 0.15}
THREE_BUSES = PLAIN | THREE_BUSES | {"slack_at_root": False, "shares": WEAK}

MANY_CURRENTS = MeterShares(voltage=0.3, angle=0.1, flow=0.3, current=0.5, injection=0.7, boundary_injection=1.0)
TURNED_FLOW = PLAIN | {"seed": 279, "n_bus": 25, "n_area": 3, "shares": MANY_CURRENTS}

FEW_METERS = MeterShares(voltage=0.0, angle=0.0, flow=0.6, current=0.0, injection=0.9, boundary_injection=0.5)
UNLIKE_IMPEDANCES = {"seed": 1438, "n_bus": 3, "n_area": 5, "chain": 0.3, "transformers": 0.15, "short": 1e-6}
UNLIKE_IMPEDANCES = PLAIN | UNLIKE_IMPEDANCES | {"shares": FEW_METERS}

NO_BOUNDARIES = MeterShares(voltage=0.3, angle=0.3, flow=0.3, current=0.2, injection=0.9, boundary_injection=0.0)
SHORT_BRANCHES = {"seed": 24, "n_bus": 24, "n_area": 4, "transformers": 0.15, "short": 1e-4, "shares": NO_BOUNDARIES}
ONLY_LOSSES = {"seed": 105, "n_bus": 3, "n_area": 2, "decades": 1.0, "shares": replace(NO_BOUNDARIES, current=0.5)}

ALL_KINDS = MeterShares(voltage=0.3, angle=0.3, flow=0.3, current=0.5, injection=0.7)
BENT = {"seed": 4647, "n_bus": 37, "n_area": 3, "chain": 0.9, "decades": 0.0, "loops": 3, "transformers": 0.15}
BENT = PLAIN | BENT | {"shares": ALL_KINDS}

MANY_FLOWS = MeterShares(voltage=0.1, angle=0.1)
FULL_TURN = {"seed": 1002, "n_bus": 37, "n_area": 2, "loops": 1, "transformers": 0.15, "short": 1e-4}
FULL_TURN = PLAIN | FULL_TURN | {"slack_at_root": False, "shares": MANY_FLOWS}

LONE_ANGLE = MeterShares(voltage=0.1, angle=0.1, flow=0.3, current=0.2, injection=0.7, boundary_injection=1.0)
LONE_ANGLE = {"seed": 110, "n_bus": 3, "n_area": 6, "chain": 0.3, "decades": 1.0, "short": 1e-6, "shares": LONE_ANGLE}
LONE_ANGLE = PLAIN | LONE_ANGLE | {"transformers": 0.15}

TWO_ANGLES = MeterShares(voltage=0.3, angle=0.3, current=0.2, injection=0.7, boundary_injection=0.5)
TWO_ANGLES = {"seed": 9, "n_bus": 12, "n_area": 9, "chain": 0.9, "short": 1e-6, "shares": TWO_ANGLES}
TWO_ANGLES = PLAIN | TWO_ANGLES | {"transformers": 0.15, "slack_at_root": False}

SHORT_CURRENT = {"seed": 56642, "n_bus": 38, "n_area": 8, "chain": 0.3, "loops": 2, "transformers": 0.15, "short": 1e-6}
SHORT_CURRENT = PLAIN | SHORT_CURRENT | {"shares": MeterShares(voltage=0.3, angle=0.3, flow=1.0, current=0.2)}

ALL_BUT_FLOWS = MeterShares(voltage=0.3, angle=0.3, flow=0.3, current=0.2, injection=0.9, boundary_injection=1.0)
LARGE_FLOW = PLAIN | {"seed": 2, "n_bus": 3, "n_area": 2, "chain": 0.3, "transformers": 0.15, "short": 1e-6}
LARGE_FLOW |= {"slack_at_root": False, "shares": ALL_BUT_FLOWS}

CURRENT_BESIDE = {"seed": 19551, "n_bus": 28, "n_area": 7, "chain": 0.3, "loops": 1, "short": 1e-6}
CURRENT_BESIDE = PLAIN | CURRENT_BESIDE | {"transformers": 0.15, "slack_at_root": False}
CURRENT_BESIDE |= {"shares": replace(ALL_KINDS, injection=1.0)}


@seed(1)  # the same grids whatever the words of this test
@example(THREE_BUSES, 0.3, 81, "radial")  # critical after a removal
@example(TURNED_FLOW, 0.3, 380, "dense")  # a bad injection turns a flow, and a current magnitude would keep it so
@example(UNLIKE_IMPEDANCES, 0.0, 40, "sparse")  # critical where one area's are five thousand times those of the other
@example(PLAIN | NOTHING_KNOWN, 0.3, None, "radial")  # the same, where a voltage is not known at no load
@example(PLAIN | SHORT_BRANCHES, 0.0, 24, "dense")  # over them information changes with a state that has hardly moved
@example(BENT, 0.6, None, "sparse")  # current magnitudes make it converge by shares only
@example(PLAIN | ONLY_LOSSES, 0.6, 2, "radial")  # of a flow and its opposite, as current magnitudes do
@example(FULL_TURN, 0.3, None, "dense")  # transformers turn one bus past half a turn, another not
@example(LONE_ANGLE, 0.3, 107, "sparse")  # behind a phase-shifting transformer, all that is known of an area's power
@example(TWO_ANGLES, 0.6, 0, "radial")  # magnitudes and angles tell each other's, across a transformer's tap, too
@example(SHORT_CURRENT, 0.3, None, "dense")  # a step from next to the minimum leads to another, at J of 4e7
@example(LARGE_FLOW, 0.0, None, "radial")  # a sigma depends on the state at which the other side has told
@example(CURRENT_BESIDE, 0.0, 558, "radial")  # sigmas change by 5e-6 with a state that moves by 4e-9
@given(GRIDS, st.sampled_from([0.0, 0.3, 0.6]), st.one_of(st.none(), st.integers(0, 1000)), st.sampled_from(BACK_ENDS))
def test_any_grid_with_any_meters_reaches_it(grid, loss, gross_errors, areas_on):
    feeder = make_grid(**grid)
    if not any(b.p_load for b in feeder.network.buses if b.id != feeder.network.slack.bus):
        reject()  # where nothing flows, a gross error leaves several minima
    if gross_errors is not None:
        feeder = with_gross_errors(np.random.default_rng(gross_errors), feeder)
    try:
        process_bad_data(feeder.network, feeder.measurements, tolerance=1e-11)
    except (NotObservableError, EstimationDivergedError):
        reject()
    with back_end(areas_on):
        bus, report = run_feeder(feeder, loss, 0)
    assert_equals_centralised(bus, report)
    if len(feeder.partition.areas) > 1:
        assert_same_decisions(bus, report)
