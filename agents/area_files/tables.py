"""The keys of an area file, as strict tables. In JSON, buses, branches, generators and meters are lists of values."""

from __future__ import annotations

import dataclasses
import functools
import typing
from enum import StrEnum
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, create_model, model_validator

from agents.protocol.configuration import keys_of
from dsse_core.estimation.state_limits import DEFAULT_LIMITS
from dsse_core.files.kinds import AREA_FILE, FileKind
from dsse_core.files.quantities import (
    BranchId,
    ClockError,
    HeartbeatSeconds,
    Moment,
    Name,
    NotNegative,
    Positive,
    Probability,
    ScanSeconds,
    Seconds,
    Seed,
    Version,
)
from dsse_core.files.shared_tables import AdmmTable, GenerationTable, require_a_band
from dsse_core.files.strict_table import ColumnsTable, FileTable, Table
from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.grid.network import Branch, Bus, Generator
from dsse_core.grid.partition import Neighbour
from dsse_core.link_faults import LinkFaults
from dsse_core.reading_rules import ANYBODY, LEADER, Ticks
from dsse_core.split_identity import DIGITS, END_OF_TIME

PROBABILITIES = ("loss", "burst_enter", "burst_leave", "burst_loss", "duplicate", "corrupt")
Digest = Annotated[str, Field(pattern=rf"^[0-9a-f]{{{DIGITS}}}$")]
NoLoad = Annotated[tuple[int, Positive, float], Field(strict=False)]
Names = Annotated[tuple[str, ...], Field(strict=False)]  # in a file a list
Window = Annotated[tuple[NotNegative, NotNegative], Field(strict=False)]  # in a file a list


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
    areas: int = Field(ge=1, description="how many areas the grid has")
    entry_vm: Positive = Field(description="voltage in p.u. where the area begins, seen from the substation")
    entry_va: float = Field(description="angle there in rad")
    no_load: Annotated[tuple[NoLoad, ...], Field(strict=False)] = Field(
        default=(),
        description="[bus, vm, va] of boundary buses in the unloaded grid, if taps do not cancel around loops",
    )


class LoadMessagesTable(GenerationTable):
    """``[load_messages]``."""

    p_error: float = 0.0
    q_error: float = 0.0


class QualityTable(Table):
    """``[quality]``."""

    lowest_vm: NotNegative = DEFAULT_LIMITS.lowest_vm
    highest_vm: Positive = DEFAULT_LIMITS.highest_vm
    most_removed: Probability = DEFAULT_LIMITS.most_removed
    most_overdue: Probability = DEFAULT_LIMITS.most_overdue

    @model_validator(mode="after")
    def _is_a_band(self) -> Self:
        return require_a_band(self, "lowest_vm", "highest_vm")


class KindRuleTable(Table):
    """One ``[[telemetry.kind]]``, in s, p.u. and rad."""

    kind: Annotated[MeasurementKind, Field(strict=False, description="kind of meter, e.g. p_flow")]
    period_s: Seconds | None = None
    aging_s: Seconds | None = None
    oldest_s: Seconds | None = None
    lowest: float | None = None
    highest: float | None = None


class SplitTable(Table):
    """``[split]``, as ``dsse split`` writes it."""

    digest: Digest = Field(description="digest of the split, the same in all of its area files")
    content: Digest = Field(description="digest of this file as the split has written it")
    time: Annotated[float, Field(ge=0, lt=END_OF_TIME)] = Field(description="time of the split, s since 1970 UTC")


def _all_of_the_leader() -> dict[Any, list[str] | Literal["all"]]:
    return {LEADER: "all"}


class TelemetryTable(Table):
    """``[telemetry]``."""

    ticks: Ticks = "gateway"
    leader: Name = LEADER
    gateways: dict[Name | Literal["*"], list[str] | Literal["all"]] = Field(
        default_factory=_all_of_the_leader, description=f"gateway, or {ANYBODY!r} for each, and its meters"
    )
    kind: list[KindRuleTable] = Field(default_factory=list)


