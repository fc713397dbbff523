"""The keys of a network file, as strict tables: a table for each bus and branch, or a list of values for each key."""

from __future__ import annotations

from itertools import product
from typing import Annotated, ClassVar, Literal, Self, TypeVar

from pydantic import BeforeValidator, Discriminator, Field, Tag, model_validator

from dsse_core.files.kinds import NETWORK_FILE, FileKind
from dsse_core.files.quantities import BRANCH_ID
from dsse_core.files.strict_table import ColumnsTable, FileTable, Table, explain_lengths
from dsse_core.files.wording import describe_unknown
from dsse_core.grid.nodes import PHASES
from dsse_core.limits import LONGEST_NAME, Positive

ZERO = {"r0_ohm", "x0_ohm", "b0_us"}
NOTHING = (None,) * 4
IMPEDANCES = {f"{letter}_{unit}" for letter, unit in (*product("rx", ("ohm", "pu")), *product("bg", ("us", "pu")))}
IMPEDANCES |= ZERO
PORTS = {"g_ports_pu", "b_ports_pu", "g_charging_pu", "b_charging_pu"}
OF_PHASES = {"phases", "to_phases"} | ZERO | PORTS  # keys that branches of balanced networks lack
WHOLE_PORTS = "g_ports_pu and b_ports_pu stand together, and in place of an impedance"
MIXED = "mixes ohm and microsiemens with r_pu/x_pu/b_pu/g_pu; give all of them in one of the two units"
TWO_RATINGS = "has two ratings; give rating_a for a line or rating_mva for a transformer"
NO_IMPEDANCE = "has no complete impedance; give r_ohm and x_ohm, or r_pu and x_pu"


Phases = Annotated[str, Field(max_length=LONGEST_NAME)]


class BusTable(Table):
    """One ``[[bus]]``."""

    id: int = Field(description="the number of the bus, its own in the network")
    """Number of the bus, -10^15 to 10^15, also on the wire and in tables."""
    base_kv: Positive = Field(description="nominal voltage in kV")
    """Nominal voltage."""
    name: str = ""
    """For readers."""
    phases: Phases = Field(
        default="", description='phases such as "abc", each a node; without phases the bus is balanced'
    )
    """Phases such as `"abc"` or `"s1s2"`, a node each; in a network with phases each bus has its own."""
    p_load_mw: float = 0.0
    """Load, constant power."""
    q_load_mvar: float = 0.0
    """Load, constant power."""
    g_shunt_mw: float = Field(default=0.0, description="MW that the shunt consumes at 1 p.u. voltage")
    """Consumption of the shunt at 1 p.u. voltage, with phases of all of them, alike; else give a `[[shunt]]`."""
    b_shunt_mvar: float = Field(default=0.0, description="Mvar that the shunt produces at 1 p.u. voltage")
    """Production of the shunt at 1 p.u. voltage: positive for a capacitor."""
    x: float | None = Field(default=None, description="place of the bus on a map, to the east, in any unit")
    """Place on a map, to the east, in any unit, e.g. a longitude. A page draws the feeder by `x` and `y` where each bus
    has both.
    """
    y: float | None = Field(default=None, description="place of the bus on a map, to the north, in the unit of x")
    """Place on a map, to the north, in the unit of `x`."""


def _shape_of(value: object) -> str:
    """The member of ``Matrix`` that ``value`` is meant to be, as its tag."""
    return "[rows]" if isinstance(value, list) else "[number]"


Triangle = Annotated[list[list[float]], Field(max_length=len(PHASES))]
Matrix = Annotated[
    Annotated[float, Tag("[number]")] | Annotated[Triangle, Tag("[rows]")],
    Discriminator(_shape_of),
]
"""A number, or between phases the rows of a lower triangle."""
Taps = Annotated[
    Annotated[Positive, Tag("[number]")] | Annotated[list[Positive], Tag("[rows]")], Discriminator(_shape_of)
]


def _shape_of_pairs(value: object) -> str:
    """The member of ``Exponents`` that ``value`` is meant to be, as its tag."""
    return "[rows]" if isinstance(value, list) and value and isinstance(value[0], list) else "[pair]"


Pair = Annotated[list[float], Field(min_length=2, max_length=2)]
Exponents = Annotated[
    Annotated[Pair, Tag("[pair]")] | Annotated[list[Pair], Tag("[rows]")], Discriminator(_shape_of_pairs)
]
"""Of P and of Q, of all legs of a load, or a pair for each leg."""
Form = TypeVar("Form", "BranchTable", "BranchColumns")


