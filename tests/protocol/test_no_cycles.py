"""What a scan leaves behind is freed at once: the collector of cycles looks rarely, and agents run for months."""

from __future__ import annotations

import gc
from dataclasses import replace

import pytest

from dsse_core.grid.measurement import Measurement
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.simulated_bus import SimulatedBus, area_files_of


@pytest.mark.usefixtures("each_back_end")
@pytest.mark.parametrize("strategy", ["information", "admm", "angle-offset"])
def test_scan_after_scan_leaves_no_cycle_of_objects_behind(strategy: str):
    scenario = replace(load_scenario("industrial13"), strategy=strategy)
    scans = [make_telemetry(scenario, k).by_area for k in (1, 2)]
    bus = SimulatedBus(area_files_of(scenario), scans[0])

    def run_scans(count: int) -> None:
        for k in range(count):
            telemetry: dict[str, tuple[Measurement, ...]] = scans[k % 2]
            bus.next_scan(telemetry)
            bus.run(2.0)

    run_scans(4)
    gc.collect()
    gc.disable()
    try:
        run_scans(10)
        found = gc.collect()
    finally:
        gc.enable()
    assert found < 30  # a few of libraries; a model of each scan would be hundreds
