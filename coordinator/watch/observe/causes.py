"""Root causes of what is wrong in a run, each with what to do and with its effects: one function of a view.

A cause names who and where, since when, and the cure. What follows from it, such as a neighbour that is no longer
``good``, stands below it as its effect and is no cause of its own. ``WORDS`` has all sentences, and
docs/reference/causes.md the same table.
"""

from __future__ import annotations

import math
import re
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

from agents.protocol.quality import GOOD
from coordinator.watch.observe.notes import BAD_DATA, Noted
from coordinator.watch.observe.summary import Summary
from coordinator.watch.observe.view import OVER_S, AreaView, View
from dsse_core.grid.measurement import read_meter_id
from dsse_core.grid.nodes import ANY_PHASE
from dsse_core.printable import listed, printable, shortened

ALARM, WARNING = "alarm", "warning"
NODE = re.compile(rf"\b(\d{{1,15}})(\.(?:{ANY_PHASE})(?!\w))?")  # a bus, or a phase of it


class Words(NamedTuple):
    """Sentence and cure of a kind of cause, with its names in braces; ``mark``: a word or two for the map.

    ``severity``: ALARM where the grid is beyond a limit, or numbers of the present are missing or may be false; WARNING
    where states stay usable, or the fault is dealt with.
    """

    what: str
    action: str
    severity: str
    mark: str