def is_in_ohm(given: BranchTable | BranchColumns) -> bool:
    """True where impedances are in ohm, false where they are in p.u."""
    return given.r_ohm is not None


def has_one_complete_impedance(given: Form) -> Form:
    """``given``, checked: r and x are there, and r, x, b and g are all in one of the two units.

    Raises:
        ValueError: the impedance is incomplete, or in both units.
    """
    keys = frozenset[str]() if isinstance(given, BranchColumns) else frozenset(given.model_fields_set)
    if isinstance(given, BranchTable) and not keys.isdisjoint(PORTS):
        if None in (given.g_ports_pu, given.b_ports_pu) or keys & IMPEDANCES:
            raise ValueError(f"has {', '.join(sorted(keys & PORTS))}; {WHOLE_PORTS}")
        return given
    ohm = (given.r_ohm, given.x_ohm, given.b_us, given.g_us)
    pu = (given.r_pu, given.x_pu, given.b_pu, given.g_pu)
    if (ohm != NOTHING or keys & ZERO) and pu != NOTHING:
        raise ValueError(MIXED)
    if None in ohm[:2] and None in pu[:2]:
        raise ValueError(NO_IMPEDANCE)
    return given


class BranchTable(Table):
    """One ``[[branch]]``: a line or a transformer, its tap at the from side."""

    from_: int = Field(alias="from", description="id of the bus at the tap side")
    """Bus at the tap side."""
    to: int = Field(description="id of the bus at the other end")
    """Bus at the other end."""
    id: str | None = Field(
        default=None,
        pattern=f"^{BRANCH_ID.pattern}$",
        description=f"at most {LONGEST_NAME} lower-case letters, digits, _ and -",
    )
    """At most 64 lower-case letters, digits, `_` and `-`; `from-to` if left out, e.g. `3-4`, or where a parallel
    branch has that `3-4#2`, `3-4#3`. No branch of other ends may have it.
    """
    phases: Phases = Field(default="", description='phases that the branch joins, such as "bc"')
    """Phases that the branch joins, such as `"bc"`; required where buses have phases. `r`, `x`, `b`, `g` are then the
    rows of lower triangles, `[[0.3], [0.1, 0.3]]`, or a number for each phase, alike and not coupled.
    """
    r_ohm: Matrix | None = None
    """Series resistance."""
    x_ohm: Matrix | None = None
    """Series reactance."""
    b_us: Matrix | None = Field(default=None, description="total charging in microsiemens")
    """Total charging, microsiemens; 0 if left out."""
    g_us: Matrix | None = Field(default=None, description="total leakage or iron losses in microsiemens")
    """Total leakage or iron losses, microsiemens; 0 if left out."""
    r_pu: Matrix | None = None
    """Series resistance."""
    x_pu: Matrix | None = None
    """Series reactance."""
    b_pu: Matrix | None = Field(default=None, description="total charging in p.u.")
    """Total charging; 0 if left out."""
    g_pu: Matrix | None = Field(default=None, description="total leakage or iron losses in p.u.")
    """Total leakage or iron losses; 0 if left out."""
    r0_ohm: float | None = None
    """Zero sequence beside a number `r_ohm`; equal to it if left out."""
    x0_ohm: float | None = None
    """Likewise."""
    b0_us: float | None = None
    """Likewise."""
    g_ports_pu: Triangle | None = None
    """In place of an impedance, as in saved networks: conductances over the phases at `from`, then at `to`."""
    b_ports_pu: Triangle | None = None
    """Susceptances."""
    g_charging_pu: Triangle | None = None
    """Part of them that draws current without load."""
    b_charging_pu: Triangle | None = None
    """Likewise."""
    to_phases: Phases = Field(default="", description="phases at the to end, beside g_ports_pu, where they are others")
    """Phases at `to`, where others, beside `g_ports_pu`."""
    tap_ratio: Positive = Field(default=1.0, description="divides the from-side voltage; 1.0 for a line")
    """Divides the from-side voltage: without load `v_to = v_from / tap_ratio`."""
    tap_steps: float = Field(default=0.0, ge=0.0, description="change of tap_ratio by one step of the tap changer")
    """Change of `tap_ratio` by one step of a tap changer. Such taps are checked against the readings
    ([taps](../explanation/theory.md#taps)); 0 where the tap is fixed.
    """
    estimate_tap: bool = False
    """True where the tap is estimated, from `tap_ratio` on; needs a voltmeter at both ends
    ([estimated taps](../explanation/theory.md#estimated-taps)).
    """
    shift_deg: float = 0.0
    """Phase shift: without load the angle of `to` is that of `from` minus the shift."""
    in_service: bool = True
    """True where the branch is closed."""
    switch: bool = False
    """True where the branch may be opened and closed while areas run ([operating](../how-to/operating.md)); then
    `in_service` is its status until an order.
    """
    name: str = ""
    """Name in results, beside the id."""
    rating_a: Positive | None = Field(default=None, description="current that the line may carry, at either end")
    """Current in A that the line may carry at either end; both ends have one `base_kv`."""
    rating_mva: Positive | None = Field(
        default=None, description="apparent power that the branch may carry, at either end"
    )
    """Apparent power in MVA that the branch may carry at either end, in place of `rating_a`. Loading is the
    larger end by the rating.
    """

    is_in_ohm = property(is_in_ohm)
    _has_one_complete_impedance = model_validator(mode="after")(has_one_complete_impedance)

    @model_validator(mode="after")
    def _has_one_rating(self) -> Self:
        if None not in (self.rating_a, self.rating_mva):
            raise ValueError(TWO_RATINGS)
        return self


