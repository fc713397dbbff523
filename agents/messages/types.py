"""Messages on the bus: one typed definition of each, from which packing, checks and documentation follow.

Every message is absolute and idempotent. The fields of a class stand in a message in their order (``packing.py``),
each as its type says (``checks.py``). ``find_misfit`` runs once for each message that is read, and finds fields that
contradict each other. Messages of asynchronous strategies stand with their strategies (``BoundaryUpdate``).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar, Self

from agents.messages.boundary_arrays import Lengths, OfRound, Variables, count_triangle, find_wrong_length
from agents.messages.checks import BusId, Count, Integer, MessageError, Name, Names, Notes, Number, Numbers, PerPhase
from dsse_core.estimation.decision import Totals
from dsse_core.exchange.boundary_load import Loads, NetLoad
from dsse_core.grid.boundary import Boundary, Kind, boundary_of, find_wrong_name
from dsse_core.split_identity import NO_SPLIT, SplitIdentity

LAST = {"is_last": True}  # of a field that stands behind those of derived classes


@dataclass(frozen=True, slots=True, order=True)
class Incarnation:
    """One incarnation of a process: a restarted one is newer than its past."""

    start_ms: Count
    random: Count

    def __str__(self) -> str:
        """The incarnation as the key of its presence token has it."""
        return f"{self.start_ms:x}-{self.random:08x}"


NO_INCARNATION = Incarnation(0, 0)


@dataclass(frozen=True, slots=True)
class Header:
    """Sender of a message, its incarnation, and the message's scan. ``sequence`` grows with every changed content."""

    run: Name
    sender: Name
    incarnation: Incarnation
    scan: Count
    sequence: Count
    time: Number  # s since 1970; rejected from the future, and of two messages of one order the later one counts

    @property
    def order(self) -> tuple[Incarnation, int]:
        """Order of the messages of one sender: a newer one has a higher order."""
        return (self.incarnation, self.sequence)


@dataclass(frozen=True, slots=True)
class LoadMessage:
    """The net load, p.u., of everything on the sender's side of a boundary bus (thesis eqs. 5.1, 5.2).

    ``sigma``: standard deviation of ``p`` and ``q``, from the meters in the sum. Each has a number of each phase of the
    boundary, or one number of a balanced side.
    """

    kind: ClassVar[str] = "load"
    header: Header
    bus: BusId
    p: PerPhase
    q: PerPhase
    sigma: PerPhase

    @classmethod
    def of(cls, header: Header, bus: int, loads: Loads) -> Self:
        """The message of the net ``loads`` at the boundary."""
        p, q, sigma = zip(*((load.s.real, load.s.imag, load.variance**0.5) for load in loads), strict=True)
        return cls(header, bus, p, q, sigma)

    @property
    def loads(self) -> Loads:
        return tuple(
            NetLoad(complex(p, q), sigma * sigma) for p, q, sigma in zip(self.p, self.q, self.sigma, strict=True)
        )

    def find_misfit(self) -> str:
        return _find_unequal(self, "p", "q", "sigma") or ("" if self.p else "p, q, sigma: are empty")


@dataclass(frozen=True, slots=True)
class BoundaryUpdate:
    """Message of an area to a neighbour about their boundary ``bus`` under an asynchronous strategy.

    A strategy derives its own message from it: a dataclass with a ``kind`` that no other message has, which is a part
    of keys (a-z, 0-9, _ and -), and with fields of the types of ``agents/messages``. ``receives``,
    ``answers``, ``received``, ``complete``: of the link, as in a heartbeat. The protocol fills them in. They hold at
    ``header.time``, may differ between two messages of one number, and stand last in the message.
    """

    kind: ClassVar[str]
    header: Header
    bus: BusId
    receives: bool = field(default=False, kw_only=True, metadata=LAST)
    answers: Number = field(default=0.0, kw_only=True, metadata=LAST)
    received: tuple[Count, Count] = field(default=(0, 0), kw_only=True, metadata=LAST)
    complete: bool = field(default=False, kw_only=True, metadata=LAST)

    def falsified(self, falsify: Callable[[Numbers], Numbers]) -> Self:
        """The message as an injected lie changes it.

        ``falsify``: of the numbers y of the message's ``variables``; without these, of (p, q, vm, va) at ``bus``. A
        message that does not say which of its numbers are about the boundary cannot lie.
        """
        return self


