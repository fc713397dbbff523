"""A watcher's view of a run at one moment, which ``dsse watch`` prints and a page shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from agents.protocol.quality import NONE
from coordinator.watch.observe.freshness import find_freshness
from coordinator.watch.observe.notes import Noted
from dsse_core.results.table import Freshness

OVER_S = 2.0  # an incarnation silent for so long is over; a watcher does not know the heartbeat


@dataclass(frozen=True, slots=True)
class Extreme:
    """A quantity and the bus or meter that has it."""

    value: float
    at: str


@dataclass(frozen=True, slots=True)
class Meeting:
    """The ``buses`` that two areas publish, and the largest differences of their voltages there, p.u. and rad.

    ``vm``: None where the states are of different scans. ``va``: None unless the angles of both count from the
    substation. ``at``: the bus, or node such as 671.a, of the larger of the two.
    """

    buses: tuple[int, ...]
    at: str
    vm: float | None = None
    va: float | None = None


@dataclass(frozen=True, slots=True)
class AreaView:
    """One area as a watcher sees it, from the state that the area published ``age_s`` ago and its presence token.

    ``lowest_vm``, ``highest_vm``: of its buses, p.u.; None without an estimate. ``worst_meter``: the one of the
    largest normalised residual; None where none is known.
    ``mismatch_vm_pu``, ``mismatch_va_deg``: the largest differences to a neighbour at a bus that both publish for the
    same scan, of angles that count from the substation; None where there is none. ``neighbours``: those that it sends
    to. ``age_s``: None if no state was received.
    ``leave_reason``: of its leave message, empty if it died. ``silent``: no state for longer than ``silent_after_s``,
    even if its token is present. ``said_quality``: the quality that it published (docs/explanation/quality.md);
    ``quality``: the same, but stale once it is gone or silent. ``telemetry_age_s``, ``oldest_reading_s`` and ``ages_s``
    (of each neighbour's information) include the time since the state arrived. ``split``: digest of the split of its
    area file, made at ``split_time``, s since 1970; ``split_edited``: digest of the file as edited since, else empty.
    ``next_split``: digest of the split of the file that lies ready beside it, else empty.
    ``meetings``: of each neighbour with a common bus. ``noted``: its notes and removed meters, read.
    ``vanished``: time at which its token vanished, on the watcher's clock, s; None where that is not known.
    """

    name: str
    present: bool
    age_s: float | None
    leave_reason: str = ""
    scan: int = 0
    quality: str = NONE
    said_quality: str = NONE
    silent: bool = False
    silent_after_s: float = OVER_S
    lowest_vm: Extreme | None = None
    highest_vm: Extreme | None = None
    worst_meter: Extreme | None = None
    telemetry_age_s: float = 0.0
    oldest_reading_s: float = 0.0
    ages_s: Mapping[str, float] = field(default_factory=dict)
    clock_skews_s: Mapping[str, float] = field(default_factory=dict)
    estimated: bool = False
    referenced: bool = False
    checked: bool = False
    objective: float = 0.0
    degrees_of_freedom: int = 0
    neighbours: tuple[str, ...] = ()
    mismatch_vm_pu: float | None = None
    mismatch_va_deg: float | None = None
    exchanges: int = 0
    messages: int = 0
    bytes: int = 0
    lost: int = 0
    removed: tuple[str, ...] = ()
    critical: tuple[str, ...] = ()
    meters_off: tuple[str, ...] = ()
    switches: Mapping[str, str] = field(default_factory=dict)
    rejected: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    split: str = ""
    split_time: float = 0.0
    split_edited: str = ""
    next_split: str = ""
    meetings: Mapping[str, Meeting] = field(default_factory=dict)
    noted: tuple[Noted, ...] = ()
    vanished: float | None = None

    @property
    def freshness(self) -> Freshness:
        """Quality and age of all numbers of the area."""
        return find_freshness(self.quality, self.telemetry_age_s, has_estimate=self.estimated)

    @property
    def state(self) -> str:
        """Presence and estimate of the area in a few words."""
        if not self.present:
            return "left" if self.leave_reason else "gone"
        if self.age_s is None or self.silent:
            return "silent"
        if not self.estimated:
            return "waits for telemetry" if self.scan == 0 else "no estimate"
        return "estimates" if self.referenced else "relative angles"


@dataclass(frozen=True, slots=True)
class View:
    """A run at one moment. ``others``: present plant, gateways, coordinators and watchers, as ``role name``.

    ``duplicates``: in words, areas, plants and gateways that run more than once; a restarted process may appear here
    for 2 s. ``other_versions``: in words, the processes of other wire versions, of which only names are known.
    ``strangers``: number of further processes announced as areas: those outside the scenario where it is known, else
    those beyond the limit. ``more_others``: number of processes beyond ``others``. ``now``: time of the view, s;
    ``gone``: plants and gateways that were there, as ``role name``, with the time at which each vanished; both on the
    watcher's clock. ``is_linked``: False where the watcher itself has no link to the bus.
    """

    run: str
    areas: tuple[AreaView, ...]
    others: tuple[str, ...]
    duplicates: tuple[str, ...] = ()
    other_versions: tuple[str, ...] = ()
    strangers: int = 0
    more_others: int = 0
    now: float = 0.0
    is_linked: bool = True
    gone: Mapping[str, float | None] = field(default_factory=dict)

    @property
    def freshness(self) -> dict[str, Freshness]:
        """Area -> quality and age of all its numbers."""
        return {area.name: area.freshness for area in self.areas}