class LoadTable(Table):
    """One ``[[load]]``: legs at a bus with phases."""

    bus: int = Field(description="id of the bus where the load stands")
    """Bus where the load stands."""
    phases: Phases = Field(description='a leg, "bc" between b and c, "b" from b to ground; or several, "ab,bc,ca"')
    """The legs: `"bc"` is a leg between b and c, `"b,c"` two legs to ground, `"ab,bc,ca"` a delta."""
    p_kw: list[float] | None = None
    """Power drawn by each leg, else 0."""
    q_kvar: list[float] | None = None
    """Reactive power drawn by each leg; 0 if left out."""
    exponents: Exponents = Field(default=[0.0, 0.0], description="of P and of Q, or such a pair for each leg")
    """Exponents of P and of Q, or a pair for each leg: at another voltage a leg draws that share of it to these powers.
    0 is constant power, 1 constant current, 2 constant impedance.
    """
    kv: Positive | None = Field(default=None, description="voltage across a leg at which it draws these powers")
    """Voltage across a leg at which it draws these powers; the nominal one if left out."""


class ShuntTable(Table):
    """One ``[[shunt]]``: legs of known admittance at a bus with phases."""

    bus: int = Field(description="id of the bus where the shunt stands")
    """Bus where the shunt stands."""
    phases: Phases = Field(description='a leg, "bc" between b and c, "b" from b to ground; or several, "ab,bc,ca"')
    """The legs, as those of a load."""
    g_kw: list[float] | None = Field(default=None, description="kW that each leg consumes at nominal voltage")
    """Consumption of each leg at nominal voltage; 0 if left out."""
    b_kvar: list[float] | None = Field(default=None, description="kvar that each leg produces at nominal voltage")
    """Production of each leg at nominal voltage, positive for a capacitor; 0 if left out."""


class WindingTable(Table):
    """One of the ``windings`` of a transformer."""

    bus: int = Field(description="id of the bus at this side")
    """Bus at this side."""
    phases: Phases = Field(description='phases of the bus that the bank joins, such as "abc"')
    """Phases of the bus that the bank joins."""
    kv: Positive = Field(description="rated voltage between lines; of a winding to ground 3^0.5 times that across it")
    """Rated voltage between lines; of a winding to ground 3^0.5 times the voltage across it."""
    connection: Phases = Field(description="'grounded wye', 'wye', 'delta', 'centre-tapped', or the windings, 'ab,bc'")
    """`"grounded wye"`, `"wye"` with a free star point, `"delta"`, or where each winding stands: `"ab,bc"` is an open
    delta, `"an,bn,cn"` a wye. `"centre-tapped"` of a second side with phases `s1s2`: two interlaced halves.
    """
    taps: Taps = Field(default=1.0, description="turns by nominal ones, of all windings or of each")
    """Turns by nominal ones, 0.5 to 2, a number or one for each winding: a regulator has
    `taps = [1.0625, 1.05, 1.06875]` at its regulated side.
    """


