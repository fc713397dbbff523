"""A phase that opens behind a delta winding, where shunts alone join the phases to ground."""

from __future__ import annotations

import json
from pathlib import Path

import consensus_dsse as dsse
from coordinator.lab.simulator.simulate import Simulation
from tests.support.centre import GAP


def make_scenario(folder: Path) -> dsse.Scenario:
    """Two areas that meet in the part behind a delta bank, with capacitors beyond the phase that opens."""

    def line(ends: tuple[int, int], phases: str, **more: object) -> dict[str, object]:
        r, x = ([[*[mutual] * k, own] for k in range(len(phases))] for own, mutual in ((0.1, 0.02), (0.3, 0.08)))
        return {"from": ends[0], "to": ends[1], "phases": phases, "r_ohm": r, "x_ohm": x} | more

    windings = [{"bus": k, "phases": "abc", "kv": kv, "connection": "delta"} for k, kv in ((2, 12.47), (3, 4.16))]
    network = {
        "name": "opens",
        "data_source": "made up",
        "base_mva": 1.0,
        "bus": [{"id": k, "base_kv": 12.47 if k < 3 else 4.16, "phases": "abc"} for k in range(1, 6)],
        "branch": [
            line((1, 2), "abc"),
            line((3, 4), "abc"),
            line((4, 5), "bc", id="keep"),
            line((4, 5), "a", id="sw", switch=True),
        ],
        "transformer": [{"windings": windings, "kva": 1000.0, "r_percent": 1.0, "x_percent": 5.0}],
        "source": [{"bus": 1, "kind": "slack", "vm_pu": 1.0}],
        "load": [{"bus": 5, "phases": "ab,bc,ca", "p_kw": [8, 8, 9], "q_kvar": [3, 3, 4]}],
        "shunt": [{"bus": 5, "phases": "a,b,c", "b_kvar": [40, 40, 40]}],
    }
    flow, every = {"branches": "all", "sigma_percent": 1.0}, {"buses": "all"}
    scenario = {
        "version": 1,
        "name": "opens",
        "description": "a phase opens",
        "network": "network.json",
        "areas": {"up": {"buses": [1, 2, 3, 4]}, "low": {"buses": [4, 5]}},
        "measurements": {
            "floor_kva": 0.1,
            "voltage": every | {"sigma_percent": 0.5},
            "flow": flow,
            "injection": every | {"sigma_percent": 5.0},
        },
        "telemetry": {"source": "network", "noise": False},
        "tolerances": {"estimator": 1e-9},
        "faults": {"events": [{"at_s": 2.0, "switch": "sw", "to": "open"}]},
    }
    (folder / "network.json").write_text(json.dumps(network))
    (folder / "scenario.json").write_text(json.dumps(scenario))
    return dsse.load_scenario(folder / "scenario.json")


def test_areas_follow_a_phase_that_opens_where_shunts_alone_hold_the_voltages_to_ground(
    tmp_path: Path,
) -> None:
    simulation = Simulation(make_scenario(tmp_path))
    outcome = simulation.evaluate(simulation.run())
    assert outcome.verdict.consensus, outcome.verdict
    assert outcome.comparison.gap.vm_pu < GAP
    assert outcome.comparison.error.vm_pu < 1e-9
    v, node = outcome.comparison.decentralised.vm, outcome.scenario.network.node
    assert v[node(3, "a")] > 1.4  # far from the 1 p.u. of before
    assert v[node(5, "a")] == 0
