"""Access to a run, from its scenario: the areas, their neighbours and their gateways."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from agents.security.access import PLANT, Access
from dsse_core.grid.partition import Partition
from dsse_core.reading_rules import ANYBODY, ReadingRules


def access_of(partition: Partition, run: str, rules: Mapping[str, ReadingRules] | None = None) -> Access:
    """Neighbours of each area of ``partition``, and the areas that each gateway sends readings to.

    ``rules``: area -> the rules of its readings; None: the plant sends to all areas.
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
    """Access of a run without certificates: gateways may have any name where the rules of the readings allow it."""
    access = access_of(partition, run, rules)
    if any(ANYBODY in of_area.gateways for of_area in rules.values()):
        return replace(access, gateways={**access.gateways, ANYBODY: tuple(access.neighbours)})
    return access
