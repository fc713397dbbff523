"""The stored answers of the centralised estimator, and the input that each belongs to."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dsse_core.grid.network import Network
from tests.golden.centralised.oracle_cases import Drawn, Readings

FILE = Path(__file__).parent / "oracle.npz"
PER_BUS = ("vm", "va", "sigma_vm", "sigma_va")
PER_METER = ("values", "sigmas")


@dataclass(frozen=True)
class Frozen:
    """One case. ``vm``, ``va``, ``sigma_vm``, ``sigma_va`` (n_bus,) in network order, p.u. and rad; ``removed``: ids
    of the meters taken out, in order; ``objective``: J without them.

    The input: ``values``, ``sigmas`` (n_meas,) of the meters, ``numbers`` of the network (``numbers_of``) and ``hash``
    of everything that is no number (``hash_of``).
    """

    name: str
    drawn: Drawn
    hash: str
    numbers: np.ndarray
    values: np.ndarray
    sigmas: np.ndarray
    vm: np.ndarray
    va: np.ndarray
    sigma_vm: np.ndarray
    sigma_va: np.ndarray
    objective: float
    removed: tuple[str, ...]

    def frozen_readings(self, readings: Readings) -> Readings:
        """``readings`` with the stored values and sigmas: rounding in a power flow shall not count."""
        pairs = zip(readings.measurements, self.values.tolist(), self.sigmas.tolist(), strict=True)
        return replace(readings, measurements=tuple(replace(m, value=z, sigma=sigma) for m, z, sigma in pairs))


def name_of(drawn: Drawn) -> str:
    """Unique among the cases, for messages."""
    arguments, gross = drawn["arguments"], drawn["gross_errors"]
    what = arguments.get("name") or f"{arguments['seed']}-{arguments['n_bus']}"
    return f"{drawn['kind']} {what}" + ("" if gross is None else f" gross {gross}")


def numbers_of(network: Network) -> np.ndarray:
    """Every number of the network that an estimate depends on, p.u. and rad."""
    of_branches = [(b.r, b.x, b.g, b.b, b.tap, b.shift) for b in network.active_branches]
    of_buses = [(bus.g_shunt, bus.b_shunt) for bus in network.buses]
    slack = network.slack.va if network.slack else 0.0
    return np.concatenate([np.ravel(of_branches), np.ravel(of_buses), [slack]]).astype(float)


def hash_of(readings: Readings) -> str:
    """Of buses, branches, slack bus and meters in their order; no float, which the next processor may round otherwise.

    The order counts: what is stored follows it.
    """
    network = readings.network
    parts = [
        [bus.id for bus in network.buses],
        [[b.id, b.from_bus, b.to_bus] for b in network.active_branches],
        network.slack.bus if network.slack else None,
        [[m.meter.id, m.meter.source.value] for m in readings.measurements],
    ]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def save_oracle(path: Path, cases: Sequence[Frozen], about: Mapping[str, Any]) -> None:
    """One compressed file; the same cases give the same bytes."""
    index = [
        {
            "drawn": case.drawn,
            "hash": case.hash,
            "removed": case.removed,
            "objective": case.objective,
            "lengths": [len(case.vm), len(case.values), len(case.numbers)],
        }
        for case in cases
    ]
    text = json.dumps({"about": about, "cases": index}, sort_keys=True)
    columns = {
        name: np.concatenate([getattr(case, name) for case in cases]) for name in (*PER_BUS, *PER_METER, "numbers")
    }
    np.savez_compressed(path, index=np.frombuffer(text.encode(), dtype=np.uint8), **columns)


def load_oracle(path: Path = FILE) -> tuple[list[Frozen], dict[str, Any]]:
    """The cases, and what is told about them: command, commit, versions, tolerance."""
    with np.load(path, allow_pickle=False) as stored:
        text = json.loads(stored["index"].tobytes())
        columns = {name: stored[name] for name in stored.files if name != "index"}
    lengths = np.array([entry["lengths"] for entry in text["cases"]])
    parts: dict[str, list[np.ndarray]] = {}
    for names, length in zip((PER_BUS, PER_METER, ("numbers",)), lengths.T, strict=True):
        parts |= {name: np.split(columns[name], np.cumsum(length)[:-1]) for name in names}
    cases = [
        Frozen(
            name=name_of(entry["drawn"]),
            drawn=entry["drawn"],
            hash=entry["hash"],
            objective=entry["objective"],
            removed=tuple(entry["removed"]),
            **{name: part[k] for name, part in parts.items()},
        )
        for k, entry in enumerate(text["cases"])
    ]
    return cases, text["about"]
