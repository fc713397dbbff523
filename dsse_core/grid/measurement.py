"""Meters and their readings: kinds, places, values and standard deviations (p.u. and rad)."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from enum import Enum, StrEnum
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from dsse_core.errors import InvalidInputError
from dsse_core.grid.network import Network
from dsse_core.grid.nodes import ANY_PHASE, PHASES, list_phases
from dsse_core.grid.quantities import Quantity
from dsse_core.limits import LEAST_USABLE_SIGMA, MOST_USABLE_SIGMA

LONGEST_BUS = 18  # digits
VIRTUAL_IS = "only an injection of exactly 0 can be virtual"


class MeterPlace(Enum):
    """Places of meters, which give the rows of C and Y: a node's own, or of Y that of the end of a branch."""

    BUS = "at a bus, of its voltage"
    INJECTION = "at a bus, of what enters the network"
    BRANCH = "at one end of a branch, positive into the branch"


class MeasurementKind(StrEnum):
    """A quantity at a place. A new kind is one more line here, and the key of a scenario that states its sigma.

    ``I_REAL``, ``I_IMAG``: of the current at all phases of a bus, 0 where legs stand between phases only; they have no
    meter and are virtual.
    """

    quantity: Quantity
    place: MeterPlace
    table: str
    """The key of ``[measurements]`` in a scenario; empty where no meter reads this."""
    words: str

    VM = "vm", Quantity.VM, MeterPlace.BUS, "voltage", "voltage magnitude"
    VA = "va", Quantity.VA, MeterPlace.BUS, "angle", "voltage angle"
    P_INJECTION = "p_injection", Quantity.P, MeterPlace.INJECTION, "injection", "active injection"
    Q_INJECTION = "q_injection", Quantity.Q, MeterPlace.INJECTION, "injection", "reactive injection"
    P_FLOW = "p_flow", Quantity.P, MeterPlace.BRANCH, "flow", "active flow"
    Q_FLOW = "q_flow", Quantity.Q, MeterPlace.BRANCH, "flow", "reactive flow"
    CURRENT = "current", Quantity.CURRENT, MeterPlace.BRANCH, "current", "current"
    I_REAL = "i_real", Quantity.I_REAL, MeterPlace.INJECTION, "", "sum of currents, real"
    I_IMAG = "i_imag", Quantity.I_IMAG, MeterPlace.INJECTION, "", "sum of currents, imaginary"

    def __new__(cls, name: str, quantity: Quantity, place: MeterPlace, table: str, words: str) -> Self:
        member = str.__new__(cls, name)
        member._value_ = name
        member.quantity, member.place, member.table, member.words = quantity, place, table, words
        return member

    @classmethod
    def of_table(cls, table: str) -> tuple[MeasurementKind, ...]:
        """The kinds of the meters that ``table`` states."""
        return tuple(kind for kind in cls if kind.table == table)

    @property
    def of_branch(self) -> bool:
        return self.place is MeterPlace.BRANCH

    @property
    def of_injection(self) -> bool:
        return self.place is MeterPlace.INJECTION

    @property
    def of_voltage(self) -> bool:
        return self.quantity.is_of_voltage

    @property
    def of_power(self) -> bool:
        return self.quantity.is_power

    @property
    def has_total(self) -> bool:
        """True for powers, whose phases add up, and for the current of a bus."""
        return self.quantity.adds_up

    @property
    def is_virtual(self) -> bool:
        """True for quantities that no meter reads."""
        return not self.table

    @property
    def needs_reference(self) -> bool:
        """True where readings count from the angle reference of the grid."""
        return self.quantity.turns and not self.is_virtual


class Source(StrEnum):
    """The origin of a value: a meter, a forecast, or the certainty that nothing is injected."""

    TELEMETERED = "telemetered"
    PSEUDO = "pseudo"
    VIRTUAL = "virtual"


@dataclass(frozen=True, slots=True)
class Meter:
    """A quantity that can be measured: its kind and its place (for flows, the branch and the end's bus).

    ``phases`` of that bus: "" in a balanced network, "a" between phase a and the ground, "ab" between a and b. Where
    buses have phases, P and Q without are totals: in p.u. the mean over all phases at the bus or the end of the branch.
    """

    kind: MeasurementKind
    bus: int
    branch: str | None = None
    source: Source = Source.TELEMETERED
    phases: str = ""
    _id: str | None = field(default=None, init=False, repr=False, compare=False)

    @property
    def id(self) -> str:
        """Unique within a network, e.g. ``vm@1``, ``p_injection@4.a``, ``q_flow@3:3-6``; the tie-breaker.

        Made once: an area knows its meters by id in a dozen tables.
        """
        if self._id is not None:
            return self._id
        made = f"{self.kind}@{self.at}:{self.branch}" if self.branch else f"{self.kind}@{self.at}"
        object.__setattr__(self, "_id", made)
        return made

    @property
    def at(self) -> str:
        """The bus with the phases, e.g. ``4`` or ``4.ab``."""
        return f"{self.bus}.{self.phases}" if self.phases else str(self.bus)

    @property
    def quantity(self) -> tuple[MeasurementKind, int, str | None, str]:
        """The quantity alone, as unique as the id but for two phases, in either order; made in less time."""
        phases = self.phases
        if len(phases) > 1:
            phases = "".join(sorted(list_phases(phases)))
        return self.kind, self.bus, self.branch, phases

    def __str__(self) -> str:
        place = f"branch {self.branch} at bus {self.at}" if self.branch else f"bus {self.at}"
        return f"{self.id} ({self.kind} of {place})"


