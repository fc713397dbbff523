"""The keys of a scenario file, as strict tables. docs/reference/scenario-files.md explains each of them."""

from __future__ import annotations

import re
from typing import Annotated, ClassVar, Literal, Self

from pydantic import BeforeValidator, Discriminator, Field, PlainValidator, Tag, field_validator, model_validator

from dsse_core.endpoints import find_endpoint_problem
from dsse_core.estimation.state_limits import (
    DEFAULT_LIMITS,
    DEFAULT_OPERATING_LIMITS,
    OperatingLimits,
    StateLimits,
)
from dsse_core.files.kinds import SCENARIO_FILE, FileKind
from dsse_core.files.quantities import Name, Version
from dsse_core.files.shared_tables import AdmmTable, GenerationTable, require_a_band
from dsse_core.files.strict_table import FileTable, Table
from dsse_core.limits import (
    LONGEST_NAME,
    GrossError,
    HeartbeatSeconds,
    NotNegative,
    Positive,
    Probability,
    ScanSeconds,
    Seconds,
    Seed,
    Sigma,
)
from dsse_core.reading_rules import LEADER, Ticks
from scenarios.files.fault_tables import FaultsTable

SIGMA_PERCENT = "standard deviation in percent of the true value"
SIGMA_PU = "standard deviation in p.u."


BusPlace = int | str
"""A bus, such as 671, each of its phases; or some of them, such as "671.c"."""
_BUS_WITH_PHASES = re.compile(r"\d{1,18}\.\w+")


def _parse_buses(value: object) -> tuple[BusPlace, ...] | None:
    if isinstance(value, list) and value and all(map(_is_bus, value)):
        return tuple(value)
    if value == "all":
        return None
    example = _example_of_phases(value)
    raise ValueError(f'must be "all" or a list of bus numbers that is not empty{example}, found {value!r}')


def _is_bus(item: object) -> bool:
    return type(item) is int or (isinstance(item, str) and _BUS_WITH_PHASES.fullmatch(item) is not None)


def _example_of_phases(value: object) -> str:
    """A bus with phases as an example where ``value`` is a list with texts."""
    has_texts = isinstance(value, list) and any(isinstance(item, str) for item in value)
    return ', with phases such as "611.c"' if has_texts else ""


def _parse_branches(value: object) -> tuple[str, ...] | None:
    if isinstance(value, list) and value and all(type(item) is str for item in value):
        return tuple(value)
    if value == "all":
        return None
    raise ValueError(f"must be \"all\" or a list of branch ids such as '3-4' that is not empty, found {value!r}")


def _parse_areas(value: object) -> tuple[str, ...] | None:
    if isinstance(value, list) and value and all(type(item) is str for item in value):
        return tuple(value)
    if value == "all":
        return None
    raise ValueError(f'must be "all" or a list of areas that is not empty, found {value!r}')


BusSelection = Annotated[tuple[BusPlace, ...] | None, PlainValidator(_parse_buses)]
"""The listed buses; None means all."""


def _parse_zero_injection(value: object) -> Literal["virtual", "measured"] | tuple[BusPlace, ...]:
    if isinstance(value, list) and all(map(_is_bus, value)):
        return tuple(value)
    if value in ("virtual", "measured"):
        return "virtual" if value == "virtual" else "measured"
    example = _example_of_phases(value)
    raise ValueError(f'must be "virtual", "measured" or a list of bus numbers{example}, found {value!r}')


ZeroInjection = Annotated[Literal["virtual", "measured"] | tuple[BusPlace, ...], PlainValidator(_parse_zero_injection)]
"""The buses that inject exactly nothing: all without load and source, none, or those listed."""
AreaSelection = Annotated[tuple[str, ...] | None, PlainValidator(_parse_areas)]
"""The listed areas; None means all."""
BranchSelection = Annotated[tuple[str, ...] | None, PlainValidator(_parse_branches)]
"""The listed branches; None means all that are in service."""


class AreaTable(Table):
    """``[areas.NAME]``."""

    buses: list[int] = Field(min_length=1, description="numbers of the area's buses, shared boundary buses included")
    """The area's buses, shared boundary buses included."""
    slack_bus: int | None = None
    """Bus where the local power flow holds the voltage. Without it: the substation, else the first
    voltage-holding source of the area, else the boundary bus towards the substation, with the voltage that the
    neighbour publishes.
    """
    slack_vm_pu: Positive | None = None
    """Voltage held there, p.u.; goes together with `slack_bus`."""
    holds: list[str] = Field(default_factory=list)
    """Ids of branches, open ones too, that the area holds although it lists one of their buses only."""

    @model_validator(mode="after")
    def _slack_is_complete(self) -> Self:
        if (self.slack_bus is None) != (self.slack_vm_pu is None):
            raise ValueError("slack_bus and slack_vm_pu belong together; give both or none")
        return self


