"""Content of ``result.json`` for estimates and power flows in one place, and the parts shared with that of a run."""

from __future__ import annotations

import importlib.metadata
import math
import platform
from collections.abc import Mapping
from typing import Any

from coordinator.lab.evaluation.scan_estimates import ScanEstimates
from dsse_core.estimation.bad_data import BadDataReport
from dsse_core.grid.network import Network
from dsse_core.power_flow.newton_raphson import PowerFlowResult
from dsse_core.results.units import base_kw
from scenarios.scenario import Scenario

VERSION = 2
DISTRIBUTIONS = ("consensus-dsse", "numpy", "scipy", "eclipse-zenoh", "msgspec")


def estimate_as_json(scenario: Scenario, report: BadDataReport) -> dict[str, Any]:
    """The content of the ``result.json`` of ``dsse estimate``."""
    how = {"iterations": report.result.iterations, "back_end": report.result.backend}
    return {**head_json(scenario), "estimate": report_as_json(report) | how, **versions_json()}


def scans_as_json(scenario: Scenario, found: ScanEstimates) -> dict[str, Any]:
    """The content of the ``result.json`` of ``dsse estimate --readings`` with many scans."""
    failed = {found.names[row]: str(failure.code) for row, failure in found.batch.failures.items()}
    estimated = len(found.names) - len(failed)
    of_all = {"scans": len(found.names), "estimated": estimated, "failed": failed}
    return {**head_json(scenario), "estimates": of_all | {"back_end": found.batch.plan.backend}, **versions_json()}


def replay_as_json(scenario: Scenario, found: Mapping[str, Any]) -> dict[str, Any]:
    """The content of the ``result.json`` of ``dsse replay``; ``found``: the comparison with the record."""
    return {**head_json(scenario), "replay": dict(found), **versions_json()}


def power_flow_as_json(solved: Scenario | Network, result: PowerFlowResult) -> dict[str, Any]:
    """The content of the ``result.json`` of ``dsse powerflow``."""
    network = result.network
    loss = result.losses * base_kw(network)
    how = {"iterations": result.iterations, "method": result.method}
    found = {"loss_kw": loss.real, "loss_kvar": loss.imag} | how
    of_network = {"version": VERSION, "network": {"name": network.name, "buses": len(network.buses)}}
    head = of_network if isinstance(solved, Network) else head_json(solved)
    return {**head, "power_flow": found, **versions_json()}


def head_json(scenario: Scenario) -> dict[str, Any]:
    """The version of the file and the description of its scenario."""
    of_scenario = {
        "name": scenario.name,
        "path": str(scenario.path),
        "description": scenario.description,
        "network": scenario.network.name,
        "buses": len(scenario.network.buses),
        "strategy": scenario.strategy,
        "seed": scenario.seed,
        "telemetry": scenario.telemetry.source,
        "changes": dict(scenario.changes),
    }
    return {"version": VERSION, "scenario": of_scenario}


def versions_json() -> dict[str, Any]:
    """Versions of Python and of the packages that have computed the result."""
    return {"versions": {"python": platform.python_version()} | {name: version_of(name) for name in DISTRIBUTIONS}}


def report_as_json(report: BadDataReport) -> dict[str, Any]:
    """Findings of the chi-square test and of the removal of bad data."""
    return {
        "objective": report.objective,
        "degrees_of_freedom": report.degrees_of_freedom,
        "chi_square_limit": report.chi_square_limit if math.isfinite(report.chi_square_limit) else None,
        "bad_data_left": report.detected,
        "removed": [
            {
                "meter": removed.measurement.meter.id,
                "normalized_residual": removed.normalized_residual,
                "indistinguishable_from": list(removed.indistinguishable_from),
            }
            for removed in report.removed
        ],
        "switched": list(report.switched),
        "without_supply": list(report.result.network.dead_places),
        "critical": list(report.critical),
    }


def version_of(distribution: str) -> str | None:
    """The version of a package, None if it is not installed."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None
