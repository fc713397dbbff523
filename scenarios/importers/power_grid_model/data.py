"""power-grid-model input data: read by power-grid-model's own reader, checked by its own validator."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.files.wording import Suggestions
from dsse_core.printable import listed, on_one_line, shortened
from scenarios.importers.imported import Remark, load_extra
from scenarios.importers.power_grid_model.branches import BUILDERS

DESCRIPTION = "extra"
"""Key of a component under which power-grid-model-io puts its name in the source; nothing electric."""
TOP = ("version", "type", "is_batch", "attributes", "data")
LONGEST_SHOWN = 80  # characters of a name
APPLIANCES = {"sym_load": -1, "sym_gen": 1, "asym_load": -1, "asym_gen": 1}
"""Component -> sign of its power as an injection."""
SYMMETRIC_SENSORS = ("sym_voltage_sensor", "sym_power_sensor", "sym_current_sensor")
SENSORS = (*SYMMETRIC_SENSORS, "asym_voltage_sensor", "asym_power_sensor")
ASYMMETRIC = ("asym_load", "asym_gen", "asym_voltage_sensor", "asym_power_sensor")
"""Components of which one alone makes the calculation one of three phases."""
NOT_BY_PHASE = {
    "generic_branch": "power-grid-model has none in asymmetric calculations; replace it",
    **dict.fromkeys(SYMMETRIC_SENSORS, "a sensor of all phases beside asymmetric components; give an asymmetric one"),
}
IGNORED = {"fault": "for short circuits only", "transformer_tap_regulator": "taps stay where they are"}
SUPPORTED = {*BUILDERS, *APPLIANCES, *SENSORS, *IGNORED, "node", "link", "source", "shunt"}
NAME_PLATE = ("uk", "uk_min", "uk_max", "i0")
"""Values of transformers: the validator rejects implausible ones; power-grid-model computes with any above 0."""

Data = dict[str, Any]


def find_unknown_attributes(tree: Any, known: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """A problem for each attribute that its component does not have; ``known``: component -> its attributes.

    power-grid-model's own reader finds the other errors of ``tree``.
    """
    for component, allowed in known.items():
        unknown: dict[str, list[object]] = {}
        for row in _rows(tree, component):
            for name in row:
                if name not in allowed and name != DESCRIPTION:
                    unknown.setdefault(name, []).append(row.get("id", "without id"))
        compact = _table(tree, "attributes").get(component)
        for name in compact if isinstance(compact, list) else ():
            if name not in allowed:
                unknown.setdefault(str(name), [])
        meant = Suggestions(allowed)
        for name, owners in unknown.items():
            of = f" {listed([shortened(str(owner), LONGEST_SHOWN) for owner in owners])}" if owners else ""
            yield (
                f"{component}{of}: unknown attribute {shortened(name, LONGEST_SHOWN)!r}, which power-grid-model would "
                f"leave out{meant.find(name)}; correct or remove it, or put it under {DESCRIPTION!r} if it describes"
            )


def find_descriptions(tree: Any) -> Iterator[Remark]:
    """Remarks on parts of the file that are left out: descriptions, and keys outside the data."""
    described = [name for name in _table(tree, "data") if any(DESCRIPTION in row for row in _rows(tree, name))]
    if described:
        yield Remark("left out", f"{DESCRIPTION!r} of {listed(described)}, which describes them")
    if beside := [shortened(str(name), LONGEST_SHOWN) for name in tree if name not in TOP]:
        yield Remark("left out", f"beside the data: {listed(beside)}, which power-grid-model does not know")


def _table(tree: Any, name: str) -> Mapping[str, Any]:
    table = tree.get(name)
    return table if isinstance(table, dict) else {}


def _rows(tree: Any, component: str) -> list[dict[str, Any]]:
    rows = _table(tree, "data").get(component)
    return [row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []


def load_data(what: str, tree: Any) -> tuple[Data, list[Remark]]:
    """The tables that are not empty, and remarks on implausible values and left-out parts.

    ``tree``: JSON tree of file ``what``. power-grid-model, which has a parser of its own, gets it written again.

    Raises:
        InvalidInputError: power-grid-model is missing, cannot read the data or finds them wrong; or the network model
            cannot hold a component.
    """
    utils = load_extra("power_grid_model.utils", "power-grid-model", what)
    validation = load_extra("power_grid_model.validation", "power-grid-model", what)
    enum = load_extra("power_grid_model", "power-grid-model", what)
    if unknown := list(find_unknown_attributes(tree, _known_attributes(enum))):
        raise InvalidInputError(what, unknown)
    try:
        loaded = utils.json_deserialize(json.dumps(tree))
    except Exception as error:  # whatever a foreign reader raises
        raise InvalidInputError(what, [f"power-grid-model cannot read it: {on_one_line(error)}"]) from None
    data = {str(getattr(name, "value", name)): table for name, table in loaded.items() if len(table)}
    foreign = [
        f"{name} {ids(table)}: the network model cannot hold it"
        for name, table in data.items()
        if name not in SUPPORTED
    ]
    if is_asymmetric(data):
        foreign += [f"{name} {ids(data[name])}: {reason}" for name, reason in NOT_BY_PHASE.items() if name in data]
    if foreign:
        raise InvalidInputError(what, foreign)
    purpose = enum.CalculationType.state_estimation if has_sensors(data) else enum.CalculationType.power_flow
    table = enum.ComponentType.asym_voltage_sensor  # the validator asks for it where a current has a global angle
    whole = {table: enum.initialize_array("input", table, 0)} | loaded
    try:
        errors = (
            validation.validate_input_data(whole, calculation_type=purpose, symmetric=not is_asymmetric(data)) or []
        )
    except Exception as error:  # whatever a foreign validator raises
        problem = f"power-grid-model cannot check it ({type(error).__name__}: {on_one_line(error)})"
        raise InvalidInputError(what, [problem]) from None
    if wrong := [error for error in errors if not _is_computed_with(error, data)]:
        problems = [f"power-grid-model: {on_one_line(error)} Ids: {_ids_of(error)}" for error in wrong]
        raise InvalidInputError(what, problems)
    notes = [f"power-grid-model computes with it, but: {on_one_line(e)} Ids: {_ids_of(e)}" for e in errors]
    return data, [*(Remark("note", note) for note in notes), *find_descriptions(tree)]


def _known_attributes(power_grid_model: Any) -> dict[str, tuple[str, ...]]:
    """Component -> its attributes."""
    tables = power_grid_model.power_grid_meta_data["input"].items()
    return {str(getattr(name, "value", name)): tuple(table.dtype.names) for name, table in tables}


def rows(data: Data, name: str) -> Any:
    """The components called ``name``, none if the data have none."""
    return data.get(name, ())


def ids(components: Iterable[Any]) -> str:
    return listed([int(component["id"]) for component in components])


def is_asymmetric(data: Data) -> bool:
    return any(name in data for name in ASYMMETRIC)


def list_sensors(data: Data, quantity: str) -> Iterator[Any]:
    """The sensors of ``quantity``; of an asymmetric one three, with the values of a phase and its ``phase``."""
    yield from rows(data, f"sym_{quantity}_sensor")
    for sensor in rows(data, f"asym_{quantity}_sensor"):
        values = {name: sensor[name] for name in sensor.dtype.names}
        for k, phase in enumerate("abc"):
            yield {name: value[k] if np.ndim(value) else value for name, value in values.items()} | {"phase": phase}


def has_sensors(data: Data) -> bool:
    return any(name in data for name in SENSORS)


def working_sources(data: Data) -> list[Any]:
    return [source for source in rows(data, "source") if source["status"]]


def _is_computed_with(error: Any, data: Data) -> bool:
    """True where power-grid-model computes in spite of a finding of the validator.

    The type of an appliance is its voltage dependence, which a state estimation does not use.
    """
    name = str(getattr(error.component, "value", error.component))
    if name in APPLIANCES and error.field == "type":
        return has_sensors(data)
    if name != "transformer" or error.field not in NAME_PLATE:
        return False
    values = [float(row[error.field]) for row in rows(data, name) if row["id"] in error.ids]
    return all(value > 0 or math.isnan(value) for value in values)


def _ids_of(error: Any) -> str:
    """The elements of a validation error; of several tables (table, id) pairs."""
    found = [f"{i[0]} {i[1]}" if isinstance(i, tuple) else str(i) for i in error.ids]
    return listed(found)