class CountTable(Table):
    """``areas = { count = N }``."""

    count: int = Field(ge=1, description="how many areas, cut so that their sizes are balanced")
    """Number of areas; at most as many as there are branches in no loop and groups of loops that share branches."""
    ties: list[str] = Field(default_factory=list)
    """Ids of branches that count as open where areas are cut. The owner of its from bus holds a tie, open or closed."""


class SwitchesTable(Table):
    """``areas = { switches = [...] }``."""

    switches: list[str] = Field(min_length=1, description="ids of the branches to cut at, none of them in a loop")
    """Ids of the branches to cut at, in service and in no loop."""


def _kind_of_areas(value: object) -> str:
    """The member of ``Areas`` that ``value`` is meant to be, as its tag."""
    if isinstance(value, dict):
        if not isinstance(value.get("switches", {}), dict):
            return "[switches]"
        if any(not isinstance(item, dict) for item in value.values()):
            return "[count]"
    return "[lists]"


def _reject_both(value: object) -> object:
    """Rejects lists of buses beside a count or switches; returns ``value``."""
    if isinstance(value, dict):
        lists = [name for name, item in value.items() if isinstance(item, dict)]
        how = [name for name in ("count", "switches") if name in value.keys() - lists]
        if lists and how:
            found = f"{how[0]} and the areas {', '.join(lists)}"
            raise ValueError(f"give {how[0]} or the buses of each area, found {found}")
    return value


Areas = Annotated[
    Annotated[dict[Name, AreaTable], Tag("[lists]")]
    | Annotated[CountTable, Tag("[count]")]
    | Annotated[SwitchesTable, Tag("[switches]")],
    Discriminator(_kind_of_areas),
    BeforeValidator(_reject_both),
]


class IntervalTable(Table):
    """Interval of meters, and how their readings age."""

    period_s: Seconds | None = Field(default=None, description="interval of these meters, s")
    """Interval of these meters."""
    aging_s: Seconds | None = None
    """Age at which the variance of a reading has doubled; `period_s` if left out."""
    oldest_s: Seconds | None = None
    """Age beyond which a reading is left out; five times the longer of `period_s` and `run.scan_s` if left out."""

    @model_validator(mode="after")
    def _ages_by_its_period(self) -> Self:
        if self.aging_s is not None and self.period_s is None:
            raise ValueError("readings without period_s do not age; add period_s, or remove aging_s")
        return self


class SigmaTable(IntervalTable):
    """Meters whose sigma is given in percent or in p.u."""

    lowest_pu: float | None = None
    """A reading below is out of range."""
    highest_pu: float | None = None
    """A reading above is out of range."""
    sigma_percent: Sigma | None = Field(default=None, description=SIGMA_PERCENT)
    """Standard deviation in percent of the true value."""
    sigma_pu: Sigma | None = Field(default=None, description=SIGMA_PU)
    """Standard deviation in p.u.; `floor_kva` does not apply."""

    @model_validator(mode="after")
    def _has_exactly_one_sigma(self) -> Self:
        if (self.sigma_percent is None) == (self.sigma_pu is None):
            found = "neither" if self.sigma_pu is None else "both"
            raise ValueError(f"give exactly one of sigma_percent ({SIGMA_PERCENT}) and sigma_pu, found {found}")
        return self

    @model_validator(mode="after")
    def _has_a_range(self) -> Self:
        return self if None in (self.lowest_pu, self.highest_pu) else require_a_band(self, "lowest_pu", "highest_pu")


class BusMeterTable(SigmaTable):
    """``measurements.voltage`` and ``measurements.injection``."""

    buses: BusSelection = Field(description='where the meters stand: "all" or a list of bus numbers')
    """Buses of the meters. With phases `671` is each of the bus, `"671.c"` one to ground, `"671.ab"` between two,
    `"671.total"` the power of all. In parts without ground voltages are between phases.
    """


class BranchMeterTable(SigmaTable):
    """``measurements.flow`` and ``measurements.current``."""

    branches: BranchSelection = Field(description='where the meters stand: "all" or a list of branch ids')
    """Branches of the meters: all in service, or ids such as `"3-4"`; with phases as for buses: `"3-4.b"`,
    `"3-4.total"`.
    """


