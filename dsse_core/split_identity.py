"""The identity of a split: from which network, cuts, meters and rules the areas' files were made, and when.

Areas estimate together, each from its own file. The estimate is right only if all files are of one split and no file
has been edited since.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime

from dsse_core.reading_rules import LEADER

DIGITS = 16  # of a digest
SHOWN = 8  # of its digits, in sentences
END_OF_TIME = 253_402_300_800.0  # s since 1970, the year 10000: later times have no date


@dataclass(frozen=True, slots=True)
class SplitIdentity:
    """The split that one file is of. Two splits of one content are the same, whenever they were made.

    ``digest``: of all that the areas' joint estimate rests on, 16 hex digits; empty where it is not known.
    ``time``: of the split, s since 1970 UTC; 0 where it is not known.
    ``edited``: digest of the file's own content where that was edited after the split, 16 hex digits; else empty.
    """

    digest: str = ""
    time: float = field(default=0.0, compare=False)
    edited: str = ""

    def __str__(self) -> str:
        if not self.digest:
            return "no split"
        when = f" of {datetime.fromtimestamp(self.time, UTC):%Y-%m-%d %H:%MZ}" if 0 < self.time < END_OF_TIME else ""
        return f"split {self.digest[:SHOWN]}{when}{f', edited to {self.edited[:SHOWN]}' if self.edited else ''}"

    @property
    def is_sound(self) -> bool:
        """True where the split is known and the file is as it has written it."""
        return bool(self.digest) and not self.edited

    def is_newer_than(self, other: SplitIdentity) -> bool:
        """True where this file is of a later split, or of one of the same time and, unlike ``other``, not edited."""
        return self.age_order[:2] > other.age_order[:2]

    @property
    def age_order(self) -> tuple[float, bool, str, str]:
        """Sort key of files from the oldest to the newest; an edited file counts as older than its split's own."""
        return self.time, not self.edited, self.digest, self.edited


NO_SPLIT = SplitIdentity()


@dataclass(frozen=True, slots=True)
class SplitUse:
    """A split on which some areas work; ``areas``: those of them that are known not to work on the newest split."""

    split: SplitIdentity
    areas: tuple[str, ...] = ()


def add_uses(uses: Iterable[SplitUse], most: int) -> tuple[SplitUse, ...]:
    """The splits of several sides together, the oldest first: the ``most`` newest, and ``most`` areas of each."""
    areas: dict[SplitIdentity, set[str]] = {}
    times: dict[SplitIdentity, float] = {}
    for use in uses:
        areas.setdefault(use.split, set()).update(use.areas)
        times[use.split] = max(use.split.time, times.get(use.split, 0.0))
    splits = sorted((replace(split, time=time) for split, time in times.items()), key=lambda split: split.age_order)
    return tuple(SplitUse(split, tuple(sorted(areas[split])[:most])) for split in splits[-most:])


HeldSplits = tuple[tuple[SplitIdentity, int], ...]
"""Splits whose files lie beside those in use, each with the number of areas that hold theirs."""


def add_held(parts: Iterable[HeldSplits], most: int) -> HeldSplits:
    """The splits that several sides hold together, the oldest first: the ``most`` newest."""
    counts: dict[SplitIdentity, int] = {}
    times: dict[SplitIdentity, float] = {}
    for split, count in (held for part in parts for held in part):
        counts[split] = counts.get(split, 0) + count
        times[split] = max(split.time, times.get(split, 0.0))
    splits = sorted((replace(split, time=time) for split, time in times.items()), key=lambda split: split.age_order)
    return tuple((split, counts[split]) for split in splits[-most:])


def are_of_one(uses: Iterable[SplitUse]) -> bool:
    """True where all areas work on one split, with files as it has written them."""
    splits = {use.split for use in uses}
    return len(splits) == 1 and all(split.is_sound for split in splits)


def find_newest(uses: Iterable[SplitUse]) -> SplitIdentity:
    """The newest split of all."""
    return max((use.split for use in uses), key=lambda split: split.age_order, default=NO_SPLIT)


def describe_other(name: str, split: SplitIdentity, newest: SplitIdentity) -> str:
    """The problem of the file of ``name`` and its cure, as text; ``newest``: the newest split on the run."""
    if not split.digest:
        return f"the file of {name} states no split, an earlier version wrote it: write it with dsse split"
    if split.edited and split.digest == newest.digest:
        return f"the file of {name} was edited after its split ({split}): replace it, or split the scenario again"
    if name == LEADER:
        return f"{name} reads the meters of another split ({split}, the areas' is {newest}): start it with the scenario"
    what = "older" if 0 < split.time < newest.time else "of another split"
    return f"the file of {name} is {what} ({split}, the newest is {newest}): replace it"
