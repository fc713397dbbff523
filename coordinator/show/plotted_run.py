"""The result of a run that draws itself: what ``run`` and ``simulate`` give to scripts and notebooks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from coordinator.lab.evaluation import result

if TYPE_CHECKING:
    from coordinator.show.figures.style import Drawing


class RunResult(result.RunResult):
    """A run with its files in ``folder``; ``unwritten``: the reason that some are missing, None if all are written."""

    @classmethod
    def of(cls, found: result.RunResult) -> RunResult:
        """The same result, with the tables that it has made already."""
        plotted = cls.__new__(cls)
        vars(plotted).update(vars(found))
        return plotted

    def plot(self, figure: str = "gap") -> Drawing:
        """A figure of the report: ``gap``, ``errors``, ``magnitudes``, ``angles``, ``residuals`` or ``network``.

        A notebook shows it, ``save(PATH)`` writes it, and its ``figure`` is matplotlib's.

        Raises:
            InvalidInputError: there is no such figure.
        """
        from coordinator.show.figures.run_figures import FIGURES, draw_one

        return draw_one(FIGURES, figure, self)
