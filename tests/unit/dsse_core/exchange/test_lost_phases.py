"""A bank that loses two of its phases while areas run: voltages that no load would leave floating are metered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.division import build_partition
from dsse_core.grid.loads import Load, Shunt
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.grid.measurement_model import build_measurement_model
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.nodes import PHASE_ANGLE
from dsse_core.grid.primitives import build_bank, build_line, connect
from dsse_core.power_flow.newton_raphson import solve_power_flow
from tests.support.centre import assert_goes_the_centres_way

KIND, SIGMA = MeasurementKind, 1e-3
LEGS = Load(3, "ab", 0.5 + 0.1j), Load(3, "bc", 0.2 + 0.1j), Load(3, "ca", 0.3 + 0.05j)
ONE = build_line("a", np.array([[0.01 + 0.02j]]), np.zeros((1, 1)))
SWITCHES = [Branch(p, 1, 2, 0.01, 0.02, switch=True, primitive=replace(ONE, from_phases=p, to_phases=p)) for p in "abc"]
BANK = Branch(
    "bank", 2, 3, 0.01, 0.05, primitive=build_bank(connect("abc", "grounded"), connect("abc", "delta"), 2 - 12j)
)
BUSES = tuple(Bus(k, 4.8, phases="abc") for k in (1, 2, 3))
NETWORK = Network("bank", 3.0, BUSES, (*SWITCHES, BANK), (Generator(1, Control.SLACK),), LEGS)


def find_voltages(network: Network) -> np.ndarray:
    """Voltages of all nodes with the loads as impedances, complex."""
    shunts = tuple(Shunt(leg.bus, leg.phases, leg.s.conjugate() / 3) for leg in LEGS)
    ybus = build_admittance(replace(network, loads=(), shunts=shunts)).ybus.toarray()
    v, given = np.exp(1j * PHASE_ANGLE[network.table.nodes.phase]), network.nodes_at(1)
    free = np.setdiff1d(np.arange(len(v)), given)
    v[free] = np.linalg.solve(ybus[np.ix_(free, free)], -ybus[np.ix_(free, given)] @ v[given])
    return v


def test_centre_and_areas_estimate_a_bank_with_one_phase_left_where_meters_tell_its_voltages() -> None:
    network = NETWORK.operated({"b": False, "c": False}).supplied()
    with pytest.raises(InvalidInputError, match="nothing joins phases of bus 3"):
        solve_power_flow(network)  # without load its voltages float
    virtual = [
        Meter(kind, 2, phases=p, source=Source.VIRTUAL) for p in "abc" for kind in (KIND.P_INJECTION, KIND.Q_INJECTION)
    ]
    virtual += [Meter(kind, 3, source=Source.VIRTUAL) for kind in (KIND.I_REAL, KIND.I_IMAG)]
    real = [Meter(kind, 3, phases=p) for p in "abc" for kind in (KIND.P_INJECTION, KIND.Q_INJECTION)]
    real += [Meter(KIND.VM, 3, phases=p) for p in ("ab", "bc", "ca")]
    real += [Meter(KIND.VM, 1, phases=p) for p in "abc"]
    real += [Meter(kind, 1, "a", phases="a") for kind in (KIND.P_FLOW, KIND.Q_FLOW)]
    v, noise = find_voltages(network), np.random.default_rng(1).standard_normal(len(real))
    z = build_measurement_model(network, build_admittance(network), real).predict(np.r_[np.angle(v), abs(v)])
    readings = [Measurement(meter, 0.0, 0.0) for meter in virtual]
    readings += [
        Measurement(m, *of) for m, *of in zip(real, (z + SIGMA * noise).tolist(), [SIGMA] * len(z), strict=True)
    ]
    partition = build_partition(NETWORK, {"head": [1, 2], "tail": [2, 3]}).operated({"b": False, "c": False})
    assert_goes_the_centres_way(partition, readings)
