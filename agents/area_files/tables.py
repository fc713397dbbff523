"""The schema of an area file, made from the dataclasses that an agent works with.

A field of ``Configuration`` that is a key by itself, of the stamp of a split, of the limits, of the rule of a kind of
meter, of the faults of a link and of a bus, branch, generator, meter or neighbour is a key of the file: with its name,
its type and range, its default and its meaning in errors. The tables written out here have other keys than the
dataclasses behind them. In JSON, buses, branches, generators, loads and meters are lists of values.
"""

from __future__ import annotations

import dataclasses
import functools
import typing
from collections.abc import Sequence
from enum import StrEnum
from types import UnionType
from typing import Annotated, Any, ClassVar, Literal, Self, Union

import numpy as np
from pydantic import AfterValidator, Field, create_model, model_validator

from agents.protocol.configuration import Configuration, SplitStamp, keys_of, plain_keys
from dsse_core.estimation.state_limits import StateLimits
from dsse_core.files.kinds import AREA_FILE, FileKind
from dsse_core.files.quantities import BranchId, Name, Version
from dsse_core.files.shared_tables import AdmmTable, GenerationTable, require_a_band
from dsse_core.files.strict_table import ColumnsTable, FileTable, Table
from dsse_core.grid.gauge import Gauge
from dsse_core.grid.loads import Load, Shunt
from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.grid.network import Branch, Bus, Generator
from dsse_core.grid.nodes import Primitive
from dsse_core.grid.partition import Neighbour
from dsse_core.limits import Positive
from dsse_core.link_faults import LinkFaults
from dsse_core.reading_rules import ANYBODY, LEADER, KindRule, Ticks

NoLoad = Annotated[tuple[int | str, Positive, float], Field(strict=False)]


def _join_number(parts: tuple[float, float]) -> complex:
    return complex(*parts)


def _join_matrix(parts: tuple[list[list[float]], list[list[float]]]) -> np.ndarray:
    """The complex matrix of its real parts and its imaginary parts, to the bit.

    Raises:
        ValueError: ``parts`` are no square matrices of one size.
    """
    if len({n for rows in parts for n in (len(rows), *map(len, rows))}) > 1:
        raise ValueError("must be two square matrices of one size, of the real and of the imaginary parts")
    joined: np.ndarray = np.array(parts, dtype=float).transpose(1, 2, 0).copy().view(complex)[:, :, 0]
    return joined


IN_PARTS: dict[Any, Any] = {
    complex: Annotated[tuple[float, float], Field(strict=False), AfterValidator(_join_number)],
    np.ndarray: Annotated[
        tuple[list[list[float]], list[list[float]]], Field(strict=False), AfterValidator(_join_matrix)
    ],
}
"""Type of a value that files hold in parts -> the type of these parts."""


def _keys_of(cls: type[Any], keys: Sequence[tuple[str, Any]], **types: Any) -> Any:
    """Key -> its type in files and its default, of ``keys``, fields of dataclass ``cls``; ``types`` replace theirs."""
    hints = _types_of(cls) | types
    return {key: (hints[key], ... if default is dataclasses.MISSING else default) for key, default in keys}


def _table_of(cls: type[Any], base: type[Table] = Table, **types: Any) -> Any:
    """A table whose keys are the fields of dataclass ``cls``; ``types`` replace the types of the fields they name."""
    return create_model(cls.__name__, __base__=base, **_keys_of(cls, keys_of(cls), **types))


def _types_of(cls: type[Any]) -> Any:
    """Field -> its type in files."""
    hints = {key: _in_files(hint) for key, hint in typing.get_type_hints(cls, include_extras=True).items()}
    return hints | {"id": BranchId} if cls is Branch else hints


def _in_files(hint: Any) -> Any:
    """A type whose tuples may be lists in a file, members of enumerations words, and other values parts."""
    if isinstance(hint, type) and hint in IN_PARTS:
        return IN_PARTS[hint]
    parts = typing.get_args(hint)
    if typing.get_origin(hint) in (Union, UnionType):
        return Union[tuple(map(_in_files, parts))]  # noqa: UP007
    if hasattr(hint, "__metadata__"):
        return Annotated[(_in_files(hint.__origin__), *hint.__metadata__)]
    if typing.get_origin(hint) is tuple:
        items = tuple(part if part is Ellipsis else _in_files(part) for part in parts)
        return Annotated[tuple[items], Field(strict=False)]  # type: ignore[valid-type]
    if isinstance(hint, type) and issubclass(hint, StrEnum):
        return Annotated[hint, Field(strict=False)]
    return hint


def _join_primitive(table: Any) -> Primitive:
    return Primitive(**vars(table))


IN_PARTS[Primitive] = Annotated[_table_of(Primitive), AfterValidator(_join_primitive)]


class SlackTable(Table):
    """``[local_slack]``."""

    bus: int = Field(description="where the local power flow holds the voltage")
    vm: Positive | None = None


