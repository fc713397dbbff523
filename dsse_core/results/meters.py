"""The table of meters: the reading, the estimate, the residual and the status of each."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from dsse_core.estimation.residuals import CRITICAL_REDUNDANCY
from dsse_core.grid.columns import read_column
from dsse_core.grid.measurement import KIND_OF, Meter
from dsse_core.grid.meter_table import (
    KINDS,
    QUANTITY,
    list_columns,
    list_ids,
    list_texts,
    number_kinds,
    tabulate_meters,
)
from dsse_core.grid.network import Network
from dsse_core.grid.quantities import Quantity
from dsse_core.grid.switches import find_dead_meters
from dsse_core.results.columns import MeterColumns
from dsse_core.results.state import GridState, read_state
from dsse_core.results.table import ALL_PHASES, NO_SCAN, ScanLabel, Table
from dsse_core.results.units import base_a, base_kw

UNITS = ("pu", "deg", "kw", "kvar", "a")
QUANTITIES = ("value", "sigma", "estimate", "residual")
"""Columns in the unit of each meter: ``value_kw`` and so on."""
STATUS = USED, REMOVED, CRITICAL, SILENT, DEAD = "used", "removed", "critical", "silent", "silent: dead"


def make_meter_table(
    state: GridState,
    meters: Sequence[Meter],
    values: np.ndarray,
    sigmas: np.ndarray,
    residual_variance: np.ndarray,
    removed: Mapping[str, float],
    critical: Collection[str],
    label: ScanLabel = NO_SCAN,
) -> Table:
    """One row per meter; the columns QUANTITIES have a value in its unit alone.

    ``values``, ``sigmas``, ``residual_variance`` (n_meas,), p.u. and rad: readings, their standard deviations, and the
    variances of their residuals; nan where there is none, or none is known. A meter without reading is ``silent``, one
    where there is no supply ``silent: dead``.
    ``removed``: ids of the meters taken out as bad data, with the normalised residual that each had then. ``critical``:
    ids of critical meters. ``label``: of the scan.

    ``residual``: reading - estimate, ``normalised_residual``: its magnitude by its standard deviation, nan where the
    reading has no redundancy, or is exact.
    """
    size, kinds = find_unit_sizes(state.network, meters), number_kinds(meters)
    is_angle = QUANTITY[kinds] == Quantity.VA
    estimate = read_state(state, meters)
    residual = values - estimate
    residual[is_angle] = np.pi - (np.pi - residual[is_angle]) % (2 * np.pi)
    telling = residual_variance > CRITICAL_REDUNDANCY * sigmas**2
    normalised = np.where(telling, abs(residual) / np.sqrt(np.where(telling, residual_variance, 1.0)), np.nan)
    ids, texts = list_ids(meters), list_columns(meters)
    row_of = _find_rows(ids, {*removed, *critical})
    for meter in removed.keys() & row_of.keys():
        normalised[row_of[meter]] = removed[meter]
    numbers = values * size, sigmas * size, estimate * size, residual * size
    in_units = {
        f"{name}_{unit}": np.where(_has_unit(unit)[kinds], column, np.nan)
        for name, column in zip(QUANTITIES, numbers, strict=True)
        for unit in UNITS
    }
    scan, time = label.columns(len(meters))
    columns = MeterColumns(
        meter=ids,
        kind=texts["kind"],
        bus=np.array(texts["bus"], dtype=np.int64),
        branch=[branch or "" for branch in texts["branch"]],
        phase=[phases or ALL_PHASES for phases in texts["phases"]],
        source=texts["source"],
        status=_find_status(row_of, np.isnan(values), removed, critical, find_dead_meters(state.network, meters)),
        **in_units,
        normalised_residual=normalised,
        scan=scan,
        time=time,
    )
    return Table("meters", vars(columns))


def _has_unit(unit: str) -> np.ndarray:
    """True for each of KINDS that has ``unit``, (n_kind,)."""
    return np.array([kind.quantity.unit == unit for kind in KINDS])


def read_in_own_units(meters: Table) -> dict[str, np.ndarray]:
    """The columns QUANTITIES of a table of ``meters``, each value in the unit of its meter, (n_meas,)."""
    of_unit = [np.array([KIND_OF[kind].quantity.unit == unit for kind in meters.kind], dtype=bool) for unit in UNITS]
    found = {}
    for name in QUANTITIES:
        columns = [meters[f"{name}_{unit}"] for unit in UNITS]
        found[name] = np.select(of_unit, columns, np.nan)
    return found


def _find_rows(ids: Sequence[str], wanted: Collection[str]) -> dict[str, int]:
    """Id -> its position in ``ids``, for each of ``wanted`` that is there."""
    return {meter: row for row, meter in enumerate(ids) if meter in wanted} if wanted else {}


def _find_status(
    row_of: Mapping[str, int],
    silent: np.ndarray,
    removed: Collection[str],
    critical: Collection[str],
    dead: np.ndarray,
) -> list[str]:
    status = np.full(len(silent), STATUS.index(USED))
    status[[row_of[meter] for meter in critical if meter in row_of]] = STATUS.index(CRITICAL)
    status[silent] = STATUS.index(SILENT)
    status[[row_of[meter] for meter in removed if meter in row_of]] = STATUS.index(REMOVED)
    status[dead] = STATUS.index(DEAD)
    return list_texts(STATUS, status)


def find_unit_sizes(network: Network, meters: Sequence[Meter]) -> np.ndarray:
    """The size of 1 p.u. or 1 rad in the unit of each meter, (n_meas,); of a total the power base of its phases."""
    kw, n_phases = base_kw(network), tabulate_meters(network, meters).n_phases
    of_unit = {"pu": 1.0, "deg": 180 / np.pi, "kw": kw, "kvar": kw, "a": np.nan}
    kinds, row = number_kinds(meters), network.table.rows.find(read_column(meters, "bus", np.int64))
    of_kind = np.array([of_unit[kind.quantity.unit] for kind in KINDS])
    sizes: np.ndarray = n_phases * np.where(_has_unit("a")[kinds], base_a(network)[row], of_kind[kinds])
    return sizes