KIND_OF = {str(kind): kind for kind in MeasurementKind}
_PLACE = re.compile(rf"(\d{{1,{LONGEST_BUS}}})(?:\.((?:{ANY_PHASE})+))?(?::(.*))?")
_WITH_OTHER_PHASES = re.compile(rf"(\w+@\d{{1,{LONGEST_BUS}}})\.([^:]*)(:.*)?")


def read_meter_id(text: str) -> Meter | None:
    """The meter with the id ``text``, as ``Meter.id`` writes it; None where it is none."""
    kind, _, place = text.partition("@")
    if kind not in KIND_OF or (found := _PLACE.fullmatch(place)) is None:
        return None
    bus, phases, branch = found.groups()
    return Meter(KIND_OF[kind], int(bus), branch or None, phases=phases or "")


def explain_no_meter(text: str) -> str:
    """The problem of ``text``, which is no id of a meter (``read_meter_id``)."""
    kind = KIND_OF.get(text.partition("@")[0])
    if kind is None or (found := _WITH_OTHER_PHASES.fullmatch(text)) is None:
        kinds = ", ".join(known for known in MeasurementKind if not known.is_virtual)
        return (
            f"{text!r:.80} is no meter id; one looks like vm@1, p_injection@4 or p_flow@3:3-4 "
            f"(KIND@BUS or KIND@BUS:BRANCH, kinds: {kinds})"
        )
    at, phases, branch = found.groups(default="")
    total = f"; a total has the id {at}{branch:.80}" if kind.has_total and not kind.is_virtual else ""
    return f"{text!r:.80} is no meter id: {phases!r:.20} names no phases of {', '.join(PHASES[1:])}{total}"


@dataclass(frozen=True, slots=True)
class Measurement:
    """A reading. ``sigma`` is the standard deviation of its error; a virtual measurement has none (0)."""

    meter: Meter
    value: float
    sigma: float


def check_measurements(network: Network, measurements: Sequence[Measurement]) -> None:
    """Check places, values and sigmas.

    Raises:
        InvalidInputError: listing every unknown bus or branch, bad sigma, bad value and duplicate.
    """
    problems = list(find_meter_problems(network, (m.meter for m in measurements)))
    for m in measurements:
        if not math.isfinite(m.value):
            problems.append(f"meter {m.meter.id}: the value is {m.value}, not a finite number")
        if m.meter.source is Source.VIRTUAL:
            if m.meter.kind.of_injection and m.value != 0.0:
                problems.append(f"meter {m.meter.id}: {VIRTUAL_IS}")
        elif not LEAST_USABLE_SIGMA < m.sigma < MOST_USABLE_SIGMA:
            problems.append(
                f"meter {m.meter.id}: sigma is {m.sigma}; a standard deviation must be positive, from "
                f"{LEAST_USABLE_SIGMA:g} to {MOST_USABLE_SIGMA:g} (declare an exact zero injection as virtual instead)"
            )
    if problems:
        raise InvalidInputError(f"measurements of network {network.name!r}", problems)


def read_numbers(name: str, given: ArrayLike) -> np.ndarray:
    """``given``, which errors call ``name``, as floats; NaN where it is masked: a masked value is no reading.

    Raises:
        InvalidInputError: ``given`` has something else than real numbers.
    """
    if isinstance(given, np.ma.MaskedArray):
        given = np.ma.filled(given.astype(object), np.nan)
    try:
        array = np.asarray(given)
        if array.dtype.kind == "c":
            raise TypeError("they are complex")
        return np.asarray(array, dtype=float)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(name, [f"give real numbers only: {error}"]) from None


def are_usable(sigmas: np.ndarray) -> np.ndarray:
    """True for each of ``sigmas`` that an estimate can use as a standard deviation, shape as given."""
    usable: np.ndarray = (sigmas > LEAST_USABLE_SIGMA) & (sigmas < MOST_USABLE_SIGMA)
    return usable


