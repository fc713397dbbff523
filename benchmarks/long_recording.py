"""``python -m benchmarks.long_recording``: a shift of scans on the simulator, recorded, looked through and played back.

A scan a second of virtual time, 28,800 of them: eight hours. Every area must be in the recording with readings and
state of every scan, the replay must have the same states to the bit, and memory must not grow.
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before anything loads numpy

import click
import psutil

from benchmarks.measuring.figures import conclude, figures_option
from benchmarks.measuring.machine import describe_machine
from coordinator.lab.deployment.split import area_files
from coordinator.lab.simulator.simulator import STARTED_AT, SimulatedBus
from coordinator.lab.simulator.subscriber import SimulatedRecording
from coordinator.lab.stages.play import play_on_simulator
from coordinator.watch.recording.folder import list_segments
from coordinator.watch.replay.ticks import read_ticks
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry

PACKAGES = ("numpy", "pyarrow")
SCENARIO = "ieee33"
RUN = "long"
SCAN_S = 1.0
DRAWS = 50  # of noise; the scans take turns with them
MOST_GROWTH_MIB = 5.0


def record_long(folder: Path, scans: int) -> dict[str, object]:
    """Figures of a recording of ``scans`` scans, of what it lacks, and of its replay."""
    scenario = load_scenario(SCENARIO)
    files = area_files(scenario, RUN, ["tcp/127.0.0.1:7447"])
    telemetry = [make_telemetry(scenario, draw + 1).by_area for draw in range(min(DRAWS, scans))]
    recording = SimulatedRecording(folder, STARTED_AT, None)
    recording.begin(RUN, files)
    bus = SimulatedBus(files, telemetry[0], recording.take_state, on_readings=recording.take_readings)
    began, rss_mib = time.monotonic(), []
    for scan in range(1, scans + 1):
        if scan > 1:
            bus.next_scan(telemetry[scan % len(telemetry)])
        bus.run(SCAN_S)
        if scan % max(1, scans // 4) == 0:
            rss_mib.append(psutil.Process().memory_info().rss / 2**20)
    recorded_s = time.monotonic() - began
    recording.close()
    closed_s = time.monotonic() - began - recorded_s
    names = {content.area.name for content in files}
    ticks = {tick.scan: tick.readings.keys() & tick.estimates.keys() for tick in read_ticks(folder, [])}
    began = time.monotonic()
    played = play_on_simulator(folder)
    return {
        "scans": scans,
        "recorded in, s": round(recorded_s, 1),
        "closed in, s": round(closed_s, 1),
        "segments": len(list_segments(folder)),
        "size, MiB": round(sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 2**20, 1),
        "scans of areas that are missing": sum(
            len(names - ticks.get(scan, frozenset())) for scan in range(1, scans + 1)
        ),
        "growth of memory in the second half, MiB": round(rss_mib[-1] - rss_mib[len(rss_mib) // 2 - 1], 2),
        "played back in, s": round(time.monotonic() - began, 1),
        "scans played back": played.scans,
        "states that differ": played.unequal + len(played.missing),
    }


def find_failures(seen: dict[str, object]) -> list[str]:
    """Requirements that the figures ``seen`` do not meet."""
    growth = seen["growth of memory in the second half, MiB"]
    assert isinstance(growth, float)
    checks = {
        "the recording lacks something": seen["scans of areas that are missing"] == 0,
        "a scan was not played back": seen["scans played back"] == seen["scans"],
        "a state is not that of the recording": seen["states that differ"] == 0,
        f"memory grew by more than {MOST_GROWTH_MIB:g} MiB": growth <= MOST_GROWTH_MIB,
    }
    return [failure for failure, good in checks.items() if not good]


@click.command(context_settings={"show_default": True})
@click.option("--scans", type=click.IntRange(min=4), default=28_800)
@figures_option
def main(scans: int, figures: str | None) -> None:
    """Exit code 0: nothing is missing, and the replay has the same states; 1: not."""
    with tempfile.TemporaryDirectory() as scratch:
        machine, seen = describe_machine(PACKAGES), record_long(Path(scratch) / "recording", scans)
    conclude(machine, seen, find_failures(seen), figures)


if __name__ == "__main__":
    main(prog_name="python -m benchmarks.long_recording")
