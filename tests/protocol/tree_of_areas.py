"""The feeder with 33 buses in five areas, a tree that the thesis does not have."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from dsse_core.grid.division import build_partition
from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.grid.partition import Partition
from dsse_core.link_faults import LinkFaults
from scenarios.faults.faults import Faults, find_links
from scenarios.scenario import Scenario, load_scenario

TREE = {  # four areas deep, three areas at bus 6, areas b and c without voltmeter and generator
    "a": [1, 2, 19, 20, 21, 22],
    "b": [2, 3, 23, 24, 25],
    "c": [3, 4, 5, 6],
    "d": [6, *range(7, 19)],
    "e": [6, *range(26, 34)],
}


def tree_scenario(noise: bool = True, seed: int = 1) -> Scenario:
    """ieee33 divided as TREE says, with sound links and the strategy of the thesis."""
    scenario = load_scenario("ieee33")
    partition = build_partition(scenario.network, TREE)
    return replace(
        scenario,
        strategy="angle-offset",
        seed=seed,
        partition=partition,
        telemetry=replace(scenario.telemetry, noise=noise),
        load_error={area.name: 0j for area in partition.areas},
        faults=sound_links(partition),
    )


def sound_links(partition: Partition) -> Faults:
    """No link does anything to its messages."""
    return Faults({link: LinkFaults() for link in find_links(partition)})


def with_angle_meters(scenario: Scenario, buses: Sequence[int]) -> Scenario:
    """``scenario`` with meters of 0.05 degrees at ``buses``."""
    kind = MeasurementKind.VA
    rule = replace(scenario.sigma_rule, absolute={**scenario.sigma_rule.absolute, kind: math.radians(0.05)})
    return replace(scenario, meters=(*scenario.meters, *(Meter(kind, bus) for bus in buses)), sigma_rule=rule)
