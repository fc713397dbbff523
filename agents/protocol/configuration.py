"""Configuration of an area: the value on which its terms rest. Other packages read and write its files.

Hub, neighbours, models, meters and the flat start follow from it. A configuration changes only between two scans,
together with those of all other areas (``rounds/``). ``table_of`` returns its plain values key by key: a file holds
these values, and its digest covers them.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from operator import attrgetter
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from agents.protocol.configuration_digest import digest_configuration
from dsse_core.estimation.state_limits import DEFAULT_LIMITS, StateLimits
from dsse_core.files.quantities import Name
from dsse_core.grid.columns import Records
from dsse_core.grid.loads import Load, Shunt
from dsse_core.grid.measurement import Meter
from dsse_core.grid.meter_table import list_columns
from dsse_core.grid.network import Branch, Bus, Generator
from dsse_core.grid.nodes import Primitive
from dsse_core.grid.partition import Area, Neighbour
from dsse_core.limits import ClockError, HeartbeatSeconds, Positive, ScanSeconds, Seed
from dsse_core.link_faults import LinkFaults
from dsse_core.reading_rules import DEFAULT_RULES, ReadingRules
from dsse_core.split_identity import DIGITS, END_OF_TIME, NO_SPLIT, SplitIdentity

Digest = Annotated[str, Field(pattern=rf"^[0-9a-f]{{{DIGITS}}}$")]


@dataclass(frozen=True, slots=True)
class SplitStamp:
    """Stamp that a split writes into each of its files. Stamps of one content are equal, whenever they were made."""

    digest: Annotated[Digest, Field(description="digest of the split, the same in all of its area files")]
    content: Annotated[Digest, Field(description="digest of this file as the split has written it")]
    time: Annotated[float, Field(ge=0, lt=END_OF_TIME, description="time of the split, s since 1970 UTC")] = field(
        compare=False
    )


OF_TABLES = {"area", "meters", "generation", "load_error", "links", "penalty", "limits", "readings", "split"}
"""Fields that are tables of an area file, or parts of them. Each other field is a key of the file: its name, its type
with the range, its default and its meaning in errors.
"""


@dataclass(frozen=True)
class Configuration:
    """One area as its agent knows it."""

    run: Annotated[Name, Field(description="name of the system that the area belongs to")]
    """Name of the system that the area belongs to; a part of every key on the bus."""
    area: Area
    meters: Sequence[Meter]
    """The area's meters, virtual ones included; readings come by telemetry."""
    strategy: Annotated[str, Field(description="name of the strategy of the exchange")]
    """Strategy of the exchange."""
    endpoints: Annotated[tuple[str, ...], Field(description="where to find the bus, e.g. tcp/127.0.0.1:7447")]
    """Addresses of the bus: routers, of which one is enough, or neighbours with direct links. May be edited."""
    listen: tuple[str, ...] = ()
    """Addresses at which the agent listens, with direct links. May be edited."""
    beat_s: HeartbeatSeconds = 0.2
    """Interval at which the last messages are repeated, s: `run.beat_s` of the scenario. May be edited."""
    scan_s: ScanSeconds | None = None
    """Time between two scans, s, where it is known: `run.scan_s` of the scenario."""
    tolerance: Positive = 1e-6
    """Largest last step of the estimator, p.u. and rad."""
    generation: str = "telemetered"
    """Load messages count the "telemetered" injection of substation and generators, or the "scheduled" one."""
    load_error: complex = 0j
    """Injected fault: added to the load at each boundary bus (eqs. 5.4, 5.5), p.u."""
    links: dict[str, LinkFaults] = field(default_factory=dict)
    """Neighbour -> injected faults of the link to it; the link to any other neighbour is sound."""
    seed: Seed = 0
    """Seed of the injected faults."""
    penalty: float = 1.0
    """Penalty of strategy ``admm``."""
    limits: StateLimits = DEFAULT_LIMITS
    """Limits of a reliable estimate."""
    readings: ReadingRules = DEFAULT_RULES
    """The gateway or clock that numbers scans, the gateways of the meters, and the ages of readings."""
    clock_error_s: ClockError = 0.0
    """Injected error of the clock: its lead, s."""
    split: SplitStamp | None = field(default=None, compare=False)
    """Stamp of the split of the configuration; None in files of versions without splits."""

    @functools.cached_property
    def identity(self) -> SplitIdentity:
        """The split of this configuration; with the digest of its present content if it was edited since."""
        if self.split is None:
            return NO_SPLIT
        found = digest_configuration(table_of(self))
        return SplitIdentity(self.split.digest, self.split.time, "" if found == self.split.content else found)


def columns_of(cls: Any, items: Sequence[Any]) -> dict[str, Any]:
    """Returns dataclasses as one table with a list for each key, without keys that have only defaults."""
    of_meters = list_columns(items) if cls is Meter else {}
    columns = ((key, of_meters.get(key) or _column_of(key, items), default) for key, default in keys_of(cls))
    return {
        key: column
        for key, column, default in columns
        if default is dataclasses.MISSING or column.count(default) < len(column)
    }


