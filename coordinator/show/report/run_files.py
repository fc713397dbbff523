"""Files of a run for readers: its figures, and ``report.html``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from coordinator.lab.evaluation.result import RunResult
from coordinator.show.figures.run_figures import draw_run, save_figures
from coordinator.show.report.run_report import write_run_report


def write_report(result: RunResult, formats: Sequence[str], arguments: Sequence[str]) -> RunResult:
    """Writes the report, and the figures in each of ``formats``, into the run folder.

    ``arguments``: of the command ``dsse`` that repeats the run. Returns ``result``; its ``unwritten`` names the first
    file that could not be written, and the reason.
    """
    drawings = draw_run(result)
    try:
        write_run_report(result, drawings, arguments)
        save_figures(drawings, result.folder, formats)
    except OSError as error:
        return replace(result, unwritten=f"{error.filename or result.folder}: {error.strerror}")
    return result
