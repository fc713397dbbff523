"""``dsse split``: writes one file per area of a scenario, the only input of an agent."""

from __future__ import annotations

import dataclasses
import time as clock
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from agents.area_files.area_file import save_area_file, stamp_split
from agents.protocol.configuration import Configuration
from dsse_core.endpoints import check_endpoints
from dsse_core.reading_rules import DEFAULT_RULES
from dsse_core.split_identity import SplitIdentity
from scenarios.scenario import Scenario


def area_files(
    scenario: Scenario,
    run: str,
    endpoints: Sequence[str],
    area_endpoints: Mapping[str, str] | None = None,
    time: float | None = None,
) -> list[Configuration]:
    """Content of each area's file, in scenario order.

    ``endpoints``: of the routers. ``area_endpoints``: instead of these, area -> the endpoint that it listens on; of two
    neighbours the child connects to the parent. ``time``: of the split, s since 1970 UTC; by default now.
    """
    area_endpoints = area_endpoints or {}
    partition = scenario.partition
    meters = partition.meters_by_area(scenario.meters)
    files = [
        Configuration(
            run=run,
            area=area,
            meters=meters[area.name],
            strategy=scenario.strategy,
            endpoints=tuple(area_endpoints[n.area] for n in area.neighbours if n.is_parent)
            if area_endpoints
            else tuple(endpoints),
            listen=(area_endpoints[area.name],) if area_endpoints else (),
            beat_s=scenario.run.beat_s,
            scan_s=scenario.run.scan_s,
            tolerance=scenario.tolerances.estimator,
            generation=scenario.generation,
            load_error=scenario.load_error[area.name],
            links={n.area: scenario.faults.links[area.name, n.area] for n in area.neighbours},
            seed=scenario.seed,
            penalty=scenario.admm_penalty,
            limits=scenario.limits,
            readings=scenario.reading_rules.get(area.name, DEFAULT_RULES),
            clock_error_s=scenario.faults.clock_error_s.get(area.name, 0.0),
        )
        for area in partition.areas
    ]
    at = float(int(clock.time())) if time is None else time
    return stamp_split(files, at, dataclasses.asdict(scenario.sigma_rule))


def find_split(scenario: Scenario) -> SplitIdentity:
    """Identity of the split of ``scenario``, without its time, since that differs with each split."""
    (split, *_) = (content.split for content in area_files(scenario, "", ()))
    assert split is not None
    return SplitIdentity(split.digest)


def write_area_files(
    scenario: Scenario,
    run: str,
    endpoints: Sequence[str],
    folder: Path,
    area_endpoints: Mapping[str, str] | None = None,
    suffix: str = ".toml",
) -> Iterator[tuple[str, Path]]:
    """Write ``<area>.toml`` (or ``suffix``) of every area into ``folder``, see ``area_files``; yields area and file.

    Raises:
        InvalidInputError: one of ``endpoints`` is no endpoint.
    """
    check_endpoints("endpoints", endpoints)
    folder.mkdir(parents=True, exist_ok=True)
    for content in area_files(scenario, run, endpoints, area_endpoints):
        path = folder / f"{content.area.name}{suffix}"
        save_area_file(path, content)
        yield content.area.name, path