WORDS = {
    "nobody": Words("no agent of an area is there", "start `dsse agent` for each area file", ALARM, ""),
    "router": Words(
        "no message of any area has been received",
        "start `dsse router` again, or look at the network to its host",
        ALARM,
        "not received",
    ),
    "gone": Words("the agent of {area} is gone", "start `dsse agent {area}.toml` again", ALARM, "agent gone"),
    "left": Words(
        "the agent of {area} has ended ({why})", "start `dsse agent {area}.toml` again", ALARM, "agent ended"
    ),
    "silent": Words(
        "the agent of {area} has sent nothing",
        "it hangs, or has no link: look at the log of `dsse agent {area}.toml`, and at the network of its host",
        ALARM,
        "silent",
    ),
    "contradiction": Words(
        "the agent of {area} rejects the messages of {other}: {why}",
        "correct {area}.toml or {other}.toml",
        ALARM,
        "rejection",
    ),
    "file": Words("the area file of {area} {fault}", "{cure}", ALARM, "wrong file"),
    "gateway": Words(
        "the source of the readings (process `{process}`) is gone", "start `dsse {role}` again", ALARM, "no readings"
    ),
    "map": Words(
        "all power readings of gateway {gateway} look wrong ({why})",
        "correct the map file of `dsse gateway`",
        ALARM,
        "wrong map",
    ),
    "telemetry": Words(
        "no readings have arrived in {areas}",
        "look at the processes that send them (`dsse plant`, `dsse gateway`), and at the network to them",
        ALARM,
        "no readings",
    ),
    "mismatch": Words(
        "the estimates of {area} and {other} disagree at bus {bus} by {difference}",
        "one of the two agents sends false values: look at both",
        ALARM,
        "bus {bus}: {difference} apart",
    ),
    "liar": Words(
        "the estimate of {area} disagrees with {others} at bus {bus} by {difference}",
        "the agent of {area} sends false values: look at it",
        ALARM,
        "bus {bus}: {difference} apart",
    ),
    "distrust": Words(
        "the agent of {area} does not believe {other}: {why}",
        "the agent of {other} sends false values, or passes them on",
        ALARM,
        "distrust",
    ),
    "not observable": Words(
        "no reading determines buses {buses}", "bring back the meters without a reading", ALARM, "not determined"
    ),
    "no estimate": Words(
        "{area} has no estimate: {why}", "look for a wrong meter or a wrong file", ALARM, "no estimate"
    ),
    "contradictory": Words(
        "the readings contradict each other", "look for a wrong meter or a wrong file{hint}", ALARM, "contradiction"
    ),
    "many removed": Words(
        "{count} meters of {area} are left out as wrong",
        "look at their gateway, and at {area}.toml",
        ALARM,
        "meters left out",
    ),
    "band": Words(
        "estimated voltages in {area} are impossible: outside {band}, {vm} p.u. at bus {bus}",
        "look for a wrong meter",
        ALARM,
        "{vm} p.u.",
    ),
    "loading": Words(
        "branch {branch} is at {percent} % of its rating{more}",
        "shed or transfer load behind it",
        ALARM,
        "{percent} %",
    ),
    "low voltage": Words(
        "bus {bus} is at {vm} p.u., below {limit} p.u.{more}", "raise the voltage, or shed load", ALARM, "{vm} p.u."
    ),
    "high voltage": Words(
        "bus {bus} is at {vm} p.u., above {limit} p.u.{more}", "lower the voltage", ALARM, "{vm} p.u."
    ),
    "unbalance": Words(
        "the unbalance of bus {bus} is {percent} %, above {limit} %{more}",
        "move loads to other phases",
        ALARM,
        "unbalance {percent} %",
    ),
    "version": Words("{fault}", "{cure}", WARNING, ""),
    "duplicate": Words("{fault}", "stop the older ones", WARNING, ""),
    "clock": Words(
        "the clock of {area} is {seconds} s {where}",
        "set the clock of its host",
        WARNING,
        "clock {seconds} s {where}",
    ),
    "clocks": Words(
        "the clocks of {area} and {other} differ by {seconds} s",
        "find out which of the two hosts is wrong, and set its clock",
        WARNING,
        "clocks differ",
    ),
    "link": Words(
        "no message has passed between the agents of {area} and {other}",
        "look at the network between their hosts",
        WARNING,
        "{area}, {other}: no messages",
    ),
    "one-way link": Words(
        "the agent of {area} has received no message of {other}",
        "look at the network between their hosts",
        WARNING,
        "{other} to {area}: no messages",
    ),
    "impostor": Words("another process sends in the name of {other}", "use keys", WARNING, "impostor"),
    "overdue": Words(
        "{share} % of the readings of {area} are overdue or missing", "look at their gateway", WARNING, "readings late"
    ),
    "mistimed": Words(
        "readings of {area} have an impossible time, as of {meter}",
        "set the clock of their gateway",
        WARNING,
        "wrong times",
    ),
    "unreadable": Words(
        "the agent of {area} cannot read what {other} sends ({why})",
        "look at the network, and at the version of both",
        WARNING,
        "unreadable",
    ),
    "wrong status": Words(
        "switch {switch} is not as its status says: the readings contradict it",
        "look at the switch, and correct its status (`dsse switch`)",
        WARNING,
        "{switch}: wrong status",
    ),
    "unknown status": Words(
        "the status of switch {switch} is unknown: {told}",
        "look at the switch, and at what reads it",
        WARNING,
        "{switch}: unknown status",
    ),
    "undecided": Words(
        "one of {meters} in {area} reads wrong", "check which; {meter} is left out", WARNING, "doubtful meter"
    ),
    "bad data": Words(
        "wrong readings of {meters} in {area} are left out",
        "check what is measured there; the estimate holds without it",
        WARNING,
        "wrong meter",
    ),
    "under way": Words("the estimate of {areas} is under way", "wait for its end", WARNING, ""),
    "quality": Words("{area} is {quality}: {why}", "look at the log of `dsse agent {area}.toml`", WARNING, "{quality}"),
}
"""Kind -> its words; of several causes the one of an earlier kind comes first, and alarms before warnings."""
CAUSE_KINDS = tuple(WORDS)
OF_GRID = ("loading", "low voltage", "high voltage", "unbalance")
"""Kinds that are states of the grid; all others are faults of the data on it."""
REMARKS = {
    "grid": "The grid itself is beyond a limit.",
    "data": "The grid itself may be sound: the fault is in the data on it.",
}
OF_STATUS = ("wrong status", "unknown status")
"""Kinds that are about a switch, their one branch."""
SEEN = {"grid": ", seen since", "data": " since"}  # the grid may have been beyond a limit before anybody has looked
HARMLESS = (*OF_GRID, "undecided", "bad data", "unreadable", "impostor")
"""Kinds that leave the quality of states as it is: no state is worse because of them."""
EXPLAINED = {
    "telemetry": {"gateway"},
    "overdue": {"gateway", "telemetry"},
    "not observable": {"gateway", "telemetry", "overdue"},
    "contradictory": {"map", "file", "mismatch", "liar", "many removed"},
    "no estimate": {"file", "contradictory"},
    "mistimed": {"clock", "clocks"},
    "band": {"map", "file", "mismatch", "liar"},
    "contradiction": {"file"},
    "undecided": {"map", "many removed"},
    "bad data": {"map", "many removed"},
}
"""Kind of an effect -> the kinds of its possible causes."""
OF_ENDS = ("mismatch", "liar")
"""Kinds that are known at the end of an estimate only."""
ITSELF = ("router", "gone", "left", "silent", "under way", "quality")
"""Kinds whose areas are the cause itself, and not an effect."""
MOST_CAUSES, MOST_EFFECTS, MOST_NAMED, MOST_DESCRIBED = 8, 12, 4, 2
LONGEST_PART = 200  # characters of a text from a note
DISAGREES = 1e-6  # p.u. and rad, between final voltages of the same scan
EPOCH_S = 1e8  # times below count from the begin of a run
GATEWAYS = ("plant", "gateway")  # roles of the senders of readings
FILE_CURE = "replace {}.toml by that of the newest `dsse split`"