@dataclass(frozen=True, slots=True)
class VariablesMessage(ABC):
    """A message with numbers of the d ``variables`` y of a boundary."""

    header: Header
    variables: Variables = field(kw_only=True)

    @property
    def boundary(self) -> Boundary:
        """The boundary whose ``variables`` these are."""
        return boundary_of(self.variables)

    @abstractmethod
    def lengths(self) -> Lengths:
        """Field -> how many numbers it has, and how many it may have."""

    def find_misfit(self) -> str:
        return find_wrong_name(self.variables) or find_wrong_length(self.boundary, self.lengths())


@dataclass(frozen=True, slots=True)
class PlaceMessage(VariablesMessage):
    """A message from round ``k`` of the term (scan, ``revision``), which also states the condition of the link.

    ``receives``: the sender receives messages of the receiver. ``answers``: send time of the receiver's newest message
    plus the time since the sender got it, from which the receiver finds the round trip; 0 without one. ``received``:
    numbers of the newest load message and of the newest message of the strategy that the sender has accepted from the
    receiver; 0 without one.
    """

    revision: Count
    k: Count
    receives: bool
    answers: Number
    received: tuple[Count, Count]


@dataclass(frozen=True, slots=True)
class HeartbeatMessage(PlaceMessage):
    """Progress of the sender: its round ``k`` in (scan, ``revision``), and whether that round is ``final``.

    Asynchronous strategies have no rounds: there ``k`` is the number of the newest boundary message to the receiver.
    ``complete``: everything on the sender's side is of this scan, received and fresh. ``y``: at rest, the d
    ``variables`` of the boundary in the sender's final state. ``plant``, ``offset``: the scan of terms is the number
    that this incarnation of the plant gives the scan, plus ``offset`` (``agents/protocol/numbering.py``).
    ``towards_hub``, ``is_parent``: role of the receiver for the sender; ``areas``: number of areas in the grid;
    ``base_mva``: base power, MVA; all four are from the sender's area file (``agreement.py``). ``clock``: lead of the
    sender's clock over its send times, s; these go on where the clock has been set back. ``split``: of the sender's
    area file.
    """

    kind: ClassVar[str] = "heartbeat"
    final: bool
    complete: bool
    y: Numbers
    plant: Incarnation = NO_INCARNATION
    offset: Count = 0
    towards_hub: bool = False
    is_parent: bool = False
    areas: Count = 1
    base_mva: Number = 1.0
    clock: Number = 0.0
    split: SplitIdentity = NO_SPLIT

    def lengths(self) -> Lengths:
        return {"y": (len(self.y), (0, self.boundary.d))}


@dataclass(frozen=True)
class RoundMessage(PlaceMessage):
    """Information of the sender's side in round ``k`` of the term (scan, ``revision``): all that it knows at x_k.

    ``R``, ``z``: the side's cost-to-go at the boundary, ``1/2 |R y - z|^2``, R the upper triangle of a (d, d) matrix
    row by row; empty where no step is to come. ``no_load``: R of the no-load model in round 0, of (p, q) / vm_b^2,
    dvm / vm_b and dva, vm_b being the sender's no-load voltage; empty where something is missing. ``power``: the powers
    among y; empty where all flow into the receiver, which computes them. ``pieces``: in round 0, of each node of the
    boundary, 0 where it is fed on the sender's side, else the number of its piece there.
    """

    R: OfRound
    z: OfRound
    no_load: OfRound
    power: OfRound
    totals: Totals
    pieces: tuple[Count, ...] = field(default=(), kw_only=True, metadata=LAST)

    def lengths(self) -> Lengths:
        d = self.boundary.d
        triangle = count_triangle(d)
        return {
            "R": (len(self.R), (0, triangle)),
            "z": (len(self.z), (d,) if self.R else (0,)),
            "no_load": (len(self.no_load), (0, triangle)),
            "power": (len(self.power), (0, self.boundary.n_powers)),
            "pieces": (len(self.pieces), (0, len(self.boundary.places[Kind.VM]))),
        }


