"""The figures of a run, by name, and their files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from coordinator.lab.evaluation.result import RunOutcome
from coordinator.show.figures.errors_figure import draw_errors
from coordinator.show.figures.gap_figure import draw_gap
from coordinator.show.figures.network_figure import draw_network
from coordinator.show.figures.profile_figures import draw_angles, draw_magnitudes
from coordinator.show.figures.residuals_figure import draw_residuals
from coordinator.show.figures.style import Drawing, save, styled

FIGURES: tuple[Callable[[RunOutcome], Drawing], ...] = (
    draw_gap,
    draw_errors,
    draw_magnitudes,
    draw_angles,
    draw_residuals,
    draw_network,
)


def draw_run(outcome: RunOutcome) -> tuple[Drawing, ...]:
    """All figures of a run, in the order of its report."""
    with styled():
        return tuple(draw(outcome) for draw in FIGURES)


def save_figures(drawings: Sequence[Drawing], folder: Path, formats: Sequence[str]) -> tuple[Path, ...]:
    """Write each figure in each of ``formats``: ``gap.png`` and so on; their paths.

    Raises:
        OSError: a file cannot be written.
    """
    with styled():
        return tuple(path for each in drawings for path in save(each.figure, folder / each.name, formats))