@dataclass(frozen=True, slots=True)
class Cause:
    """A root cause: ``what`` is wrong, as a sentence without its end, and the ``action`` that cures it.

    ``severity``: ALARM or WARNING. ``mark``: a word or two at its place on a map.
    ``since``: s since 1970, in a playback from its begin; None where it is not known. ``areas``, ``buses``,
    ``branches``, ``meters``: where. ``effects``: on areas, a sentence for each quality.
    """

    kind: str
    what: str
    action: str
    severity: str
    mark: str = ""
    since: float | None = None
    areas: tuple[str, ...] = ()
    buses: tuple[int, ...] = ()
    branches: tuple[str, ...] = ()
    meters: tuple[str, ...] = ()
    effects: tuple[str, ...] = ()

    def __str__(self) -> str:
        since = "" if self.since is None else f"{SEEN[self.scope]} {write_time(self.since)}"
        return f"{self.what}{since}: {self.action}"

    @property
    def scope(self) -> str:
        """``grid`` for a state of the grid, ``data`` for a fault of the data on it."""
        return "grid" if self.kind in OF_GRID else "data"

    @property
    def remark(self) -> str:
        """The scope as a sentence."""
        return REMARKS[self.scope]


def write_lines(causes: Iterable[Cause]) -> Iterator[tuple[Cause, list[str]]]:
    """Each cause with its lines: itself, its remark unless the one before has the same, and its effects."""
    said = ""
    for cause in causes:
        remark = [f"  {cause.remark}"] if cause.remark != said else []
        yield cause, [str(cause), *remark, *([f"  effects: {', '.join(cause.effects)}"] if cause.effects else [])]
        said = cause.remark


class Onsets:
    """Memory of several looks, one after the other: since when the grid is beyond a limit, and disagreements of final
    voltages, which hold while the next estimate is under way."""

    def __init__(self) -> None:
        self._since: dict[str, float] = {}
        self._at = -math.inf
        self._ended: tuple[Cause, ...] = ()  # causes of the last estimate that has come to its end

    def date(self, causes: Sequence[Cause], at: float) -> tuple[Cause, ...]:
        """``causes`` of the look at ``at``, those of the grid with the time of the first look that has found them."""
        found = {cause.kind for cause in causes}
        if "under way" in found and at >= self._at:
            causes = [*self._ended, *(c for c in causes if c.kind != "under way" or not self._ended)]
            causes.sort(key=lambda cause: CAUSE_KINDS.index(cause.kind))
        else:
            self._ended = tuple(cause for cause in causes if cause.kind in OF_ENDS)
        before = self._since if at >= self._at else {}  # a playback goes back
        self._since = {cause.kind: before.get(cause.kind, at) for cause in causes if cause.scope == "grid"}
        self._at = at
        return tuple(replace(cause, since=self._since.get(cause.kind, cause.since)) for cause in causes)


def write_time(at: float) -> str:
    """Time of day here; of a time from the begin of a run, the seconds."""
    return time.strftime("%H:%M:%S", time.localtime(at)) if at >= EPOCH_S else f"{at:.1f} s"


