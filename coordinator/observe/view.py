"""What watchers see of a run at one moment: the one view that ``dsse watch`` prints and that a page shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from agents.protocol.quality import NONE

OVER_S = 2.0  # after which an incarnation that is not received is over; nobody tells a watcher the heartbeat


@dataclass(frozen=True, slots=True)
class Extreme:
    """A quantity and where it is found: a bus or a meter."""

    value: float
    at: str


@dataclass(frozen=True, slots=True)
class AreaView:
    """One area as a watcher sees it; everything but ``present`` is what it published ``age_s`` ago.

    ``lowest_vm``, ``highest_vm``: of its buses, p.u.; None without an estimate. ``worst_meter``: the one of the
    largest normalised residual; None where none is known.
    ``mismatch_vm_pu``, ``mismatch_va_deg``: the largest differences to a neighbour at a bus that both publish, None
    where there is none. ``neighbours``: those that it sends to. ``age_s``: None if it was never received.
    ``leave_reason``: what it said when it left, empty if it died. ``silent``: it has said nothing for longer than
    ``silent_after_s``, though its token may be there. ``said_quality``: what it said of its own state
    (docs/explanation/quality.md); ``quality``: the same, and stale once it is gone or silent. ``telemetry_age_s``,
    ``oldest_reading_s`` and ``ages_s`` (of each neighbour's information) have gone on counting since. ``split``: digest
    of the split that its file is of, made at ``split_time``, s since 1970; ``split_edited``: digest of what the file
    was edited to since, else empty. ``next_split``: digest of the split whose file lies ready beside it, else empty.
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
    rejected: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    split: str = ""
    split_time: float = 0.0
    split_edited: str = ""
    next_split: str = ""

    @property
    def state(self) -> str:
        """In a word."""
        if not self.present:
            return "left" if self.leave_reason else "gone"
        if self.age_s is None or self.silent:
            return "silent"
        if not self.estimated:
            return "waits for telemetry" if self.scan == 0 else "no estimate"
        return "estimates" if self.referenced else "relative angles"


@dataclass(frozen=True, slots=True)
class View:
    """A run at one moment. ``others``: plant, gateways, coordinators and watchers that are there, as ``role name``.

    ``duplicates``: in words, which area or plant runs more than once; one that has just been started again may, for 2
    s. ``other_versions``: in words, who speaks another wire version, of whom nothing else can be shown.
    ``strangers``: how many more are announced as areas: none of the scenario's where that is known, else those for
    whom there is no place. ``more_others``: how many there are beside ``others``.
    """

    run: str
    areas: tuple[AreaView, ...]
    others: tuple[str, ...]
    duplicates: tuple[str, ...] = ()
    other_versions: tuple[str, ...] = ()
    strangers: int = 0
    more_others: int = 0