class AngleMeterTable(IntervalTable):
    """``measurements.angle``."""

    buses: BusSelection = Field(description='where the meters stand: "all" or a list of bus numbers')
    """Buses of meters of angle."""
    sigma_deg: Sigma = Field(description="standard deviation in degrees")
    """Standard deviation of angles."""
    lowest_deg: float | None = None
    """An angle below is out of range."""
    highest_deg: float | None = None
    """An angle above is out of range."""

    @model_validator(mode="after")
    def _has_a_range(self) -> Self:
        return (
            self if None in (self.lowest_deg, self.highest_deg) else require_a_band(self, "lowest_deg", "highest_deg")
        )


class MeasurementsTable(Table):
    """``[measurements]``."""

    floor_kva: Positive = Field(
        default=1.0, description="smallest standard deviation that a sigma_percent can mean, in kVA"
    )
    """Smallest standard deviation of powers that a `sigma_percent` can mean, 1e-9 to 1e6 p.u., of each phase; for
    currents, that power at 1 p.u. voltage.
    """
    zero_injection: ZeroInjection = "virtual"
    """Buses without load and source, with phases nodes. `"virtual"`: they inject exactly nothing, a constraint for
    every estimator, and have no injection meter. `"measured"`: buses like any other. A list: those listed are
    virtual. Where all loads stand between phases the sum of the bus' currents is virtual, and a load that a
    meter can tell from others is metered itself.
    """
    voltage: BusMeterTable | None = None
    """Meters of voltage magnitude."""
    angle: AngleMeterTable | None = None
    """Meters of voltage angle; under `area-power-flow` to the area's own local slack."""
    flow: BranchMeterTable | None = None
    """Meters of P and Q flow, at the from end of branches."""
    injection: BusMeterTable | None = None
    """Meters of P and Q injection (production minus load). Under `area-power-flow` boundary buses have none: an
    area's power flow knows only its net load there.
    """
    current: BranchMeterTable | None = None
    """Meters of current magnitude, at the from end of branches; they do not count for observability."""

    @property
    def kinds(self) -> tuple[str, ...]:
        """The tables of meters that are given."""
        return tuple(key for key in type(self).model_fields if isinstance(getattr(self, key), IntervalTable))


class GrossErrorTable(Table):
    """One ``[[telemetry.gross_error]]``."""

    meter: str = Field(description="id of the meter, e.g. p_flow@3:3-4")
    """Id of the meter: `vm@1`, `p_injection@4`, `q_flow@3:3-4`, `current@3:3-4`."""
    sigmas: GrossError = Field(description="added to the reading, in its standard deviations")
    """Added to the reading, in standard deviations of the meter; also without noise."""


class TelemetryTable(Table):
    """``[telemetry]``."""

    source: Literal["network", "area-power-flow", "file", "live"] = "network"
    """`"network"`: readings of one true grid. `"live"`: from gateways while the system runs, `"file"`: from a
    readings file; both without a truth, so no result has errors to it. `"area-power-flow"`, the thesis's mode:
    every area reads its own power flow, with the scheduled net load of the rest of the grid, plus
    `faults.load_error`, at its boundary buses; every local slack needs a known voltage.
    """
    ticks: Ticks | None = Field(default=None, description='source of scan numbers: "gateway" or "clock"')
    """`"gateway"`: the gateway that leads numbers scans; the default unless `source` is `"live"`. `"clock"`:
    the clock of each area does, at each multiple of `run.scan_s` in UTC, which must be given.
    """
    leader: Name = LEADER
    """The gateway that leads, with `ticks = "gateway"`."""
    file: str | None = Field(default=None, description="path of a readings file, relative to this file")
    """Readings file, relative to this file; goes together with source `"file"`."""
    noise: bool = True
    """Normally distributed errors of the meters' standard deviations are added, from `seed`, scan and meter
    alone. Not with source `"file"` or `"live"`.
    """
    gross_error: list[GrossErrorTable] = Field(default_factory=list)
    """`[[telemetry.gross_error]]`, wrong meters."""

    @model_validator(mode="after")
    def _has_a_file_exactly_when_it_is_the_source(self) -> Self:
        if self.source == "file" and self.file is None:
            raise ValueError("source 'file' needs the path of the readings; give file = \"readings.csv\"")
        if self.source != "file" and self.file is not None:
            raise ValueError(f"file has no meaning for source {self.source!r}; remove it or set source = 'file'")
        if self.source == "file" and "noise" in self.model_fields_set:
            raise ValueError("noise has no meaning for source 'file', whose readings are real; remove it")
        if self.source == "live" and ("noise" in self.model_fields_set or self.gross_error):
            raise ValueError(
                "noise and gross_error have no meaning for source 'live', whose readings are real; remove them"
            )
        return self

    @property
    def numbered_by(self) -> Ticks:
        """``ticks``, or its default: ``clock`` with source ``live``, else ``gateway``."""
        return self.ticks or ("clock" if self.source == "live" else "gateway")