def _column_of(key: str, items: Sequence[Any]) -> Sequence[Any]:
    column: Sequence[Any]
    if isinstance(items, Records):
        given: Sequence[Any] | np.ndarray = items.columns.get(key, ())
        column = given.tolist() if isinstance(given, np.ndarray) else given
    else:
        column = list(map(attrgetter(key), items))
    if column and (write := _WRITE.get(type(column[0]))):
        return list(map(write, column))
    is_enumeration = bool(column) and isinstance(column[0], StrEnum)
    return list(map(str, column)) if is_enumeration else column  # plain text is written in a fraction of the time


def table_of(content: Configuration, all_of: Callable[[Any, Sequence[Any]], Any] = columns_of) -> dict[str, Any]:
    """Returns the keys of ``content`` with their values; ``all_of``: makes the table of buses, branches, generators or
    meters.
    """
    area, network = content.area, content.area.network
    slack = {"bus": area.slack_bus} | ({} if area.slack_vm is None else {"vm": area.slack_vm})
    return {
        **({"split": dataclasses.asdict(content.split)} if content.split else {}),
        "area": area.name,
        **_plain_values(content),
        "admm": {"penalty": content.penalty},
        "quality": dataclasses.asdict(content.limits),
        **({"telemetry": _readings_table(content.readings)} if content.readings != DEFAULT_RULES else {}),
        "local_slack": slack,
        "exchange": {
            **({"towards_hub": area.towards_hub} if area.towards_hub else {}),
            "areas": area.n_areas,
            "entry_vm": area.entry_voltage[0],
            "entry_va": area.entry_voltage[1],
            **({"no_load": _list_no_load(area)} if area.no_load else {}),
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
            **({"load": all_of(Load, network.loads)} if network.loads else {}),
            **({"shunt": all_of(Shunt, network.shunts)} if network.shunts else {}),
            **({"gauge": _row_of(network.gauge_of_whole)} if network.gauge_of_whole else {}),
        },
        "meter": all_of(Meter, content.meters),
    }


def plain_keys() -> list[tuple[str, Any]]:
    """Returns name and default of each field that is a key of an area file by itself."""
    return [(key, default) for key, default in keys_of(Configuration) if key not in OF_TABLES]


def _plain_values(content: Configuration) -> dict[str, Any]:
    """Returns the keys of ``plain_keys`` with their values, without those that have an empty default."""
    values = ((key, getattr(content, key), default) for key, default in plain_keys())
    return {
        key: list(value) if isinstance(value, tuple) else value for key, value, default in values if value or default
    }


def _readings_table(rules: ReadingRules) -> dict[str, Any]:
    gateways = {name: meters if meters == "all" else list(meters) for name, meters in rules.gateways.items()}
    kinds = [{"kind": str(kind), **_row_of(rule)} for kind, rule in rules.kinds.items()]
    return {"ticks": rules.ticks, "leader": rules.leader, "gateways": gateways, "kind": kinds}


def rows_of(_: Any, items: Sequence[Any]) -> list[dict[str, Any]]:
    return [_row_of(item) for item in items]


def _row_of(item: Any) -> dict[str, Any]:
    """Returns a dataclass as a table, without values that equal their default."""
    values = ((key, getattr(item, key), default) for key, default in _known_keys_of(item.__class__))
    stated = [(key, value) for key, value, default in values if default is dataclasses.MISSING or value != default]
    return {key: write(value) if (write := _WRITE.get(type(value))) else value for key, value in stated}


def keys_of(cls: Any) -> list[tuple[str, Any]]:
    """Returns name and default of every field that a dataclass is made of."""
    return [(field.name, field.default) for field in dataclasses.fields(cls) if field.init]


_known_keys_of = functools.cache(keys_of)


def _split_complex(value: Any) -> list[Any]:
    """Returns the real parts, then the imaginary parts, of a complex number or matrix."""
    parts = np.asarray(value)
    return [parts.real.tolist(), parts.imag.tolist()]


_WRITE: dict[type, Callable[[Any], Any]] = {complex: _split_complex, np.ndarray: _split_complex, Primitive: _row_of}
"""Type of a value that files hold in parts -> these parts."""


def _list_no_load(area: Area) -> list[list[Any]]:
    """Returns the rows of ``Area.no_load``; of a network with phases each names its node."""
    is_balanced = area.network.table.nodes.is_balanced
    places = [bus for bus, _, _ in area.no_load] if is_balanced else area.network.node_names
    return [[place, vm, va] for place, (_, vm, va) in zip(places, area.no_load, strict=True)]


def _neighbour_row(neighbour: Neighbour, faults: LinkFaults) -> dict[str, Any]:
    return _row_of(neighbour) | ({"faults": _row_of(faults)} if faults != LinkFaults() else {})
