"""Notes of states, read: the kind of each sentence that agents write, and the names and figures in it.

Agents write notes for people (``agents/protocol/quality.py``, ``agents/protocol/rounds/state.py``); a note of another
form than those below is none of a cause. Names in notes are foreign text.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

BAD_DATA = "bad data"  # kind of a removed meter, which has a field of the state and no note
PATTERNS = {
    "mismatch": r"boundary mismatch with (?P<other>\S+) at bus (?P<buses>[^:]+): its final voltage differs by "
    r"(?P<vm>\S+) p\.u\. and (?P<va>\S+) deg; .*",
    "distrust": r"(?P<other>\S+) is not believed: (?P<why>.*)",
    "false count": r"(?P<why>\d+ of \d+ areas are counted): (?P<other>\S+)(?: or \S+)* says false things.*",
    "clock": r"the clock of (?P<other>\S+) is (?P<seconds>\S+) s (?P<where>ahead of|behind) that of this area; .*",
    "future": r"(?P<other>\S+) is rejected, from (?P<seconds>\d+) s in the future: .*",
    "contradiction": r"(?P<other>\S+) is rejected: (?P<why>.*)",
    "file": r"(?:the file of )?(?P<other>this area|\S+) (?P<fault>is older|is of another split|was edited after its "
    r"split|states no split|reads the meters of another split),? \(?(?P<detail>.*?)\)?: (?P<cure>[^:]*)",
    "map": r"all power readings of gateway (?P<other>\S+) look wrong, (?P<why>[^:]*): .*",
    "telemetry": r"telemetry is (?:not|no longer) received|all readings of this area are overdue or missing|"
    r"no readings of this scan; .*|(?P<never>no telemetry yet)",
    "overdue": r"(?P<share>\S+) % of the readings of this area are overdue or missing, .*",
    "mistimed": r"(?:time in the future|measured long before its scan): the newest reading of (?P<meter>\S+).*",
    "not observable": r"not observable: no reading of this scan determines buses (?P<buses>[^;]*).*",
    "no estimate": r"no estimate: (?P<why>.*)",
    "contradictory": r"(?:readings contradict each other|the iteration has not converged|bad data are looked for no "
    r"longer) \(.*\)(?:; (?P<meter>\S+) stands out)?.*",
    "wrong status": r"switch@(?P<switch>\S+) counts the other way, .*",
    "unknown status": r"status of switch (?P<switch>\S+) unknown: (?P<told>.*); it stays as it was",
    "undecided": r"(?P<meter>\S+) is removed, and the readings do not tell it from (?P<others>.*): check .*",
    "many removed": r"(?P<count>\d+ of \d+) meters are removed, more than .*",
    "band": r"voltages of \d+ (?:buses|nodes) are outside (?P<band>.*), the farthest is (?P<vm>\S+) "
    r"p\.u\. at bus (?P<buses>\S+)",
    "impostor": r"messages of (?P<other>\S+) are rejected: one announced scan .*",
    "unreadable": r"payloads of (?P<other>\S+) are rejected, (?P<why>.*)",
    "under way": r"the first estimate is under way|a newer estimate, of scan \d+, is under way|.* wait for the next "
    r"term|the iteration is under way|newer readings have not been worked in|\S+ has not come to the end of this term",
}
_FORMS = [(kind, re.compile(pattern, re.DOTALL)) for kind, pattern in PATTERNS.items()]


@dataclass(frozen=True, slots=True)
class Noted:
    """A note: its kind, a key of ``PATTERNS`` or ``BAD_DATA``, and its parts by their names there."""

    kind: str
    parts: Mapping[str, str] = field(default_factory=dict)
    since: float | None = None
    """Time of the first state that says so, on the watcher's clock, s; None where an earlier one is not known."""

    @property
    def about(self) -> tuple[str, ...]:
        """The kind and the names, which stay while figures change."""
        return (self.kind, *(self.parts.get(name, "") for name in ("other", "meter", "fault", "switch")))


def read_notes(
    notes: Iterable[str], removed: Iterable[str], before: Iterable[Noted] | None, now: float
) -> tuple[Noted, ...]:
    """The notes and removed meters of a state that arrives at ``now``, s; ``before``: those of the state before it."""
    since = {noted.about: noted.since for noted in before or ()}
    first = None if before is None else now
    found = [*_read(notes), *(Noted(BAD_DATA, {"meter": meter}) for meter in removed)]
    return tuple(replace(noted, since=since.get(noted.about, first)) for noted in found)


def _read(notes: Iterable[str]) -> Iterator[Noted]:
    for note in notes:
        for kind, form in _FORMS:
            if found := form.fullmatch(note):
                yield Noted(kind, {name: part for name, part in found.groupdict().items() if part is not None})
                break
