"""Networks, meters and readings that the tests of the mathematics share."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from dsse_core.estimation.bad_data import BadDataReport, process_bad_data
from dsse_core.estimation.estimator import estimate_state
from dsse_core.estimation.result import EstimationResult
from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.grid.measurement_model import build_measurement_model
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.matrices import augmented
from dsse_core.power_flow.newton_raphson import PowerFlowResult
from scenarios.files.network_file import load_case

Kind = MeasurementKind


@pytest.fixture(params=["sparse", pytest.param("sparse, compiled", marks=pytest.mark.slow), "radial"])
def backend(request, monkeypatch: pytest.MonkeyPatch) -> str:
    """Every test with this fixture runs on both back ends of the estimate, on sparse matrices also compiled."""
    if request.param != "sparse":
        pytest.importorskip("numba", reason="compiled code needs numba: pip install 'consensus-dsse[fast]'")
    if request.param == "sparse, compiled":
        monkeypatch.setattr(augmented, "FEWEST_COMPILED", 0)
    return str(request.param).removesuffix(", compiled")


@pytest.fixture
def estimate(backend) -> Callable[..., EstimationResult]:
    """``estimate_state`` on each back end."""
    return partial(estimate_state, backend=backend)


@pytest.fixture
def process(backend) -> Callable[..., BadDataReport]:
    """``process_bad_data`` on each back end."""
    return partial(process_bad_data, backend=backend)


@pytest.fixture
def rich(backend, meshed) -> Network:
    """``meshed``, and for the tree its loops opened."""
    opened = tuple(b for b in meshed.branches if b.id not in ("2-3#2", "4-2"))
    return replace(meshed, branches=opened) if backend == "radial" else meshed


@pytest.fixture
def case() -> Callable[[str], Network]:
    return load_case


@pytest.fixture
def meshed() -> Network:
    """Seven buses with everything a branch can have: taps, phase shifts (30 and 150 degrees), charging, shunts,
    parallel branches, a loop, a branch out of service; bus 7 injects nothing."""
    return Network(
        name="meshed",
        base_mva=10.0,
        buses=(
            Bus(10, 110.0),
            Bus(2, 20.0, p_load=0.30, q_load=0.10, g_shunt=0.01, b_shunt=0.08),
            Bus(3, 20.0, p_load=0.20, q_load=0.15),
            Bus(4, 20.0, p_load=0.10, q_load=-0.05, b_shunt=-0.03),
            Bus(5, 0.4, p_load=0.25, q_load=0.08),
            Bus(6, 20.0, p_load=0.05, q_load=0.02),
            Bus(7, 20.0),
        ),
        branches=(
            Branch("10-2", 10, 2, 0.01, 0.08, tap=1.03, shift=math.radians(150)),
            Branch("2-3", 2, 3, 0.02, 0.04, b=0.03),
            Branch("2-3#2", 3, 2, 0.03, 0.05, b=0.02),
            Branch("3-4", 3, 4, 0.02, 0.03, b=0.01),
            Branch("4-2", 4, 2, 0.04, 0.06),
            Branch("5-4", 5, 4, 0.01, 0.05, tap=0.97, shift=math.radians(-30)),
            Branch("4-7", 4, 7, 0.01, 0.02),
            Branch("7-6", 7, 6, 0.01, 0.02, b=0.005),
            Branch("6-2", 6, 2, 0.01, 0.02, in_service=False),
        ),
        generators=(
            Generator(10, Control.SLACK, vm=1.02),
            Generator(6, Control.VOLTAGE, p=0.15, vm=1.01),
            Generator(5, Control.POWER, p=0.05, q=0.01),
        ),
    )


@pytest.fixture
def chain() -> Callable[..., Network]:
    """n buses in a row, total impedance 0.1 (1 + j) p.u., total load 0.5 + j0.25 p.u., slack at bus 1."""

    def build(n: int, short: Iterable[int] = ()) -> Network:
        z = {i: 1e-5 if i in set(short) else 0.1 / n for i in range(1, n)}
        return Network(
            name=f"chain of {n}",
            base_mva=1.0,
            buses=tuple(Bus(i, 10.0, p_load=0.5 / n, q_load=0.25 / n) for i in range(1, n + 1)),
            branches=tuple(Branch(f"{i}-{i + 1}", i, i + 1, z[i], z[i]) for i in range(1, n)),
            generators=(Generator(1, Control.SLACK),),
        )

    return build


@pytest.fixture
def meters_of() -> Callable[..., list[Meter]]:
    """Every meter of the given kinds, by default of all that meters read: at all buses, at both ends of all branches in
    service.
    """

    def build(network: Network, *kinds: Kind) -> list[Meter]:
        meters = []
        for kind in kinds or (kind for kind in Kind if not kind.is_virtual):
            if kind.of_branch:
                meters += [Meter(kind, bus, b.id) for b in network.active_branches for bus in (b.from_bus, b.to_bus)]
            else:
                meters += [Meter(kind, bus.id) for bus in network.buses]
        return meters

    return build


@pytest.fixture
def read() -> Callable[..., list[Measurement]]:
    """Readings of ``meters`` in a solved network: exact, or with ``sigma`` of noise from ``noise``."""

    def take(
        truth: PowerFlowResult,
        meters: Sequence[Meter],
        sigma: float = 0.01,
        noise: np.random.Generator | None = None,
    ) -> list[Measurement]:
        model = build_measurement_model(truth.network, build_admittance(truth.network), meters)
        values = model.predict(np.r_[truth.va, truth.vm])
        if noise is not None:
            values = values + sigma * noise.standard_normal(len(values))
        return [
            Measurement(m, 0.0, 0.0) if m.source is Source.VIRTUAL else Measurement(m, float(value), sigma)
            for m, value in zip(meters, values, strict=True)
        ]

    return take


@pytest.fixture
def zero_injections() -> Callable[[Network], list[Meter]]:
    """Virtual P and Q meters of the buses without load and source."""

    def find(network: Network) -> list[Meter]:
        sources = {g.bus for g in network.generators}
        passive = [b.id for b in network.buses if b.p_load == b.q_load == 0 and b.id not in sources]
        return [Meter(k, bus, source=Source.VIRTUAL) for bus in passive for k in (Kind.P_INJECTION, Kind.Q_INJECTION)]

    return find