def check_readings(network: Network, meters: Sequence[Meter], values: np.ndarray, sigmas: np.ndarray) -> None:
    """Checks readings (n_meas,) in arrays as ``check_measurements`` does.

    Raises:
        InvalidInputError: see ``check_measurements``.
    """
    readings = zip(meters, values.tolist(), sigmas.tolist(), strict=True)
    check_measurements(network, [Measurement(meter, value, sigma) for meter, value, sigma in readings])


def find_meter_problems(network: Network, meters: Iterable[Meter]) -> Iterable[str]:
    """Every meter that does not fit the network, as text."""
    row, branch_by_id, has_phases = network.row, network.branch_by_id, not network.table.nodes.is_balanced
    seen: dict[tuple[MeasurementKind, int, str | None, str], str] = {}
    for meter in meters:
        is_virtual = meter.kind.is_virtual
        if (quantity := meter.quantity) in seen:
            twice = "given twice" if seen[quantity] == meter.phases else f"given as .{seen[quantity]} as well"
            yield f"meter {meter.id} is {twice}; keep one reading of each quantity"
        seen[quantity] = meter.phases
        if meter.source is Source.VIRTUAL and not meter.kind.of_injection:
            yield f"meter {meter.id}: {VIRTUAL_IS}"
        if is_virtual and meter.source is not Source.VIRTUAL:
            yield f"meter {meter.id}: no meter reads {meter.kind}; it is 0 by the legs of a bus, and virtual"
        if meter.bus not in row:
            yield f"meter {meter.id}: bus {meter.bus} is not in network {network.name!r}"
        if meter.kind.of_branch:
            branch = branch_by_id.get(meter.branch or "")
            if branch is None:
                yield f"meter {meter.id}: {_explain_unknown_branch(network, meter)}"
            elif not branch.in_service:
                yield f"meter {meter.id}: branch {meter.branch} is out of service"
            elif meter.bus not in (branch.from_bus, branch.to_bus):
                yield f"meter {meter.id}: branch {meter.branch} does not end at bus {meter.bus}"
        elif meter.branch is not None:
            yield f"meter {meter.id}: a {meter.kind} meter stands at a bus, not on a branch"
        if (has_phases or meter.phases or is_virtual) and meter.bus in row:
            yield from _find_problems_of_phases(network, meter)


def _explain_unknown_branch(network: Network, meter: Meter) -> str:
    """The problem of a meter whose branch is not there, and where a phase or the branch stands in an id."""
    if meter.branch is None:
        return f"stands on a branch; name it, as {meter.kind}@{meter.at}:BRANCH"
    problem = f"branch {meter.branch} is not in network {network.name!r}"
    branch, _, phase = meter.branch.rpartition(".")
    there = network.bus(meter.bus).phases if meter.bus in network.row else ""
    if not there or branch not in network.branch_by_id:
        return problem
    example = phase if phase in list_phases(there) else list_phases(there)[0]
    return f"{problem}; a phase stands behind the bus, as {meter.kind}@{meter.bus}.{example}:{branch}"


def _find_problems_of_phases(network: Network, meter: Meter) -> Iterable[str]:
    """Phases of a meter that its bus, or its end of its branch, does not have, as text."""
    bus = network.bus(meter.bus)
    if not meter.phases and not bus.phases:
        if meter.kind.is_virtual:
            yield f"meter {meter.id}: bus {bus.id} has no phases, and so no legs between them"
        return
    there, branch = bus.phases, network.branch_by_id.get(meter.branch or "")
    if branch is not None and branch.primitive is not None:
        at_from = meter.bus == branch.from_bus
        there = branch.primitive.from_phases if at_from else branch.primitive.to_phases
    wanted, most = list_phases(meter.phases), 1 if meter.kind.of_branch else 2
    if bus.phases and not meter.phases and meter.kind.has_total:
        return
    if meter.kind.is_virtual:
        yield f"meter {meter.id}: {meter.kind} is that of all phases of a bus; leave them out"
    elif not bus.phases:
        yield f"meter {meter.id}: bus {bus.id} has no phases; leave them out"
    elif not meter.phases or not 0 < len(wanted) <= most or len(set(wanted)) < len(wanted):
        pair = "" if most == 1 else ", or two"
        yield f"meter {meter.id}: name one phase{pair} of bus {bus.id}, which has {', '.join(list_phases(bus.phases))}"
    elif missing := [phase for phase in wanted if phase not in list_phases(there)]:
        yield f"meter {meter.id}: phase {', '.join(missing)} is not there, only {', '.join(list_phases(there))}"
    elif len(wanted) == 1 and meter.kind.of_voltage and bus.id in network.gauge.ungrounded:
        pairs = "".join(list_phases(bus.phases)[:2])
        yield (
            f"meter {meter.id}: bus {bus.id} stands in a part without ground, where a voltage to ground means nothing; "
            f"meter between two phases, such as {meter.kind}@{bus.id}.{pairs}"
        )
