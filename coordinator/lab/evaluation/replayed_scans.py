"""Tables of the scans of a replay: those of a run, for each scan that was played."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace

import numpy as np

from agents.messages.packing import StateMessage
from agents.protocol.quality import NONE
from coordinator.lab.evaluation.comparison import Comparison, compare
from coordinator.lab.evaluation.result import make_area_result
from coordinator.lab.evaluation.run_tables import make_run_tables
from coordinator.watch.observe.switches import find_statuses
from coordinator.watch.replay.ticks import Tick
from dsse_core.errors import DsseError
from dsse_core.estimation.bad_data import BadDataReport, process_bad_data
from dsse_core.grid.measurement import Measurement, Source
from dsse_core.grid.switches import take_fed
from dsse_core.results.columns import ScanColumns, list_columns
from dsse_core.results.results import Results
from dsse_core.results.scans import ScanTables
from dsse_core.results.table import ScanLabel, Table, as_times
from scenarios.scenario import Scenario


class ReplayedScans:
    """Takes the scans of a replay on the areas of ``scenario``, and has their tables."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._meters = {meter.id: meter for meter in scenario.meters}
        self._virtual = [Measurement(m, 0.0, 0.0) for m in scenario.meters if m.source is Source.VIRTUAL]
        self._results: list[Results] = []
        self._rows: list[dict[str, object]] = []
        self._times: list[float] = []

    def take(self, tick: Tick, states: Mapping[str, StateMessage]) -> None:
        """Takes in the ``states`` that the areas have found of a scan, at rest."""
        used: dict[str, Measurement] = {}
        for own in tick.readings.values():
            for name, value, sigma in zip(own.meters, own.values, own.sigmas, strict=True):
                if name in self._meters:
                    used[name] = Measurement(self._meters[name], value, sigma)
        scenario = self._scenario.operated(find_statuses(self._scenario.partition, states))
        network, readings = take_fed(scenario.network, [*used.values(), *self._virtual])
        try:
            report = process_bad_data(network, readings, tolerance=scenario.tolerances.estimator)
        except DsseError:
            report = None
        label = ScanLabel(str(tick.scan), tick.at)
        comparison = replace(compare(scenario.partition, states, None, report), label=label)
        areas = []
        for area in scenario.partition.areas:
            state = states.get(area.name)
            said = (state.quality, state.notes) if state else (NONE, ())
            areas.append(asdict(make_area_result(area, state, comparison, *said)))
        self._results.append(make_run_tables(comparison, scenario.meters, readings, report, areas))
        removed = sorted({meter for state in states.values() for meter in state.removed})
        missing = [area["name"] for area in areas if area["objective"] is None]
        self._times.append(tick.at)
        self._rows.append(self._describe(label.name, comparison, report, len(used), removed, missing))

    def _describe(
        self,
        scan: str,
        comparison: Comparison,
        report: BadDataReport | None,
        readings: int,
        removed: list[str],
        missing: list[str],
    ) -> dict[str, object]:
        """The columns of ``ScanColumns`` but the time, of one scan. J and its limit are the centralised ones."""
        network = comparison.partition.network
        vm, bus, phase = comparison.decentralised.vm, network.node_buses, network.node_phases
        vm = np.where(network.is_dead, np.nan, vm)
        lowest, highest = ((int(of(vm)) if not np.isnan(vm).all() else None) for of in (np.nanargmin, np.nanargmax))
        return {
            "scan": scan,
            "status": "failed" if missing else "estimated",
            "readings": readings,
            "objective": report.objective if report else np.nan,
            "degrees_of_freedom": report.degrees_of_freedom if report else 0,
            "chi_square_limit": report.chi_square_limit if report else np.nan,
            "iterations": report.result.iterations if report else 0,
            "removed": len(removed),
            "removed_meters": " ".join(removed),
            "undecided_meters": " ".join(m for _, *others in report.undecided for m in others) if report else "",
            "switched": " ".join(report.switched) if report else "",
            "bad_data_left": bool(report and report.detected),
            "lowest_vm_pu": np.nan if lowest is None else vm[lowest],
            "lowest_vm_bus": np.nan if lowest is None else float(bus[lowest]),
            "highest_vm_pu": np.nan if highest is None else vm[highest],
            "highest_vm_bus": np.nan if highest is None else float(bus[highest]),
            **({"lowest_vm_phase": "" if lowest is None else phase[lowest]} if phase else {}),
            **({"highest_vm_phase": "" if highest is None else phase[highest]} if phase else {}),
            "failure": "",
            "reason": f"no estimate of {', '.join(missing)}" if missing else "",
        }

    @property
    def tables(self) -> ScanTables:
        """The tables of all scans so far."""
        columns = {name: [row[name] for row in self._rows] for name in self._rows[0]}
        arrays = {name: column if isinstance(column[0], str) else np.array(column) for name, column in columns.items()}
        described = ScanColumns(time=as_times(np.array(self._times)), **arrays)  # type: ignore[arg-type]
        return ScanTables(Table("scans", list_columns(described)), lambda: self._results)