class AreaTable(FileTable):
    """An area file without its network and meters."""

    kind: ClassVar[FileKind] = AREA_FILE

    format: Version = Field(description="version of this format, 1")
    split: SplitTable | None = None
    """Identity of the split: `digest`, `content` (digest of this file) and `time`; none in older files."""
    run: Name = Field(description="name of the system that the area belongs to")
    area: Name = Field(description="name of the area")
    strategy: str = Field(description="how the areas exchange what they know")
    """Strategy of the exchange."""
    endpoints: list[str] = Field(description="where to find the bus, e.g. tcp/127.0.0.1:7447")
    """Where to find the bus: routers, or neighbours with direct links. May be edited."""
    listen: list[str] = Field(default_factory=list)
    """Where the agent listens, with direct links. May be edited."""
    beat_s: HeartbeatSeconds = 0.2
    """`run.beat_s` of the scenario. May be edited."""
    scan_s: ScanSeconds | None = None
    """`run.scan_s` of the scenario."""
    tolerance: Positive = 1e-6
    """Largest last step of the estimator."""
    seed: Seed = 0
    """Seed of injected faults."""
    clock_error_s: ClockError = 0.0
    """Injected error of the clock."""
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


@functools.cache
def area_table(*, of_columns: bool) -> Any:
    """The schema of a whole area file; ``of_columns``: of buses, branches, generators, meters a list for each key."""
    all_of = _columns_of if of_columns else _rows_of
    faults = _table_of(
        LinkFaults,
        **dict.fromkeys(PROBABILITIES, Probability),
        delay_s=Moment,
        jitter_s=Moment,
        lie_scale=Positive,
        cuts=Annotated[tuple[Window, ...], Field(strict=False)],
    )
    neighbour = create_model(
        "Neighbour", __base__=_table_of(Neighbour, area=Name, variables=Names), faults=(faults, faults())
    )
    network = create_model(
        "NetworkTable",
        __base__=Table,
        base_mva=(Positive, ...),
        bus=(all_of(Bus), ...),
        branch=(all_of(Branch), ...),
        generator=(all_of(Generator), []),
    )
    return create_model(
        "AreaFileTable",
        __base__=AreaTable,
        neighbour=(list[neighbour], []),  # type: ignore[valid-type]
        network=(network, Field(description="the area's own part of the network, in p.u. on base_mva")),
        meter=(all_of(Meter), Field(description="the area's meters")),
    )


def _table_of(cls: type[Any], **types: Any) -> Any:
    """A table whose keys are the fields of dataclass ``cls``; ``types`` replace the types of the fields they name."""
    hints = _types_of(cls) | types
    keys: Any = {key: (hints[key], ... if default is dataclasses.MISSING else default) for key, default in keys_of(cls)}
    return create_model(cls.__name__, __base__=Table, **keys)


def _rows_of(cls: type[Any]) -> Any:
    return list[_table_of(cls)]  # type: ignore[misc]


def _columns_of(cls: type[Any]) -> Any:
    hints: Any = _types_of(cls)
    keys: Any = {}
    for key, default in keys_of(cls):
        column: Any = list[hints[key]]
        keys[key] = (column, ...) if default is dataclasses.MISSING else (column | None, None)
    return create_model(cls.__name__, __base__=ColumnsTable, **keys)


def _types_of(cls: type[Any]) -> Any:
    """Field -> its type in files. An enumeration is not strict, so that files may give its words."""
    hints: dict[str, Any] = typing.get_type_hints(cls)
    if cls is Branch:
        hints["id"] = BranchId
    for key, hint in hints.items():
        if isinstance(hint, type) and issubclass(hint, StrEnum):
            hints[key] = Annotated[hint, Field(strict=False)]
    return hints


area_table(of_columns=True)  # once, before agents are forked