class TransformerTable(Table):
    """One ``[[transformer]]`` between buses with phases: a bank of equal units of two windings, or a regulator."""

    id: str | None = Field(default=None, pattern=f"^{BRANCH_ID.pattern}$", description="as the id of a branch")
    """As that of a branch, whose ids it shares; `from-to` if left out, of the buses of its windings."""
    windings: list[WindingTable] = Field(min_length=2, description="two tables, of the from and of the to side")
    """Two tables: the from side, then the to side."""
    kva: Positive = Field(description="rated power of the whole bank in kVA")
    """Rated power of the whole bank."""
    r_percent: float = Field(ge=0, description="series resistance of both windings, of the rated one")
    """Series resistance of both windings."""
    x_percent: float = Field(description="series reactance of both windings, of the rated one")
    """Series reactance of both windings."""
    no_load_percent: float = Field(default=0.0, ge=0, description="losses without load, of the rated power")
    """Losses in the iron at rated voltage, of `kva`; they stand at the to side."""
    magnetising_percent: float = Field(default=0.0, ge=0, description="magnetising current, of the rated one")
    """Magnetising current at rated voltage, of the rated one; likewise."""
    clock: Literal[0, 1, 5, 6, 7, 11] | None = Field(default=None, description="lag of the low side, 30 degrees each")
    """Hours of 30 degrees by which the side of the lower `kv` (of equal ones the second) lags: 1, 5, 7 or 11 with a
    delta at one side, 1 if left out; else 0 or 6, 0 if left out.
    """
    in_service: bool = True
    """True where the bank is connected."""
    name: str = ""
    """Name in results, beside the id."""
    rating_mva: Positive | None = Field(default=None, description="apparent power that the whole bank may carry")
    """Apparent power that the whole bank may carry, in MVA."""


OptionalId = Annotated[str, Field(pattern=f"^({BRANCH_ID.pattern})?$")]
"""Empty where a branch is called by its ends."""


class BusColumns(ColumnsTable):
    """``bus`` as lists: the keys of ``BusTable``."""

    id: list[int] = Field(min_length=1, description="the numbers of the buses, each its own in the network")
    base_kv: list[Positive] = Field(description="nominal voltages in kV")
    name: list[str] | None = None
    phases: list[Phases] | None = None
    p_load_mw: list[float] | None = None
    q_load_mvar: list[float] | None = None
    g_shunt_mw: list[float] | None = None
    b_shunt_mvar: list[float] | None = None
    x: list[float | None] | None = None
    y: list[float | None] | None = None


class BranchColumns(ColumnsTable):
    """``branch`` as lists: the keys of ``BranchTable``."""

    from_: list[int] = Field(alias="from", description="ids of the buses at the tap sides")
    to: list[int] = Field(description="ids of the buses at the other ends")
    id: list[OptionalId] | None = None
    r_ohm: list[float] | None = None
    x_ohm: list[float] | None = None
    b_us: list[float] | None = None
    g_us: list[float] | None = None
    r_pu: list[float] | None = None
    x_pu: list[float] | None = None
    b_pu: list[float] | None = None
    g_pu: list[float] | None = None
    tap_ratio: list[Positive] | None = None
    tap_steps: list[float] | None = None
    estimate_tap: list[bool] | None = None
    shift_deg: list[float] | None = None
    in_service: list[bool] | None = None
    switch: list[bool] | None = None
    name: list[str] | None = None
    rating_a: list[Positive | None] | None = Field(default=None, description="null where a branch has none")
    rating_mva: list[Positive | None] | None = Field(default=None, description="null where a branch has none")

    is_in_ohm = property(is_in_ohm)
    _has_one_complete_impedance = model_validator(mode="after")(has_one_complete_impedance)

    @model_validator(mode="after")
    def _has_one_rating_each(self) -> Self:
        ratings = zip(self.rating_a or (), self.rating_mva or (), strict=False)
        if twice := [str(k) for k, pair in enumerate(ratings, 1) if None not in pair]:
            raise ValueError(f"{TWO_RATINGS}: number {', '.join(twice)}")
        return self