class GatewayTable(Table):
    """``[gateways.NAME]``."""

    areas: AreaSelection = Field(description='for which areas it reads meters: "all" or a list of areas')
    """Areas in which it reads meters."""
    meters: list[str] | None = Field(default=None, min_length=1, description="ids of its meters, or shell patterns")
    """Ids of its meters there, or patterns such as `"p_*@3:*"`; all if left out."""


class QualityTable(Table):
    """``[quality]``."""

    lowest_vm_pu: NotNegative = DEFAULT_LIMITS.lowest_vm
    """Lower end of the band of voltage magnitudes; below it a state is `degraded`."""
    highest_vm_pu: Positive = DEFAULT_LIMITS.highest_vm
    """Upper end; more than `lowest_vm_pu`."""
    most_removed: Probability = DEFAULT_LIMITS.most_removed
    """Share of an area's meters, virtual ones not counted, that may be removed as bad data."""
    most_overdue: Probability = DEFAULT_LIMITS.most_overdue
    """Share of an area's meters with an interval whose readings may be missing or overdue."""
    operating_lowest_vm_pu: NotNegative = DEFAULT_OPERATING_LIMITS.lowest_vm
    """Lowest voltage in operation; a bus below it is shown as a violation."""
    operating_highest_vm_pu: Positive = DEFAULT_OPERATING_LIMITS.highest_vm
    """Highest one; more than `operating_lowest_vm_pu`."""
    most_loading_percent: Positive = DEFAULT_OPERATING_LIMITS.most_loading_percent
    """Largest loading of a branch in operation."""
    most_residual: Positive = DEFAULT_OPERATING_LIMITS.most_residual
    """Normalised residual above which a meter in use is shown as a violation; bad data are looked for above 3."""
    most_unbalance_percent: Positive = DEFAULT_OPERATING_LIMITS.most_unbalance_percent
    """Largest unbalance, `V-` by `V+`, of a three-phase bus in operation."""

    @model_validator(mode="after")
    def _is_a_band(self) -> Self:
        require_a_band(self, "operating_lowest_vm_pu", "operating_highest_vm_pu")
        return require_a_band(self, "lowest_vm_pu", "highest_vm_pu")

    @property
    def of_estimate(self) -> StateLimits:
        """The limits that an area's estimate keeps."""
        return StateLimits(self.lowest_vm_pu, self.highest_vm_pu, self.most_removed, self.most_overdue)

    @property
    def of_operation(self) -> OperatingLimits:
        """The limits of the grid in operation."""
        band = self.operating_lowest_vm_pu, self.operating_highest_vm_pu
        return OperatingLimits(*band, self.most_loading_percent, self.most_residual, self.most_unbalance_percent)


class TolerancesTable(Table):
    """``[tolerances]``: limits of the agreement of areas and of an estimator's last step (rad and p.u.)."""

    consensus_va_rad: Positive = 1e-6
    """Largest difference of angles at a boundary bus that counts as agreement."""
    consensus_vm_pu: Positive = 1e-6
    """The same for magnitudes; not used under `angle-offset`."""
    estimator: Positive = 1e-6
    """Largest last step of an estimator (p.u. and rad), where its steps shrink at a constant rate."""


class RunTable(Table):
    """``[run]``.

    ``beat_s``: time between two heartbeats at rest; ``timeout_s``: limit of a run without consensus. ``scan_s``: time
    between two scans, None where there is one only.
    """

    beat_s: HeartbeatSeconds = 0.2
    """Time between two publications of the same state, and between two heartbeats at rest."""
    scan_s: ScanSeconds | None = None
    """Time between two scans of `dsse plant` (`--every` overrides it); an area waits a quarter of it for its
    readings. Without it there is one scan, and areas wait five `beat_s`. `dsse run` and `dsse simulate` judge
    one scan and use that deadline only.
    """
    timeout_s: Seconds = 30.0
    """Longest duration of a run without consensus; more than two `beat_s`. Compiling does not count."""

    @model_validator(mode="after")
    def _has_time_for_a_few_heartbeats(self) -> Self:
        if self.timeout_s <= 2 * self.beat_s:
            raise ValueError(f"timeout_s is {self.timeout_s}; it must exceed two heartbeats of {self.beat_s} s")
        return self


