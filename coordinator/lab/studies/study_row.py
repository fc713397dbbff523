"""A run of a study as a row: outcome, gap to the centralised estimate, messages and bytes, times."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cache

from coordinator.lab.evaluation.answers import version_of
from coordinator.lab.evaluation.convergence import find_time_below, gap_history
from coordinator.lab.evaluation.result import RunOutcome
from dsse_core.errors import InvalidInputError
from dsse_core.printable import shortened
from scenarios.scenario import Scenario

CONSENSUS, NO_CONSENSUS, NOT_POSSIBLE = "consensus", "no consensus", "not possible"
LONGEST_REASON = 300


@dataclass(frozen=True, slots=True)
class StudyRow:
    """A run of a study. Largest of all buses, ``gap_*``: decentralised to centralised; ``error_*``: decentralised to
    the truth; ``centralised_error_*``: centralised to the truth. None where an estimate is incomplete, or the truth is
    not known.

    ``below_*_s``: the time from which on every area stays closer than that (p.u. and rad) to the centralised
    estimate, at all buses that it sees; None if never. ``end_s``: time of the verdict. Both times are virtual on the
    simulator. ``reason``: for which there is no consensus, or the run is not possible and has no figures.
    """

    strategy: str
    seed: int
    outcome: str
    gap_vm_pu: float | None = None
    gap_va_deg: float | None = None
    error_vm_pu: float | None = None
    error_va_deg: float | None = None
    centralised_error_vm_pu: float | None = None
    centralised_error_va_deg: float | None = None
    exchanges: int | None = None
    messages: int | None = None
    bytes: int | None = None
    lost: int | None = None
    below_1e3_s: float | None = None
    below_1e6_s: float | None = None
    below_1e8_s: float | None = None
    end_s: float | None = None
    reason: str = ""
    host: str = ""  # machine that computed the run
    versions: str = ""  # on that machine, see ``describe_versions``
    scenario_sha256: str = ""  # of the scenario that the study began with


ORIGIN = ("host", "versions", "scenario_sha256")
PACKAGES = ("consensus-dsse", "numpy", "scipy", "numba")
COLUMNS = tuple(field.name for field in fields(StudyRow))
FIGURES = tuple(name for name in COLUMNS if name not in ("strategy", "seed", "outcome", "reason", *ORIGIN))
"""The columns with numbers that a run has found."""


@cache
def describe_versions() -> str:
    """Versions of Python and of the packages that the digits of a row depend on, as one text."""
    found = {name: version_of(name) for name in PACKAGES}
    listed = [f"{name} {version}" for name, version in found.items() if version is not None]
    return "; ".join([f"Python {platform.python_version()}", *listed])


def make_row(outcome: RunOutcome) -> StudyRow:
    """The row of a run that has ended."""
    verdict, gaps, of_centre = outcome.verdict, gap_history(outcome), outcome.comparison.centralised_error
    return StudyRow(
        strategy=outcome.scenario.strategy,
        seed=outcome.scenario.seed,
        outcome=CONSENSUS if verdict.consensus else NO_CONSENSUS,
        gap_vm_pu=verdict.gap_vm_pu,
        gap_va_deg=verdict.gap_va_deg,
        error_vm_pu=verdict.error_vm_pu,
        error_va_deg=verdict.error_va_deg,
        centralised_error_vm_pu=of_centre.vm_pu,
        centralised_error_va_deg=of_centre.va_deg,
        exchanges=verdict.exchanges,
        messages=verdict.messages,
        bytes=verdict.bytes,
        lost=verdict.lost,
        below_1e3_s=find_time_below(gaps, 1e-3),
        below_1e6_s=find_time_below(gaps, 1e-6),
        below_1e8_s=find_time_below(gaps, 1e-8),
        end_s=verdict.wall_s if verdict.virtual_s is None else verdict.virtual_s,
        reason=_shortened(verdict.reason or ""),
        host=platform.node(),
        versions=describe_versions(),
    )


def make_impossible_row(scenario: Scenario, error: Exception) -> StudyRow:
    """The row of a run that ``error`` keeps from starting."""
    return StudyRow(
        scenario.strategy,
        scenario.seed,
        NOT_POSSIBLE,
        reason=_shortened(str(error)),
        host=platform.node(),
        versions=describe_versions(),
    )


def check_one_is_possible(scenario: Scenario, rows: Sequence[StudyRow]) -> None:
    """Checks that at least one of ``rows``, one of each strategy, is that of a run.

    Raises:
        InvalidInputError: no strategy could be run, with the reasons.
    """
    if all(row.outcome == NOT_POSSIBLE for row in rows):
        problems = [f"strategy {row.strategy}: {row.reason}" for row in rows]
        raise InvalidInputError(f"scenario {scenario.name!r}", problems)


def to_cells(row: StudyRow) -> list[str]:
    """The row as text, in the order of ``COLUMNS``, exact; empty for None."""
    values = [getattr(row, field.name) for field in fields(row)]
    return ["" if value is None else str(value) for value in values]


def from_cells(cells: list[str]) -> StudyRow:
    """The row whose cells ``to_cells`` has written.

    Raises:
        ValueError: the cells are not those of a row.
    """
    if len(cells) != len(COLUMNS):
        raise ValueError(f"{len(cells)} cells, not {len(COLUMNS)}")
    values: list[object] = []
    for field, cell in zip(fields(StudyRow), cells, strict=True):
        if field.type == "str":
            values.append(cell)
        elif cell == "":
            values.append(None)
        else:
            values.append(int(cell) if "int" in str(field.type) else float(cell))
    return StudyRow(*values)  # type: ignore[arg-type]


def _shortened(text: str) -> str:
    return shortened(" ".join(text.split()), LONGEST_REASON)
