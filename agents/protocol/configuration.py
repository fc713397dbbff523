"""Configuration of an area: the value on which its terms rest. Reading and writing files of it is around the protocol.

Hub, neighbours, models, meters and the flat start follow from it. It changes only between two scans, together with
those of all other areas (``rounds.py``).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field

from agents.protocol.configuration_digest import digest_configuration
from dsse_core.estimation.state_limits import DEFAULT_LIMITS, StateLimits
from dsse_core.grid.measurement import Meter
from dsse_core.grid.partition import Area
from dsse_core.link_faults import LinkFaults
from dsse_core.reading_rules import DEFAULT_RULES, ReadingRules
from dsse_core.split_identity import NO_SPLIT, SplitIdentity


@dataclass(frozen=True, slots=True)
class SplitStamp:
    """What a split writes into each of its files. Two splits of one content are equal, whenever they were made.

    ``digest``: of the split, 16 hex digits. ``content``: of this file. ``time``: of the split, s since 1970 UTC.
    """

    digest: str
    content: str
    time: float = field(compare=False)


@dataclass(frozen=True)
class Configuration:
    """One area as its agent knows it.

    Args:
        run: name of the system that the area belongs to; a part of every key.
        meters: the area's meters, virtual ones included; readings come by telemetry.
        strategy: name of the boundary-exchange strategy.
        endpoints: Zenoh endpoints to connect to, e.g. ``tcp/127.0.0.1:7447``: routers of which one is enough, or,
            of an area that listens itself, neighbours.
        listen: where neighbours, plant and watchers link with this area directly; empty if they meet at a router.
        beat_s: interval at which the last messages are repeated, s.
        scan_s: time between two scans, s; None where it is not known.
        tolerance: the local estimate stops at max |dx| below it, p.u. and rad.
        generation: load messages count the "telemetered" injection of substation and generators, or the
            "scheduled" one.
        load_error: added to the load at each boundary bus (eqs. 5.4, 5.5), p.u.
        links: neighbour -> what goes wrong on the link to it; a neighbour that is not there has a sound link.
        seed: of what goes wrong.
        penalty: of strategy ``admm``.
        limits: what an estimate must keep to be relied on.
        readings: who numbers scans, who sends for the meters, and how old their readings may be.
        clock_error_s: injected fault: by how much the clock of the area is ahead, s.
        split: of which split the configuration is (``configuration_digest.py``); None in files of versions that knew
            no splits.
    """

    run: str
    area: Area
    meters: Sequence[Meter]
    strategy: str
    endpoints: tuple[str, ...]
    listen: tuple[str, ...] = ()
    beat_s: float = 0.2
    scan_s: float | None = None
    tolerance: float = 1e-6
    generation: str = "telemetered"
    load_error: complex = 0j
    links: dict[str, LinkFaults] = field(default_factory=dict)
    seed: int = 0
    penalty: float = 1.0
    limits: StateLimits = DEFAULT_LIMITS
    readings: ReadingRules = DEFAULT_RULES
    clock_error_s: float = 0.0
    split: SplitStamp | None = field(default=None, compare=False)

    @functools.cached_property
    def identity(self) -> SplitIdentity:
        """The split that this is of, and whether it was edited since."""
        if self.split is None:
            return NO_SPLIT
        found = digest_configuration(self)
        return SplitIdentity(self.split.digest, self.split.time, "" if found == self.split.content else found)
