"""The table of meters: what each has read, what the estimate says instead, and what became of it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from dsse_core.estimation.residuals import CRITICAL_REDUNDANCY
from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.grid.network import Network
from dsse_core.results.state import GridState, read_state
from dsse_core.results.table import PHASE, Table
from dsse_core.results.units import base_a, base_kw

KIND = MeasurementKind
UNIT = {
    KIND.VM: "pu",
    KIND.VA: "deg",
    KIND.P_INJECTION: "kw",
    KIND.Q_INJECTION: "kvar",
    KIND.P_FLOW: "kw",
    KIND.Q_FLOW: "kvar",
    KIND.CURRENT: "a",
}
USED, REMOVED, CRITICAL, SILENT = "used", "removed", "critical", "silent"


def make_meter_table(
    state: GridState,
    meters: Sequence[Meter],
    values: np.ndarray,
    sigmas: np.ndarray,
    residual_variance: np.ndarray,
    removed: Mapping[str, float],
    critical: Collection[str],
) -> Table:
    """One row per meter, in its ``unit``.

    ``values``, ``sigmas``, ``residual_variance`` (n_meas,), p.u. and rad: readings, their standard deviations, and the
    variances of their residuals; nan where there is none, or none is known. A meter is ``silent`` without reading;
    ``removed``: ids of those taken out as bad data, with the normalised residual that each had then; ``critical``: ids.

    ``residual``: reading - estimate, ``normalised_residual``: its magnitude by its standard deviation, nan where the
    reading has no redundancy, or is exact.
    """
    size = find_unit_sizes(state.network, meters)
    is_angle = np.array([meter.kind is KIND.VA for meter in meters], dtype=bool)
    estimate = read_state(state, meters)
    residual = values - estimate
    residual[is_angle] = np.pi - (np.pi - residual[is_angle]) % (2 * np.pi)
    telling = residual_variance > CRITICAL_REDUNDANCY * sigmas**2
    normalised = np.where(telling, abs(residual) / np.sqrt(np.where(telling, residual_variance, 1.0)), np.nan)
    ids = [meter.id for meter in meters]
    for k, meter in enumerate(ids) if removed else ():
        normalised[k] = removed.get(meter, normalised[k])
    columns: dict[str, np.ndarray | Sequence[str]] = {
        "meter": ids,
        "kind": [str(meter.kind) for meter in meters],
        "bus": np.array([meter.bus for meter in meters], dtype=np.int64),
        "branch": [meter.branch or "" for meter in meters],
        "phase": [PHASE] * len(meters),
        "source": [str(meter.source) for meter in meters],
        "unit": [UNIT[meter.kind] for meter in meters],
        "reading": values * size,
        "sigma": sigmas * size,
        "estimate": estimate * size,
        "residual": residual * size,
        "normalised_residual": normalised,
        "status": _find_status(ids, np.isnan(values), removed, set(critical)),
    }
    return Table("meters", columns)


def _find_status(ids: Sequence[str], silent: np.ndarray, removed: Collection[str], critical: set[str]) -> list[str]:
    return [
        REMOVED if meter in removed else SILENT if no_reading else CRITICAL if meter in critical else USED
        for meter, no_reading in zip(ids, silent.tolist(), strict=True)
    ]


def find_unit_sizes(network: Network, meters: Sequence[Meter]) -> np.ndarray:
    """How many of its unit 1 p.u. or 1 rad of each meter is, (n_meas,)."""
    kw, a = base_kw(network), base_a(network).tolist()
    of_unit = {"pu": 1.0, "deg": 180 / np.pi, "kw": kw, "kvar": kw}
    row = network.row
    sizes = [of_unit.get(UNIT[m.kind]) or a[row[m.bus]] for m in meters]
    return np.array(sizes, dtype=float)
