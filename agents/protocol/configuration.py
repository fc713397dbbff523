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
from typing import Any

import numpy as np

from agents.protocol.configuration_digest import digest_configuration
from dsse_core.estimation.state_limits import DEFAULT_LIMITS, StateLimits
from dsse_core.grid.columns import Records
from dsse_core.grid.measurement import Meter
from dsse_core.grid.meter_table import list_columns
from dsse_core.grid.network import Branch, Bus, Generator
from dsse_core.grid.partition import Area, Neighbour
from dsse_core.link_faults import LinkFaults
from dsse_core.reading_rules import DEFAULT_RULES, ReadingRules
from dsse_core.split_identity import NO_SPLIT, SplitIdentity


@dataclass(frozen=True, slots=True)
class SplitStamp:
    """Stamp that a split writes into each of its files. Stamps of one content are equal, whenever they were made.

    ``digest``: of the split, 16 hex digits. ``content``: of this file. ``time``: of the split, s since 1970 UTC.
    """

    digest: str
    content: str
    time: float = field(compare=False)


@dataclass(frozen=True)
class Configuration:
    """One area as its agent knows it.

    Args:
        run: name of the system that the area belongs to; a part of every key.
        meters: the area's meters, virtual ones included; readings come by telemetry.
        strategy: name of the boundary-exchange strategy.
        endpoints: Zenoh endpoints to connect to, e.g. ``tcp/127.0.0.1:7447``: routers of which one is enough, or,
            of an area that listens itself, neighbours.
        listen: where neighbours, plant and watchers link with this area directly; empty if they meet at a router.
        beat_s: interval at which the last messages are repeated, s.
        scan_s: time between two scans, s; None where it is not known.
        tolerance: the local estimate stops at max |dx| below it, p.u. and rad.
        generation: load messages count the "telemetered" injection of substation and generators, or the
            "scheduled" one.
        load_error: added to the load at each boundary bus (eqs. 5.4, 5.5), p.u.
        links: neighbour -> injected faults of the link to it; the link to any other neighbour is sound.
        seed: of the injected faults.
        penalty: of strategy ``admm``.
        limits: of a reliable estimate.
        readings: the gateway or clock that numbers scans, the gateways of the meters, and the ages of readings.
        clock_error_s: injected fault: lead of the area's clock, s.
        split: stamp of the split of the configuration (``configuration_digest.py``); None in files of versions
            without splits.
    """

    run: str
    area: Area
    meters: Sequence[Meter]
    strategy: str
    endpoints: tuple[str, ...]
    listen: tuple[str, ...] = ()
    beat_s: float = 0.2
    scan_s: float | None = None
    tolerance: float = 1e-6
    generation: str = "telemetered"
    load_error: complex = 0j
    links: dict[str, LinkFaults] = field(default_factory=dict)
    seed: int = 0
    penalty: float = 1.0
    limits: StateLimits = DEFAULT_LIMITS
    readings: ReadingRules = DEFAULT_RULES
    clock_error_s: float = 0.0
    split: SplitStamp | None = field(default=None, compare=False)

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
    if isinstance(items, Records):
        given: Sequence[Any] | np.ndarray = items.columns.get(key, ())
        return given.tolist() if isinstance(given, np.ndarray) else given
    column = list(map(attrgetter(key), items))
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
    """Returns a dataclass as a table, without values that equal their default."""
    values = ((key, getattr(item, key), default) for key, default in _known_keys_of(item.__class__))
    return {key: value for key, value, default in values if default is dataclasses.MISSING or value != default}


def keys_of(cls: Any) -> list[tuple[str, Any]]:
    """Returns name and default of every field that a dataclass is made of."""
    return [(f.name, f.default) for f in dataclasses.fields(cls) if f.init]


_known_keys_of = functools.cache(keys_of)


def _neighbour_row(neighbour: Neighbour, faults: LinkFaults) -> dict[str, Any]:
    return _row_of(neighbour) | ({"faults": _row_of(faults)} if faults != LinkFaults() else {})