class TransportTable(Table):
    """``[transport]``: through ``routers`` (linked ones, if two), or on direct links between neighbouring areas.

    ``listen``: the endpoint of the first router or area.
    """

    kind: Literal["router", "neighbours"] = "router"
    """Through a router, or on direct links between neighbouring areas, with plant and watchers linked to every
    area.
    """
    routers: Annotated[int, Field(ge=1, le=2)] = 1
    """With two linked routers the loss of one is hardly felt. Only for kind `"router"`."""
    listen: str = Field(default="tcp/127.0.0.1:0", description="tcp/HOST:PORT; port 0 takes a free one")
    """`"tcp/HOST:PORT"` of the first router, or of the first area, the others on the ports that follow. Port 0
    takes free ports; `dsse plant` then needs `--connect` for each area.
    """

    @field_validator("listen")
    @classmethod
    def _is_endpoint(cls, listen: str) -> str:
        if problem := find_endpoint_problem(listen, listens=True):
            raise ValueError(problem)
        if not listen.startswith("tcp/"):
            raise ValueError(f"{listen!r}: a scenario says tcp/HOST:PORT; `dsse run --secure` makes tls of it")
        return listen

    @model_validator(mode="after")
    def _has_routers_only_if_it_uses_them(self) -> Self:
        if self.kind == "neighbours" and "routers" in self.model_fields_set:
            raise ValueError("routers has no meaning for kind 'neighbours', which has none; remove it")
        return self


class RecordTable(Table):
    """``[record]``: the run is recorded into ``recording`` in its run folder."""

    limit_gb: Positive | None = Field(default=None, description="size in GiB beyond which the oldest hours are removed")
    """Size in GiB beyond which the oldest hours are removed."""


class ScenarioFile(FileTable):
    """A whole scenario file."""

    kind: ClassVar[FileKind] = SCENARIO_FILE

    version: Version = Field(description="version of this format, 1")
    """Version of this format."""
    name: str | None = Field(
        default=None, min_length=1, max_length=LONGEST_NAME, description="name of the runs of the scenario"
    )
    """Name of runs, at most 64 letters; the file's name if left out. Systems that share a router or a
    network of keys need different names.
    """
    description: str = Field(min_length=1, description="purpose of the scenario, in one line")
    seed: Seed = Field(default=1, description="seed of noise and losses")
    """Seed of noise and losses: the same seed gives the same telemetry and the same losses."""
    network: str = Field(
        description="name of a shipped network, or path of a .toml or .json file relative to this file"
    )
    """A shipped network (`ieee33`, `industrial13`), or the path of a network file (`.toml`, `.json`, or with
    `/`) relative to this file.
    """
    strategy: str = "information"
    """Way to consensus: `"information"`, `"angle-offset"`, `"admm"`, or an [installed
    one](../tutorials/own-strategy.md).
    """
    areas: Areas = Field(
        description="one [areas.NAME] with its buses for each area, or { count = N }, or { switches = [...] }"
    )
    """`[areas.NAME]`, one for each area; or `{ count = N }`; or `{ switches = [...] }`."""
    measurements: MeasurementsTable = MeasurementsTable()
    """Meters and their accuracy."""
    telemetry: TelemetryTable = TelemetryTable()
    """Source of readings, and of scan numbers."""
    gateways: dict[Name, GatewayTable] = Field(default_factory=dict)
    """`[gateways.NAME]`: sources of readings in the field."""
    load_messages: GenerationTable = GenerationTable()
    """Content of load messages between areas."""
    admm: AdmmTable = AdmmTable()
    """Strategy `admm` only."""
    faults: FaultsTable = FaultsTable()
    """Injected faults."""
    quality: QualityTable = QualityTable()
    """Limits of a state that is `good`."""
    tolerances: TolerancesTable = TolerancesTable()
    """Limits of agreement, and of an estimator's last step."""
    run: RunTable = RunTable()
    """Timing."""
    transport: TransportTable = TransportTable()
    """Way of the messages."""
    record: RecordTable | None = None
    """Recording of a run."""

    @model_validator(mode="after")
    def _has_time_between_ticks(self) -> Self:
        if self.telemetry.numbered_by == "clock" and self.run.scan_s is None:
            raise ValueError(
                "telemetry.ticks 'clock', the default of source 'live', needs the time between two scans; "
                "give run.scan_s"
            )
        return self
