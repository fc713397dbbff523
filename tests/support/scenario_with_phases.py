"""A scenario in memory whose buses have phases: the feeder of ``tests/support/phases.py`` and its meters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from dsse_core.grid.division import build_partition
from dsse_core.grid.measurement import MeasurementKind
from dsse_core.reading_rules import DEFAULT_RULES
from scenarios.faults.faults import build_faults
from scenarios.files.fault_tables import FaultsTable
from scenarios.meters import SigmaRule
from scenarios.scenario import Scenario, load_scenario
from tests.support.phases import AREAS, make_feeder, read_meters

SIGMA = 1e-3


def make_scenario(areas: Mapping[str, Sequence[int]] = AREAS, *, is_rich: bool = True, **changes: Any) -> Scenario:
    """A scenario of the feeder in ``areas``; ``changes``: fields in place of those of ieee33 without faults."""
    network, plain = make_feeder(), load_scenario("ieee33")
    partition = build_partition(network, areas)
    fields: dict[str, Any] = {
        "name": "feeder",
        "network": network,
        "partition": partition,
        "meters": tuple(reading.meter for reading in read_meters(network, 1, 0.0, is_rich=is_rich)),
        "sigma_rule": SigmaRule({}, dict.fromkeys(MeasurementKind, SIGMA), SIGMA),
        "load_error": {area.name: 0j for area in partition.areas},
        "faults": build_faults(FaultsTable(), partition),
        "reading_rules": {area.name: DEFAULT_RULES for area in partition.areas},
    }
    return replace(plain, **(fields | changes))