@dataclass(frozen=True)
class UpMessage(RoundMessage):
    """Towards the hub; the totals are those of the sender's side."""

    kind: ClassVar[str] = "up"


@dataclass(frozen=True)
class DownMessage(RoundMessage):
    """From the side of the hub; the totals are those of all areas, on which ``decider`` in its ``incarnation`` decided.

    ``verdict``: the verdict that follows from these totals; the receiver derives it, too, and compares.
    """

    kind: ClassVar[str] = "down"
    verdict: Name
    decider: Name
    incarnation: tuple[Count, Count]


@dataclass(frozen=True, slots=True)
class TelemetryMessage:
    """Last readings of a gateway, or of the plant, from its meters in an area: id, value and sigma, p.u. and rad.

    ``times``: time of each measurement, s since 1970 UTC. ``valid``: True where the source vouches for the reading.
    ``split``: of the scenario from which a plant reads; a gateway states none.
    """

    kind: ClassVar[str] = "telemetry"
    header: Header
    area: Name
    meters: Names
    values: Numbers
    sigmas: Numbers
    times: Numbers
    valid: tuple[bool, ...]
    split: SplitIdentity = NO_SPLIT

    def find_misfit(self) -> str:
        if len(set(self.meters)) < len(self.meters):
            raise MessageError("meter given twice", "keep one reading of each")  # its own reason of rejection
        return _find_unequal(self, "meters", "values", "sigmas", "times", "valid")


@dataclass(frozen=True, slots=True)
class ReadingsMessage:
    """The readings that an area has used in a scan, for recorders: id, value, sigma grown with the age, p.u. and rad.

    ``taken_at``: time to which their ages count; ``times``: time of each measurement; both s since 1970 UTC.
    ``estimates``, ``normalised``: for the first meters, those on which the state of this scan rests: the reading of
    each in that state, and its normalised residual (0: no other meter determines its reading).
    """

    kind: ClassVar[str] = "readings"
    header: Header
    taken_at: Number
    meters: Names
    values: Numbers
    sigmas: Numbers
    times: Numbers
    estimates: Numbers = ()
    normalised: Numbers = ()

    def find_misfit(self) -> str:
        if len(set(self.meters)) < len(self.meters):
            return "meters: one is given twice"
        if len(self.estimates) > len(self.meters):
            return "more estimates than meters"
        return _find_unequal(self, "meters", "values", "sigmas", "times") or _find_unequal(
            self, "estimates", "normalised"
        )


@dataclass(frozen=True, slots=True)
class CommandMessage:
    """Command of the operator to area ``to``, or to the plant; of two messages the one of higher order counts.

    ``meters_off``: meters to leave out from now on; ``meters_on``: meters to use again. Other meters stay as they are,
    so the commands of two operators add up. ``scan``: the area takes the newest readings at once. ``stop``: its process
    ends. ``opened``, ``closed``: switches that are open, or closed, from now on.
    """

    kind: ClassVar[str] = "command"
    header: Header
    to: Name
    meters_off: Names
    meters_on: Names
    scan: bool
    stop: bool
    opened: Names = ()
    closed: Names = ()

    def find_misfit(self) -> str:
        both = {*self.opened} & {*self.closed}
        return f"a command to open and to close {min(both)}" if both else ""


@dataclass(frozen=True, slots=True)
class ClockMessage:
    """Time since all areas of the run were there, ``elapsed_s``; windows of injected faults count from then."""

    kind: ClassVar[str] = "clock"
    header: Header
    elapsed_s: Number


