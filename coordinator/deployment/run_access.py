"""Who takes part in a run, and may say what: of a scenario's areas, their neighbours and gateways."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from agents.security.access import PLANT, Access
from dsse_core.grid.partition import Partition
from dsse_core.reading_rules import ANYBODY, ReadingRules


def access_of(partition: Partition, run: str, rules: Mapping[str, ReadingRules] | None = None) -> Access:
    """Who is whose neighbour among the areas of ``partition``, and who sends them readings.

    ``rules``: area -> those of its readings; None: the plant sends to all.
    """
    neighbours = {area.name: tuple(sorted({n.area for n in area.neighbours})) for area in partition.areas}
    gateways: dict[str, tuple[str, ...]] = {}
    for area, its_rules in (rules or {}).items():
        for gateway in its_rules.gateways:
            gateways[gateway] = (*gateways.get(gateway, ()), area)
    has_strangers = gateways.pop(ANYBODY, None) is not None
    if len(gateways.get(PLANT, ())) == len(neighbours):
        del gateways[PLANT]  # as where nothing is given
    elif rules and not has_strangers:
        gateways.setdefault(PLANT, ())
    return Access(run, neighbours, gateways=gateways)


def access_without_keys(partition: Partition, run: str, rules: Mapping[str, ReadingRules]) -> Access:
    """The same where nobody shows a certificate: gateways have any name where the rules of the readings allow it."""
    access = access_of(partition, run, rules)
    if any(ANYBODY in of_area.gateways for of_area in rules.values()):
        return replace(access, gateways={**access.gateways, ANYBODY: tuple(access.neighbours)})
    return access
