"""A configuration as plain values, key by key: what a file of it holds, and what its digest covers."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from enum import StrEnum
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from dsse_core.grid.columns import Records
from dsse_core.grid.measurement import Meter
from dsse_core.grid.meter_table import list_columns
from dsse_core.grid.network import Branch, Bus, Generator
from dsse_core.grid.partition import Neighbour
from dsse_core.link_faults import LinkFaults
from dsse_core.reading_rules import DEFAULT_RULES, ReadingRules

if TYPE_CHECKING:
    from agents.protocol.configuration import Configuration


def columns_of(cls: Any, items: Sequence[Any]) -> dict[str, Any]:
    """Dataclasses as one table with a list for each key; a key of defaults only is left out."""
    of_meters = list_columns(items) if cls is Meter else {}
    columns = ((key, of_meters.get(key) or _column_of(key, items), default) for key, default in keys_of(cls))
    return {
        key: column
        for key, column, default in columns
        if default is dataclasses.MISSING or column.count(default) < len(column)
    }


def _column_of(key: str, items: Sequence[Any]) -> Sequence[Any]:
    if isinstance(items, Records):
        given: Sequence[Any] | np.ndarray = items.columns.get(key, ())
        return given.tolist() if isinstance(given, np.ndarray) else given
    column = list(map(attrgetter(key), items))
    is_enumeration = bool(column) and isinstance(column[0], StrEnum)
    return list(map(str, column)) if is_enumeration else column  # plain text is written in a fraction of the time


def table_of(content: Configuration, all_of: Callable[[Any, Sequence[Any]], Any] = columns_of) -> dict[str, Any]:
    """The keys of ``content``; ``all_of``: how those of many buses, branches, generators or meters are put."""
    area, network = content.area, content.area.network
    slack = {"bus": area.slack_bus} | ({} if area.slack_vm is None else {"vm": area.slack_vm})
    return {
        **({"split": dataclasses.asdict(content.split)} if content.split else {}),
        "run": content.run,
        "area": area.name,
        "strategy": content.strategy,
        "endpoints": list(content.endpoints),
        **({"listen": list(content.listen)} if content.listen else {}),
        "beat_s": content.beat_s,
        **({"scan_s": content.scan_s} if content.scan_s is not None else {}),
        "tolerance": content.tolerance,
        "seed": content.seed,
        **({"clock_error_s": content.clock_error_s} if content.clock_error_s else {}),
        "admm": {"penalty": content.penalty},
        "quality": dataclasses.asdict(content.limits),
        **({"telemetry": _readings_table(content.readings)} if content.readings != DEFAULT_RULES else {}),
        "local_slack": slack,
        "exchange": {
            **({"towards_hub": area.towards_hub} if area.towards_hub else {}),
            "areas": area.n_areas,
            "entry_vm": area.entry_voltage[0],
            "entry_va": area.entry_voltage[1],
            **({"no_load": [list(voltage) for voltage in area.no_load]} if area.no_load else {}),
        },
        **({"reference": dict(zip(("bus", "va"), area.reference, strict=True))} if area.reference else {}),
        "load_messages": {
            "generation": content.generation,
            "p_error": content.load_error.real,
            "q_error": content.load_error.imag,
        },
        "neighbour": [_neighbour_row(n, content.links.get(n.area, LinkFaults())) for n in area.neighbours],
        "network": {
            "base_mva": network.base_mva,
            "bus": all_of(Bus, network.buses),
            "branch": all_of(Branch, network.branches),
            "generator": all_of(Generator, network.generators),
        },
        "meter": all_of(Meter, content.meters),
    }


def _readings_table(rules: ReadingRules) -> dict[str, Any]:
    gateways = {name: meters if meters == "all" else list(meters) for name, meters in rules.gateways.items()}
    kinds = [{"kind": str(kind), **_row_of(rule)} for kind, rule in rules.kinds.items()]
    return {"ticks": rules.ticks, "leader": rules.leader, "gateways": gateways, "kind": kinds}


def rows_of(_: Any, items: Sequence[Any]) -> list[dict[str, Any]]:
    return [_row_of(item) for item in items]


def _row_of(item: Any) -> dict[str, Any]:
    """A dataclass as a table: values that equal their default are left out, and so is None."""
    values = ((key, getattr(item, key), default) for key, default in _known_keys_of(item.__class__))
    return {key: value for key, value, default in values if default is dataclasses.MISSING or value != default}


def keys_of(cls: Any) -> list[tuple[str, Any]]:
    """Name and default of every field that a dataclass is made of."""
    return [(f.name, f.default) for f in dataclasses.fields(cls) if f.init]


_known_keys_of = functools.cache(keys_of)


def _neighbour_row(neighbour: Neighbour, faults: LinkFaults) -> dict[str, Any]:
    return _row_of(neighbour) | ({"faults": _row_of(faults)} if faults != LinkFaults() else {})