class ReferenceTable(Table):
    """``[reference]``."""

    bus: int = Field(description="number of the substation's bus")
    va: float = 0.0


class ExchangeTable(Table):
    """``[exchange]``."""

    towards_hub: str | None = None
    areas: int = Field(ge=1, description="number of areas of the grid")
    entry_vm: Positive = Field(description="voltage in p.u. where the area begins, seen from the substation")
    entry_va: float = Field(description="angle there in rad")
    no_load: Annotated[tuple[NoLoad, ...], Field(strict=False)] = Field(
        default=(),
        description="[bus, vm, va] of boundary buses in the unloaded grid, if taps do not cancel around loops; where "
        "buses have phases ['671.a', vm, va] of each node",
    )


class LoadMessagesTable(GenerationTable):
    """``[load_messages]``."""

    p_error: float = 0.0
    q_error: float = 0.0


class BandTable(Table):
    """A table whose ``lowest_vm`` is below its ``highest_vm``."""

    @model_validator(mode="after")
    def _is_a_band(self) -> Self:
        return require_a_band(self, "lowest_vm", "highest_vm")


class KindTable(Table):
    """The kind of one ``[[telemetry.kind]]``, to which the fields of ``KindRule`` are added, in s, p.u. and rad."""

    kind: Annotated[MeasurementKind, Field(strict=False, description="kind of meter, e.g. p_flow")]


def _all_of_the_leader() -> dict[Any, list[str] | Literal["all"]]:
    return {LEADER: "all"}


SplitTable: Any = _table_of(SplitStamp)
QualityTable: Any = _table_of(StateLimits, BandTable)
KindRuleTable: Any = _table_of(KindRule, KindTable)


class TelemetryTable(Table):
    """``[telemetry]``."""

    ticks: Ticks = "gateway"
    leader: Name = LEADER
    gateways: dict[Name | Literal["*"], list[str] | Literal["all"]] = Field(
        default_factory=_all_of_the_leader, description=f"gateway, or {ANYBODY!r} for each, and its meters"
    )
    kind: list[KindRuleTable] = Field(default_factory=list)


class AreaTable(FileTable):
    """The tables of an area file without its network and meters."""

    kind: ClassVar[FileKind] = AREA_FILE

    format: Version = Field(description="version of this format, 1")
    split: SplitTable | None = None
    """Identity of the split: `digest`, `content` (digest of this file) and `time`; none in older files."""
    area: Name = Field(description="name of the area")
    telemetry: TelemetryTable = TelemetryTable()
    """Source of scan numbers, gateways and their meters, intervals and ranges of each kind of meter."""
    local_slack: SlackTable = Field(description="where the local power flow begins")
    """Bus and voltage where the local power flow begins."""
    reference: ReferenceTable | None = None
    """Bus and angle of the substation, in its area."""
    exchange: ExchangeTable = Field(description="the way to the hub, the number of areas, where the area begins")
    """The neighbour towards the hub, the number of areas, the voltage where the area begins."""
    load_messages: LoadMessagesTable = LoadMessagesTable()
    """As in a scenario, with the injected error of the boundary load."""
    admm: AdmmTable = AdmmTable()
    """As in a scenario."""
    quality: QualityTable = QualityTable()
    """As in a scenario, in p.u."""


PlainKeys = create_model("PlainKeys", __base__=AreaTable, **_keys_of(Configuration, plain_keys()))
"""With the keys that are fields of ``Configuration``."""


@functools.cache
def area_table(*, of_columns: bool) -> Any:
    """The schema of a whole area file; ``of_columns``: of buses, branches, generators, meters a list for each key."""
    all_of = _columns_of if of_columns else _rows_of
    faults = _table_of(LinkFaults)
    neighbour = create_model("Neighbour", __base__=_table_of(Neighbour, area=Name), faults=(faults, faults()))
    network = create_model(
        "NetworkTable",
        __base__=Table,
        base_mva=(Positive, ...),
        bus=(all_of(Bus), ...),
        branch=(all_of(Branch), ...),
        generator=(all_of(Generator), []),
        load=(all_of(Load), []),
        shunt=(all_of(Shunt), []),
        gauge=(_table_of(Gauge) | None, None),
    )
    return create_model(
        "AreaFileTable",
        __base__=PlainKeys,
        neighbour=(list[neighbour], []),  # type: ignore[valid-type]
        network=(network, Field(description="the area's own part of the network, in p.u. on base_mva")),
        meter=(all_of(Meter), Field(description="the area's meters")),
    )


def _rows_of(cls: type[Any]) -> Any:
    return list[_table_of(cls)]  # type: ignore[misc]


def _columns_of(cls: type[Any]) -> Any:
    hints: Any = _types_of(cls)
    keys: Any = {}
    for key, default in keys_of(cls):
        column: Any = list[hints[key]]
        keys[key] = (column, ...) if default is dataclasses.MISSING else (column | None, None)
    return create_model(cls.__name__, __base__=ColumnsTable, **keys)


area_table(of_columns=True)  # once, before agents are forked
