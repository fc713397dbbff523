"""Readings from Python as the text of a readings file: columns of a frame or table, or arrays by meter."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.files.wording import suggest
from dsse_core.grid.measurement import Source
from dsse_core.results.meters import find_unit_sizes
from dsse_core.results.table import Table
from scenarios.scenario import Scenario
from scenarios.telemetry import make_telemetry

COLUMNS = "meter, value_UNIT and sigma_UNIT"
UNKNOWN = frozenset(("", "None", "nan", "<NA>", "NaT"))


def write_readings(scenario: Scenario, readings: Any) -> str:
    """``readings`` as the text of a readings file; see ``consensus_dsse.estimate``.

    Raises:
        InvalidInputError: a name is neither a column of a readings file nor a meter of ``scenario``, or lengths differ.
    """
    given: Any = getattr(readings, "column_names", None)
    given = getattr(readings, "columns", None) if given is None else given
    if given is None and not isinstance(readings, Mapping):
        raise InvalidInputError("readings", [f"found {type(readings).__name__}; give a path, frame, table or mapping"])
    names = list(readings if given is None else given)
    if "meter" not in names:
        return _write_wide(scenario, {name: readings[name] for name in names}, getattr(readings, "index", None))
    first = [name for name in ("meter", "scan") if name in names]
    return _write({str(name): _filled(readings[name], "") for name in dict.fromkeys([*first, *names])})


def _filled(column: Any, empty: Any, dtype: Any = None) -> np.ndarray:
    """``column`` with ``empty`` where it is masked."""
    return np.asarray(column.astype(object).filled(empty) if np.ma.is_masked(column) else column, dtype)


def _write(columns: Mapping[str, np.ndarray]) -> str:
    if len(lengths := {len(column) for column in columns.values()}) > 1:
        raise InvalidInputError("readings", [f"columns have different lengths: {sorted(lengths)}; give one length"])
    kept = {name: column if column.dtype.kind in "iuf" else _as_texts(column) for name, column in columns.items()}
    return Table("readings", kept).to_csv()


def _as_texts(column: np.ndarray) -> Sequence[str]:
    return ["" if (text := str(cell)) in UNKNOWN else text for cell in column]


def _write_wide(scenario: Scenario, values: Mapping[str, Any], index: Any) -> str:
    """A row for each reading, with the standard deviation that the meter has in the scenario's own scan."""
    own = {m.meter.id: m for m in make_telemetry(scenario).union if m.meter.source is not Source.VIRTUAL}
    if unknown := [str(name) for name in values if name not in own]:
        problems = [f"{name!r} is no meter of {scenario.name!r}{suggest(name, own)}" for name in unknown[:10]]
        raise InvalidInputError("readings", [*problems, f"give its meters, or columns {COLUMNS}"])
    try:
        arrays = [np.atleast_1d(_filled(column, np.nan, float)) for column in values.values()]
    except (TypeError, ValueError) as error:
        raise InvalidInputError("readings", [f"each meter has a number or an array of numbers: {error}"]) from None
    if len(shapes := {column.shape for column in arrays}) != 1 or len(next(iter(shapes))) > 1:
        problem = f"meters have arrays of the shapes {sorted(shapes)}; give one number for each scan"
        raise InvalidInputError(
            "readings", [problem if shapes else f"there are none; give meters, or columns {COLUMNS}"]
        )
    meters, matrix = [own[name].meter for name in values], np.array(arrays).T
    scan, column = np.nonzero(~np.isnan(matrix))
    columns: dict[str, np.ndarray] = {"meter": np.array(list(values))[column]}
    if any(np.ndim(each) for each in values.values()):
        names = list(map(str, range(1, len(matrix) + 1) if index is None else index))
        if wrong := [name for name, n in Counter(names).items() if n > 1 or name in UNKNOWN]:
            raise InvalidInputError("readings", [f"{name!r} names no row, or several; give each one" for name in wrong])
        columns["scan"] = np.array(names)[scan]
    sigmas = np.array([own[name].sigma for name in values]) * find_unit_sizes(scenario.network, meters)
    units = np.array([meter.kind.quantity.unit for meter in meters])
    for unit in dict.fromkeys(units.tolist()):
        is_in = units[column] == unit
        columns[f"value_{unit}"] = np.where(is_in, matrix[scan, column], np.nan)
        columns[f"sigma_{unit}"] = np.where(is_in, sigmas[column], np.nan)
    return _write(columns)
