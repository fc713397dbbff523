"""``report.html`` of one run: verdict, figures, tables, settings, versions, and the command that repeats it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from coordinator.lab.evaluation.result import RunResult
from coordinator.show.figures.run_figures import draw_run, save_figures
from coordinator.show.figures.style import Drawing
from coordinator.show.report.page import MAX_ROWS, Page, PageTable, write_page
from coordinator.show.report.phase_rows import show_by_site
from coordinator.show.report.settings import find_origin
from coordinator.show.report.text import (
    describe_run,
    list_findings,
    name_outcome,
    tabulate_areas,
    tabulate_gaps,
)
from coordinator.watch.observe.view_text import write_summary
from dsse_core.grid.measurement import KIND_OF, MeasurementKind
from dsse_core.printable import printable, shortened
from dsse_core.results.columns import find_first_rows
from dsse_core.results.meters import read_in_own_units
from dsse_core.results.table import ALL_PHASES, Table

LONGEST_NAME = 40
WORDS_OF: dict[str, dict[str, str]] = {
    "kind": {str(kind): kind.words for kind in MeasurementKind},
    "unit": {"pu": "p.u.", "deg": "degrees", "kw": "kW", "kvar": "kvar", "a": "A"},
    "phase": {ALL_PHASES: ""},  # of a balanced network
}
Column = tuple[str, str, str]
"""Its heading in words, its name in the table, and the format of its numbers or the key in WORDS_OF of its texts."""
OF_BUSES: tuple[Column, ...] = (
    ("bus", "bus", "d"),
    ("phase", "phase", "phase"),
    ("name", "name", ""),
    ("area", "area", ""),
    ("voltage (p.u.)", "vm_pu", ".5f"),
    ("± (p.u.)", "sigma_vm_pu", ".1e"),
    ("voltage (kV)", "vm_kv", ".4f"),
    ("angle (degrees)", "va_deg", ".4f"),
    ("± (degrees)", "sigma_va_deg", ".1e"),
    ("true voltage (p.u.)", "true_vm_pu", ".5f"),
    ("true angle (degrees)", "true_va_deg", ".4f"),
    ("injection (kW)", "p_kw", ".2f"),
    ("injection (kvar)", "q_kvar", ".2f"),
    ("unbalance |V-|/|V+| (%)", "unbalance_percent", ".2f"),
    ("quality", "quality", ""),
)
OF_BRANCHES: tuple[Column, ...] = (
    ("branch", "branch", ""),
    ("phase", "phase", "phase"),
    ("name", "name", ""),
    ("from bus", "from_bus", "d"),
    ("to bus", "to_bus", "d"),
    ("power at from end (kW)", "p_from_kw", ".2f"),
    ("± (kW)", "sigma_p_from_kw", ".1e"),
    ("reactive power (kvar)", "q_from_kvar", ".2f"),
    ("current (A)", "i_from_a", ".2f"),
    ("current in neutral and ground (A)", "neutral_a", ".2f"),
    ("losses (kW)", "loss_kw", ".3f"),
    ("loading (%)", "loading_percent", ".1f"),
    ("quality", "quality", ""),
)
OF_METERS: tuple[Column, ...] = (
    ("meter", "meter", ""),
    ("kind", "kind", "kind"),
    ("reading", "value", ".6g"),
    ("standard deviation", "sigma", ".2g"),
    ("estimate", "estimate", ".6g"),
    ("residual", "residual", ".3g"),
    ("unit", "unit", "unit"),
    ("normalised residual", "normalised_residual", ".2f"),
    ("what became of it", "status", ""),
)
OF_AREAS: tuple[Column, ...] = (
    ("area", "area", ""),
    ("buses owned", "owned_buses", "d"),
    ("load (kW)", "load_kw", ".2f"),
    ("generation (kW)", "generation_kw", ".2f"),
    ("losses (kW)", "loss_kw", ".3f"),
    ("import (kW)", "import_kw", ".2f"),
    ("removed meters", "removed", "d"),
    ("critical meters", "critical", "d"),
    ("quality", "quality", ""),
    ("age (s)", "value_age_s", ".1f"),
)


def write_report(result: RunResult, formats: Sequence[str], arguments: Sequence[str]) -> RunResult:
    """Writes the report, and the figures in each of ``formats``, into the run folder.

    ``arguments``: of the command ``dsse`` that repeats the run. Returns ``result``; its ``unwritten`` names the first
    file that could not be written, and the reason.
    """
    drawings = draw_run(result)
    try:
        write_page(make_run_page(result, drawings, arguments), result.folder)
        save_figures(drawings, result.folder, formats)
    except OSError as error:
        return replace(result, unwritten=f"{error.filename or result.folder}: {error.strerror}")
    return result


def make_run_page(result: RunResult, drawings: Sequence[Drawing], arguments: Sequence[str]) -> Page:
    """The content of the report of a run. ``arguments``: of the command ``dsse`` of the run."""
    scenario, verdict = result.scenario, result.verdict
    outcome = name_outcome(verdict)
    return Page(
        title=f"{scenario.name}: state estimation by {len(result.area_results)} areas",
        subtitle=f"{describe_run(scenario)}; run {result.run}",
        outcome=outcome[:1].upper() + outcome[1:],
        good=verdict.consensus,
        reasons=[*map(str, result.causes), *(verdict.reason or "").splitlines()],
        findings=[*write_summary(result.summary), *list_findings(result)],
        tables=[
            PageTable("Gaps and errors", *tabulate_gaps(result)),
            PageTable("Areas", *tabulate_areas(result)),
            _tabulate("Power of the areas", result.areas, OF_AREAS),
        ],
        drawings=drawings,
        more_tables=[
            _tabulate_sites(
                "Buses", result.buses, OF_BUSES, "All columns, with all digits: buses.csv beside this file."
            ),
            _tabulate_sites("Branches", result.branches, OF_BRANCHES, "All columns: branches.csv beside this file."),
            _tabulate("Meters", _in_own_units(result.meters), OF_METERS, "All columns: meters.csv beside this file."),
        ],
        origin=find_origin(scenario, arguments),
    )


def _in_own_units(meters: Table) -> Table:
    """The columns of OF_METERS, of quantities in the unit of each meter."""
    shared = {name: meters[name] for name in ("meter", "kind", "normalised_residual", "status")}
    unit = [KIND_OF[kind].quantity.unit for kind in meters.kind]
    return Table("meters", shared | read_in_own_units(meters) | {"unit": unit})


def _tabulate_sites(title: str, table: Table, columns: Sequence[Column], note: str) -> PageTable:
    """Tabulates buses or branches; the title has their number, and that of rows where they have phases."""
    ids = columns[0][1]
    shown, n = _tabulate(title, show_by_site(table, ids), columns, note), int(find_first_rows(table[ids]).sum())
    if "unbalance_percent" in table.columns or "neutral_a" in table.columns:
        note = f"{note} Numbers of a whole {ids}, losses among them, stand in its first row."
        shown = replace(
            shown, title=f"{title} ({n}, {len(table)} {'nodes' if ids == 'bus' else 'conductors'})", note=note
        )
    return shown


def _tabulate(title: str, table: Table, columns: Sequence[Column], note: str = "") -> PageTable:
    """The first ``MAX_ROWS`` rows of ``table``, with the columns that have values, rounded for reading."""
    there = [column for column in columns if column[1] in table.columns]
    cells = [(heading, _write_cells(table[name][:MAX_ROWS], form)) for heading, name, form in there]
    filled = [(heading, column) for heading, column in cells if any(column) or not len(table)]
    rows = list(zip(*(column for _, column in filled), strict=True))
    header = [heading for heading, _ in filled]
    return PageTable(f"{title} ({len(table)})", header, rows, note, left_out=len(table) - len(rows))


def _write_cells(column: Sequence[object], form: str) -> list[str]:
    if isinstance(column, tuple):
        words = WORDS_OF.get(form, {})
        return [shortened(printable(words.get(value, value)), LONGEST_NAME) for value in column]
    return ["" if isinstance(v, float) and math.isnan(v) else _write_number(v, form) for v in column.tolist()]  # type: ignore[attr-defined]


def _write_number(value: float, form: str) -> str:
    return format(int(value) if form == "d" else value, form)