def find_causes(
    view: View, at: float, summary: Summary | None = None, *, with_magnitudes: bool = False
) -> tuple[Cause, ...]:
    """The root causes of what is wrong in ``view``, the first one first; empty where nothing is.

    ``at``: time of the view, s since 1970 or from the begin of a playback. ``summary``: of its grid.
    ``with_magnitudes``: True where the strategy is known to reconcile voltage magnitudes: those of good states agree.
    """
    found = _Findings(view, at - view.now, with_magnitudes)
    roots = [*found.find(), *(found.find_violations(summary) if summary else ())]
    kinds = {cause.kind for cause in roots}
    roots = [cause for cause in roots if not EXPLAINED.get(cause.kind, set()) & kinds]
    if all(cause.kind in HARMLESS for cause in roots):
        roots += found.find_rest()
    roots.sort(key=lambda cause: CAUSE_KINDS.index(cause.kind))
    return tuple(_add_effects(view, roots[:MOST_CAUSES]))


@dataclass(frozen=True)
class _Findings:
    """Causes in ``view``; ``offset``: of the time shown to that of the watcher's clock, s."""

    view: View
    offset: float
    with_magnitudes: bool

    @cached_property
    def areas(self) -> dict[str, AreaView]:
        return {area.name: area for area in self.view.areas}

    @cached_property
    def there(self) -> dict[str, AreaView]:
        """The areas that publish now; what the others have said last no longer counts."""
        return {a.name: a for a in self.view.areas if a.present and not a.silent and a.age_s is not None}

    def make(self, kind: str, words: Mapping[str, object], since: float | None, **where: Any) -> Cause:
        """The cause of ``kind`` with its words filled in; ``since``: on the watcher's clock. ``where``: its places."""
        shown = {name: shortened(printable(str(word)), LONGEST_PART) for name, word in words.items()}
        what, action, severity, mark = (words.format_map(shown) for words in WORDS[kind])
        where["areas"] = tuple(name for name in where.get("areas", ()) if name in self.areas)
        return Cause(kind, what, action, severity, mark, None if since is None else since + self.offset, **where)

    def find(self) -> Iterator[Cause]:
        """All causes but those of ``find_rest``, effects among them."""
        yield from self.find_missing()
        for sentence in self.view.other_versions:
            fault, _, cure = sentence.rpartition(": ")
            yield self.make("version", {"fault": fault, "cure": cure}, None)
        for sentence in self.view.duplicates:
            yield self.make("duplicate", {"fault": sentence.partition(": ")[0]}, None)
        yield from self.find_files()
        yield from self.find_clocks()
        yield from self.find_telemetry()
        yield from self.find_links()
        yield from self.find_disagreements()
        yield from self.find_readings()

    @cached_property
    def unreachable(self) -> tuple[AreaView, ...]:
        """The areas to which the way is lost: none is there, and none has said why, or this watcher has no link.

        A gateway that is there, or was after the last sign of the areas, proves that there is a way.
        """
        silent = [area for area in self.view.areas if area.present and area.silent]
        gone = [area for area in self.view.areas if not area.present and not area.leave_reason]
        lost = [area for area in (*silent, *gone) if area.age_s is not None]
        last = max((self.view.now - area.age_s for area in lost if area.age_s is not None), default=math.inf)
        later = [other for other, since in self.view.gone.items() if since is not None and since > last + OVER_S]
        has_others = any(other.partition(" ")[0] in GATEWAYS for other in (*self.view.others, *later))
        is_seen = len(silent) > 1 or (len(lost) > 1 and not silent and not has_others)
        return tuple(lost) if not self.view.is_linked or (is_seen and not self.there) else ()

    @cached_property
    def lost_at(self) -> float:
        """Time of the last sign of ``unreachable`` areas; infinite without any. What vanished then says no more."""
        return max(
            (self.view.now - area.age_s for area in self.unreachable if area.age_s is not None), default=math.inf
        )

    def find_missing(self) -> Iterator[Cause]:
        """Areas that are not there; of all at once the way to them."""
        areas = self.view.areas
        if self.unreachable or not self.view.is_linked:
            names = [a.name for a in self.unreachable if a.present or not _is_before(a.vanished, self.lost_at)]
            yield self.make("router", {}, self.lost_at if names else None, areas=names)
        elif not areas:
            yield self.make("nobody", {}, None)
        for area in areas:
            since = self._gone_since(area)
            if not area.present and (area not in self.unreachable or _is_before(since, self.lost_at)):
                kind, words = "left" if area.leave_reason else "gone", {"area": area.name, "why": area.leave_reason}
                yield self.make(kind, words, since, areas=(area.name,), buses=self._buses_of(area))
            elif area.present and area.silent and area not in self.unreachable:
                since = None if area.age_s is None else self.view.now - area.age_s
                yield self.make("silent", {"area": area.name}, since, areas=(area.name,), buses=self._buses_of(area))

    def _gone_since(self, area: AreaView) -> float | None:
        if area.vanished is not None:
            return area.vanished
        ages = [area.age_s] if area.age_s is not None else [a.ages_s[area.name] for a in self._hearing(area.name)]
        return self.view.now - min(ages) if ages else None

    def _hearing(self, name: str) -> list[AreaView]:
        return [area for area in self.there.values() if name in area.ages_s]

    def _buses_of(self, area: AreaView) -> tuple[int, ...]:
        """The boundary buses of an area."""
        met = [area.meetings.values(), *([a.meetings[area.name]] for a in self.view.areas if area.name in a.meetings)]
        return tuple(sorted({bus for meetings in met for meeting in meetings for bus in meeting.buses}))

    def noted(self, *kinds: str) -> list[tuple[AreaView, Noted]]:
        """The notes of ``kinds`` of the areas that are there, each with its area."""
        return [(area, noted) for area in self.there.values() for noted in area.noted if noted.kind in kinds]

    def find_files(self) -> Iterator[Cause]:
        for area, noted in self.noted("contradiction"):
            why, _, _ = noted.parts["why"].partition("; ")
            words = {"area": area.name, "other": noted.parts["other"], "why": why}
            yield self.make("contradiction", words, noted.since, areas=(area.name, noted.parts["other"]))
        faults: dict[str, Noted] = {}
        for area, noted in self.noted("file"):
            name = area.name if noted.parts["other"] == "this area" else noted.parts["other"]
            faults[name] = min(faults.get(name, noted), noted, key=lambda n: math.inf if n.since is None else n.since)
        for name, noted in faults.items():
            cure = {"cure": FILE_CURE.format(name)} if name in self.areas else {}
            yield self.make("file", {"area": name, **noted.parts, **cure}, noted.since, areas=(name,))

    def find_clocks(self) -> Iterator[Cause]:
        """Clocks that are off: the one that disagrees with most, as long as any disagree; of two alone, both."""
        ahead: dict[frozenset[str], tuple[str, float, Noted]] = {}  # pair -> the one said ahead, by how much
        for area, noted in self.noted("future", "clock"):
            other, seconds = noted.parts["other"], _number(noted.parts["seconds"])
            first = area.name if noted.parts.get("where") == "behind" else other
            ahead.setdefault(frozenset((area.name, other)), (first, seconds, noted))
        trusted = Counter(
            name
            for area in self.there.values()
            for other in area.clock_skews_s
            if frozenset((area.name, other)) not in ahead
            for name in (area.name, other)
        )
        while ahead:
            named = Counter(name for pair in ahead for name in pair)
            doubt = {name: (count, -trusted[name]) for name, count in named.items()}
            wrong = max(sorted(doubt), key=doubt.__getitem__)
            of_wrong = {pair: said for pair, said in ahead.items() if wrong in pair}
            pair, (first, seconds, noted) = next(iter(of_wrong.items()))
            (other,) = pair - {wrong} or {wrong}
            if doubt[other] == doubt[wrong]:
                words: dict[str, object] = {"area": min(pair), "other": max(pair), "seconds": f"{seconds:.4g}"}
                yield self.make("clocks", words, noted.since, areas=sorted(pair))
            else:
                words = {"area": wrong, "seconds": f"{seconds:.4g}", "where": "ahead" if first == wrong else "behind"}
                yield self.make("clock", words, noted.since, areas=[wrong])
            ahead = {pair: said for pair, said in ahead.items() if pair not in of_wrong}

    def find_telemetry(self) -> Iterator[Cause]:
        lacking = {area.name: noted for area, noted in self.noted("telemetry")}
        for other, since in self.view.gone.items():
            role, _, name = other.partition(" ")
            if self.unreachable and not _is_before(since, self.lost_at):
                continue
            words = {"process": name if role == name else other, "role": role}
            yield self.make("gateway", words, since, areas=(*lacking,))
        off = {area.name for area, noted in self.noted("future") if noted.parts["other"] == "telemetry"}
        if lacking := {name: noted for name, noted in lacking.items() if name not in off}:
            is_first = any("never" in noted.parts for noted in lacking.values())
            since = None if is_first else self.view.now - min(self.areas[name].telemetry_age_s for name in lacking)
            yield self.make("telemetry", {"areas": listed([*lacking], MOST_NAMED)}, since, areas=(*lacking,))
        for gateway, (area, noted) in {n.parts["other"]: (a, n) for a, n in self.noted("map")}.items():
            words = {"gateway": gateway, "why": noted.parts["why"]}
            yield self.make("map", words, noted.since, areas=(area.name,))

    def find_links(self) -> Iterator[Cause]:
        """Links between areas that are there, and of which neither rejects or excludes the other."""
        barred = {
            frozenset((area.name, noted.parts["other"]))
            for area, noted in self.noted("contradiction", "future", "distrust", "unreadable", "impostor")
        }
        pairs = {frozenset((name, other)) for name, area in self.there.items() for other in area.neighbours}
        for pair in sorted(pairs - barred, key=sorted):
            if len(pair) != 2 or not pair <= self.there.keys():
                continue
            one, two = (self.there[name] for name in sorted(pair))
            deaf = [(a, b) for a, b in ((one, two), (two, one)) if not _hears(a, b.name)]
            if not deaf or not all(area.estimated for area, _ in deaf):
                continue
            (area, other), kind = deaf[0], "link" if len(deaf) == 2 else "one-way link"
            ages = [a.ages_s[b.name] for a, b in deaf if b.name in a.ages_s]
            buses = next((a.meetings[b.name].buses for a, b in deaf if b.name in a.meetings), ())
            words, names = {"area": area.name, "other": other.name}, tuple(sorted(pair))
            yield self.make(kind, words, self.view.now - min(ages) if ages else None, areas=names, buses=buses)

    def find_disagreements(self) -> Iterator[Cause]:
        for area, noted in self.noted("distrust", "false count"):
            words: dict[str, object] = {"area": area.name, "other": noted.parts["other"], "why": noted.parts["why"]}
            yield self.make("distrust", words, noted.since, areas=(area.name, noted.parts["other"]))
        pairs: dict[frozenset[str], _Difference] = {}
        for area, noted in self.noted("mismatch"):
            at, pair = _find_first(noted.parts["buses"]), frozenset((area.name, noted.parts["other"]))
            said = _Difference(at, _number(noted.parts["vm"]), math.radians(_number(noted.parts["va"])), noted.since)
            pairs[pair] = max(pairs.get(pair, said), said, key=lambda difference: difference.size)
        for area in self.there.values():
            for other, met in area.meetings.items():
                is_sure = other in self.there and area.said_quality == self.there[other].said_quality == GOOD
                seen = _Difference(met.at, (self.with_magnitudes and met.vm) or 0.0, met.va or 0.0, None)
                if is_sure and seen.size > DISAGREES:
                    pairs.setdefault(frozenset((area.name, other)), seen)
        named = Counter(name for pair in pairs for name in pair)
        liars = [name for name, count in named.items() if count > 1]
        for liar in liars:
            if mine := {pair: difference for pair, difference in pairs.items() if liar in pair}:
                others = sorted({name for pair in mine for name in pair} - {liar})
                worst = max(mine.values(), key=lambda difference: difference.size)
                words = {
                    "area": liar,
                    "others": listed(others, MOST_NAMED),
                    "bus": worst.at,
                    "difference": worst.words,
                }
                buses = tuple(sorted({difference.bus for difference in mine.values()}))
                yield self.make("liar", words, worst.since, areas=(liar, *others), buses=buses)
                pairs = {pair: difference for pair, difference in pairs.items() if liar not in pair}
        for pair, worst in pairs.items():
            names = tuple(sorted(pair))
            words = {"area": names[0], "other": names[-1], "bus": worst.at, "difference": worst.words}
            yield self.make("mismatch", words, worst.since, areas=names, buses=(worst.bus,))

    def find_readings(self) -> Iterator[Cause]:
        """Causes in the readings; one that all areas state is one cause."""
        seen = set[tuple[str, ...]]()
        for area, noted in self.noted(
            "impostor", "not observable", "no estimate", "contradictory", "many removed", "overdue", "mistimed", "band",
            "unreadable", "undecided", "wrong status", "unknown status",
        ):  # fmt: skip
            is_shared = noted.kind in ("not observable", "contradictory", "impostor", "wrong status")
            about = (noted.kind, *(noted.parts.get(name, "") for name in ("other", "switch")))
            about = about if is_shared else (*about, area.name)
            if about in seen:
                continue
            seen.add(about)
            parts = {"area": area.name, **noted.parts}
            named = NODE.findall(noted.parts.get("buses", ""))[:MOST_EFFECTS]
            buses = tuple(dict.fromkeys(int(bus) for bus, _ in named))
            meters = [noted.parts[name] for name in ("meter",) if name in noted.parts]
            parts["bus"], parts["hint"] = (
                "".join(next(iter(named), ())),
                "".join(f"; {name} stands out" for name in meters),
            )
            if noted.kind == "undecided":
                meters += noted.parts["others"].split(", ")
                parts["meters"] = _describe_meters(meters)
            areas = (area.name,) if noted.kind not in ("contradictory", "wrong status") else ()
            places = _find_places(meters, buses)
            places["branches"] += tuple(noted.parts[name] for name in ("switch",) if name in noted.parts)
            yield self.make(noted.kind, parts, noted.since, areas=areas, **places)
        for area in self.there.values():
            doubted = {noted.parts["meter"] for noted in area.noted if noted.kind == "undecided"}
            removed = [n for n in area.noted if n.kind == BAD_DATA and n.parts["meter"] not in doubted]
            if removed:
                meters = [noted.parts["meter"] for noted in removed]
                words = {"meters": _describe_meters(meters), "area": area.name}
                known = [noted.since for noted in removed if noted.since is not None]
                since = min(known) if len(known) == len(removed) else None
                yield self.make(BAD_DATA, words, since, areas=(area.name,), **_find_places(meters))

    def find_violations(self, summary: Summary) -> Iterator[Cause]:
        """The branch and the buses farthest beyond their limits."""
        loading, voltage, unbalance, limits = summary.loading, summary.voltage, summary.unbalance, summary.limits
        for worst in loading.worst[:1]:
            words = {"branch": worst.at, "percent": f"{worst.value:.1f}", "more": _and_more(loading.outside)}
            labels = [found.at for found in loading.worst]
            branches = [label.rpartition(".")[0] for label in labels] if summary.has_phases else labels
            yield self.make("loading", words, None, branches=tuple(dict.fromkeys(branches)))
        for worst in voltage.worst[:1]:
            is_low = worst.value < limits.lowest_vm
            limit, kind = (limits.lowest_vm, "low voltage") if is_low else (limits.highest_vm, "high voltage")
            words = {
                "bus": worst.at,
                "vm": f"{worst.value:.4f}",
                "limit": f"{limit:g}",
                "more": _and_more(voltage.outside),
            }
            yield self.make(
                kind,
                words,
                None,
                buses=tuple(dict.fromkeys(int(found.at.partition(".")[0]) for found in voltage.worst)),
            )
        for worst in unbalance.worst[:1]:
            words = {"bus": worst.at, "percent": f"{worst.value:.2f}", "limit": f"{limits.most_unbalance_percent:g}"}
            words["more"] = _and_more(unbalance.outside)
            yield self.make("unbalance", words, None, buses=tuple(int(found.at) for found in unbalance.worst))

    def find_rest(self) -> Iterator[Cause]:
        """The worst state that is not good, where no cause is known; work under way comes to its end by itself."""
        poor = [area for area in self.there.values() if area.quality != GOOD]
        under_way = [area for area in poor if any(noted.kind == "under way" for noted in area.noted)]
        under_way += [area for area in self.view.areas if area.present and area.age_s is None]
        if under_way:
            names = [area.name for area in under_way]
            yield self.make("under way", {"areas": listed(names, MOST_NAMED)}, None, areas=names)
        elif poor:
            area = min(poor, key=lambda area: _is_passed_on(area.notes))
            words = {"area": area.name, "quality": area.quality, "why": next(iter(area.notes), "no reason is stated")}
            yield self.make("quality", words, None, areas=(area.name,))