class SourceTable(Table):
    """One ``[[source]]``: the substation or a generator."""

    bus: int = Field(description="id of the bus that the source feeds")
    """Bus that is fed."""
    kind: Literal["slack", "voltage", "power"] = Field(description="slack: the substation; voltage: holds P and vm")
    """`"slack"`: the substation, holds voltage and angle, exactly one. `"voltage"`: holds P and the voltage
    magnitude. `"power"`: holds P and Q.
    """
    p_mw: float = 0.0
    """Production; for `"slack"` a schedule for load messages."""
    q_mvar: float = 0.0
    """Production; for `"slack"` and `"voltage"` a schedule for load messages."""
    vm_pu: Positive | None = None
    """Set-point; required for `"slack"` and `"voltage"`, rejected for `"power"`."""
    va_deg: float | None = None
    """Angle of the slack, 0 if left out; rejected for other kinds."""

    @model_validator(mode="after")
    def _has_the_set_points_of_its_kind(self) -> Self:
        if self.kind == "power" and self.vm_pu is not None:
            raise ValueError("vm_pu has no meaning for kind 'power'; remove it or use kind 'voltage'")
        if self.kind != "power" and self.vm_pu is None:
            raise ValueError(f"vm_pu is missing; a source of kind {self.kind!r} needs its voltage set-point in p.u.")
        if self.kind != "slack" and self.va_deg is not None:
            raise ValueError(f"va_deg has no meaning for kind {self.kind!r}; only the slack holds an angle")
        return self


def _form_of(value: object) -> str:
    """The member of ``Buses`` and ``Branches`` that ``value`` is meant to be, as its tag."""
    return "[lists]" if isinstance(value, dict) else "[tables]"


def _form_of_branches(value: object) -> str:
    """``_form_of``, with lists of branches with phases apart."""
    return "[phases]" if isinstance(value, dict) and not OF_PHASES.isdisjoint(value) else _form_of(value)


def _list_tables(lists: object) -> list[dict[str, object]]:
    """A table for each branch, of a list for each key, in which null and an empty text stand for no value.

    Raises:
        ValueError: a key is unknown, or the lists are none, or not of one length.
    """
    assert isinstance(lists, dict)  # by its tag
    known = [field.alias or name for name, field in BranchTable.model_fields.items()]
    problems = [describe_unknown("key", key, known) for key in lists if key not in known]
    problems += [f"{key} is no list" for key, values in lists.items() if not isinstance(values, list)]
    if problems:
        raise ValueError("; ".join(problems))
    lengths = {key: len(values) for key, values in lists.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(explain_lengths(lengths))
    rows = zip(*lists.values(), strict=True)
    return [{key: v for key, v in zip(lists, row, strict=True) if v is not None and v != ""} for row in rows]


Buses = Annotated[
    Annotated[list[BusTable], Field(min_length=1), Tag("[tables]")] | Annotated[BusColumns, Tag("[lists]")],
    Discriminator(_form_of),
]
Branches = Annotated[
    Annotated[list[BranchTable], Tag("[tables]")]
    | Annotated[list[BranchTable], BeforeValidator(_list_tables), Tag("[phases]")]
    | Annotated[BranchColumns, Tag("[lists]")],
    Discriminator(_form_of_branches),
]


class NetworkFile(FileTable):
    """A whole network file."""

    kind: ClassVar[FileKind] = NETWORK_FILE

    name: str = Field(min_length=1, description="the name of the network")
    data_source: str = Field(min_length=1, description="where the data come from")
    """Source of the data."""
    base_mva: Positive = Field(description="base of the per-unit system in MVA")
    bus: Buses = Field(description="one [[bus]] for each bus, or a list for each key")
    """`[[bus]]`, one for each bus."""
    branch: Branches = Field(description="one [[branch]] for each line and transformer, or a list for each key")
    """`[[branch]]`, one for each line and transformer."""
    transformer: list[TransformerTable] = Field(
        default_factory=list, description="one [[transformer]] for each bank with phases"
    )
    """`[[transformer]]`, one for each bank or regulator of a network with phases."""
    load: list[LoadTable] = Field(
        default_factory=list, description="one [[load]] for each load of a network with phases"
    )
    """`[[load]]`, of a network with phases."""
    shunt: list[ShuntTable] = Field(default_factory=list, description="one [[shunt]] for each of some phases of a bus")
    """`[[shunt]]`, of some phases of a bus."""
    source: list[SourceTable] = Field(min_length=1, description="one [[source]] for the substation and each generator")
    """`[[source]]`, one for the substation and one for each generator."""
