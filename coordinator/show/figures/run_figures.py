"""The figures of a run, by name, and their files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from coordinator.lab.evaluation.result import RunOutcome
from coordinator.show.figures.errors_figure import draw_errors
from coordinator.show.figures.gap_figure import draw_gap
from coordinator.show.figures.network_figure import draw_network
from coordinator.show.figures.profile_figures import Profile, draw_angles, draw_magnitudes, find_profile
from coordinator.show.figures.residuals_figure import draw_residuals
from coordinator.show.figures.style import Drawing, save, styled
from dsse_core.errors import InvalidInputError
from dsse_core.files.wording import describe_unknown

FIGURES: Mapping[str, Callable[[RunOutcome], Drawing]] = {
    "gap": draw_gap,
    "errors": draw_errors,
    "magnitudes": lambda outcome: draw_magnitudes(find_profile(outcome)),
    "angles": lambda outcome: draw_angles(find_profile(outcome)),
    "residuals": draw_residuals,
    "network": draw_network,
}
PROFILES: Mapping[str, Callable[[Profile], Drawing]] = {"magnitudes": draw_magnitudes, "angles": draw_angles}
Drawn = TypeVar("Drawn")


def draw_run(outcome: RunOutcome) -> tuple[Drawing, ...]:
    """All figures of a run, in the order of its report."""
    with styled():
        return tuple(draw(outcome) for draw in FIGURES.values())


def draw_one(figures: Mapping[str, Callable[[Drawn], Drawing]], name: str, drawn: Drawn) -> Drawing:
    """The figure ``name`` of ``figures``, of ``drawn``.

    Raises:
        InvalidInputError: there is no such figure.
    """
    if name not in figures:
        raise InvalidInputError("plot", [describe_unknown("figure", name, tuple(figures))])
    with styled():
        return figures[name](drawn)


def save_figures(drawings: Sequence[Drawing], folder: Path, formats: Sequence[str]) -> tuple[Path, ...]:
    """Write each figure in each of ``formats``: ``gap.png`` and so on; their paths.

    Raises:
        OSError: a file cannot be written.
    """
    with styled():
        return tuple(path for each in drawings for path in save(each.figure, folder / each.name, formats))