class _Difference(NamedTuple):
    """The difference of two areas at a bus or node, such as 671.a, p.u. and rad."""

    at: str
    vm: float
    va: float
    since: float | None

    @property
    def bus(self) -> int:
        return int(self.at.partition(".")[0])

    @property
    def size(self) -> float:
        return max(self.vm, self.va)

    @property
    def words(self) -> str:
        return f"{self.vm:.3g} p.u." if self.vm >= self.va else f"{math.degrees(self.va):.3g} deg"


def _and_more(outside: int) -> str:
    return f" (and {outside - 1} more)" if outside > 1 else ""


def _is_before(since: float | None, lost_at: float) -> bool:
    """True where a process was gone already when the way to all was lost."""
    return since is not None and since < lost_at - OVER_S


def _hears(area: AreaView, other: str) -> bool:
    return other in area.ages_s and area.ages_s[other] < area.silent_after_s


def _is_passed_on(notes: Iterable[str]) -> bool:
    """True where all that an area says is what its neighbours say."""
    return all(note.startswith("behind ") for note in notes)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return 0.0


def _find_first(text: str) -> str:
    """The first bus or node in ``text``, 0 where it has none."""
    found = NODE.search(text)
    return found[0] if found else "0"


def _describe_meters(meters: Sequence[str]) -> str:
    """Meters in words, with their ids; where there are many, the ids alone."""
    found = [_describe_meter(meter) for meter in meters]
    return " and ".join(found) if len(found) <= MOST_DESCRIBED else f"the meters {listed([*meters], MOST_NAMED)}"