@dataclass(frozen=True, slots=True)
class StateMessage:
    """State of an area and its basis, for watchers.

    ``buses``, ``vm``, ``va``, ``sigma_vm``, ``sigma_va``: the estimate (empty before the first), p.u. and rad.
    ``referenced``: angles count from the substation. ``removed``: meters taken out as bad data.
    ``critical``: meters that cannot be spared, whatever they read. ``checked``: the search for bad data has been done.
    ``sent``, ``received``: per neighbour the last sequence numbers of load messages and of boundary messages or those
    of rounds; 0 before any.
    ``messages``, ``bytes``, ``lost``: totals handed to the bus, ``lost`` of them dropped by the links; ``faults``:
    number of injected faults by kind. ``rejected``: number of rejected payloads by reason.
    ``quality``: of the state (docs/explanation/quality.md). ``notes``: its reasons, the worst first, then remarks.
    ``telemetry_age``: s since telemetry was last received, before the first since the process began;
    ``ages``, ``scans``: neighbour -> s since its boundary message was last received, and the scan of the newest;
    ``old_sides``: neighbours that state that their side rests on something old. ``clock_skews``: neighbour -> lead of
    its clock over this area's, s. All these hold at ``header.time`` and may differ between two states of one sequence
    number.
    ``taken_at``: time to which the ages of the readings count, s since 1970; ``oldest_reading``: age of the oldest
    reading used, s, and at least ``telemetry_age``. ``meters_off``: meters that the operator has switched
    off; ``command``: (start_ms, random, sequence) of the last command that was followed, zeros before any. ``split``:
    of the area file; ``next_split``: of the file that lies ready beside it. ``into_children``: P and Q from each of the
    area's boundary buses into the branches of each child there, as ``Area.powers_into_children`` has them; empty where
    they are not known. ``phases``: of each entry of ``buses``, which then are nodes; empty in a balanced network.
    ``switches``: switch that the area holds -> "open" or "closed", on which the estimate rests. ``taps``: branch
    whose tap the area estimates -> its ratio, and the standard deviation of that.
    """

    kind: ClassVar[str] = "state"
    header: Header
    buses: tuple[BusId, ...]
    vm: Numbers
    va: Numbers
    sigma_vm: Numbers
    sigma_va: Numbers
    referenced: bool
    objective: Number
    degrees_of_freedom: Integer
    removed: Names
    critical: Names
    checked: bool
    sent: dict[Name, tuple[Count, Count]]
    received: dict[Name, tuple[Count, Count]]
    messages: Count
    bytes: Count
    lost: Count
    rejected: dict[Name, Count]
    notes: Notes
    faults: dict[Name, Count]
    quality: Name
    telemetry_age: Number
    ages: dict[Name, Number]
    scans: dict[Name, Count]
    old_sides: Names
    clock_skews: dict[Name, Number] = field(default_factory=dict)
    taken_at: Number = 0.0
    oldest_reading: Number = 0.0
    meters_off: Names = ()
    command: tuple[Count, Count, Count] = (0, 0, 0)
    split: SplitIdentity = NO_SPLIT
    next_split: SplitIdentity = NO_SPLIT
    into_children: Numbers = ()
    phases: Names = ()
    switches: dict[Name, Name] = field(default_factory=dict)
    taps: dict[Name, tuple[Number, Number]] = field(default_factory=dict)

    @property
    def nodes(self) -> tuple[tuple[int, str], ...]:
        """Bus and phase of each entry of ``vm``; the phase is "" in a balanced network."""
        return tuple(zip(self.buses, self.phases or ("",) * len(self.buses), strict=True))

    def row_of(self, bus: int, phase: str = "") -> int:
        """The place in ``vm`` of a node that the state has."""
        return self.nodes.index((bus, phase)) if self.phases else self.buses.index(bus)

    def phases_at(self, bus: int) -> tuple[str, ...]:
        """The phases of the state at ``bus``, ("",) in a balanced network; empty where it does not have the bus."""
        if not self.phases:
            return ("",) if bus in self.buses else ()
        return tuple(phase for at, phase in self.nodes if at == bus)

    def find_misfit(self) -> str:
        if self.phases and len(self.phases) != len(self.buses):
            return "buses, phases differ in length"
        if len(set(self.nodes if self.phases else self.buses)) < len(self.buses):
            return f"{'nodes' if self.phases else 'buses'}: one is given twice"
        return _find_unequal(self, "buses", "vm", "va", "sigma_vm", "sigma_va")


def _find_unequal(message: object, *names: str) -> str:
    """Sentence about arrays that belong together and differ in length; empty if they are equally long."""
    is_equal = len({len(getattr(message, name)) for name in names}) == 1
    return "" if is_equal else f"{', '.join(names)} differ in length"