def _describe_meter(meter: str) -> str:
    if (read := read_meter_id(meter)) is None:
        return f"the meter {meter}"
    branch = f" of branch {read.branch}" if read.branch else ""
    return f"the {read.kind.quantity.instrument}{branch} at bus {read.at} ({meter})"


def _find_places(meters: Iterable[str], buses: Iterable[int] = ()) -> dict[str, Any]:
    """``meters``, and the buses and branches where they are, by the form of their ids."""
    ids = tuple(meters)
    found = [meter for text in ids if (meter := read_meter_id(text))]
    at = {meter.bus for meter in found if not meter.branch}
    branches = tuple(sorted({meter.branch for meter in found if meter.branch}))
    return {"meters": ids, "buses": tuple(sorted({*buses, *at})), "branches": branches}


def _add_effects(view: View, causes: list[Cause]) -> Iterator[Cause]:
    """The causes, each with the areas whose quality it has lowered: of several causes the nearest, else the first."""
    links = _find_links(view)
    hops = {k: _count_hops(links, cause.areas) for k, cause in enumerate(causes) if cause.kind not in HARMLESS}
    effects: list[dict[str, list[str]]] = [{} for _ in causes]  # of each cause, quality -> areas
    for area in view.areas:
        if hops and area.quality != GOOD:
            nearest = min(hops, key=lambda k: hops[k].get(area.name, math.inf if causes[k].areas else 0))
            if not (causes[nearest].kind in ITSELF and area.name in causes[nearest].areas):
                effects[nearest].setdefault(area.quality, []).append(printable(area.name))
    for cause, of in zip(causes, effects, strict=True):
        said = [f"{listed(names, MOST_EFFECTS)} {_is(names)} {printable(quality)}" for quality, names in of.items()]
        yield replace(cause, effects=tuple(said))


def _is(names: Sequence[str]) -> str:
    return "is" if len(names) == 1 else "are"


def _find_links(view: View) -> dict[str, set[str]]:
    links: dict[str, set[str]] = {}
    for area in view.areas:
        for other in area.neighbours:
            links.setdefault(area.name, set()).add(other)
            links.setdefault(other, set()).add(area.name)
    return links


def _count_hops(links: Mapping[str, Collection[str]], start: Iterable[str]) -> dict[str, int]:
    """Area -> number of links between it and the nearest area of ``start``."""
    hops = dict.fromkeys(start, 0)
    reached = list(hops)
    for name in reached:  # which grows
        for other in links.get(name, ()):
            if other not in hops:
                hops[other] = hops[name] + 1
                reached.append(other)
    return hops
