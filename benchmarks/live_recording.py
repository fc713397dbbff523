"""``python -m benchmarks.live_recording``: a feeder in real time with a scan a second, recorded for an hour and a half.

Meters read at intervals of their own, ticks come from the clocks of the areas. Every message that a listener beside the
recorder receives must be in the recording, and no process may grow.
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before anything loads numpy

import click
import psutil

from agents.protocol.quality import GOOD
from agents.security.access import COORDINATOR
from benchmarks.measuring.figures import conclude, figures_option
from benchmarks.measuring.live_system import LiveSystem
from benchmarks.measuring.machine import describe_machine
from benchmarks.measuring.recorded import TABLES, Published, read_recorded, subscribe
from coordinator.lab.strategy_check import check_with_strategy
from coordinator.watch.recording.closing import close_recording
from scenarios.scenario import load_scenario

PACKAGES = ("eclipse-zenoh", "numpy", "pyarrow")
SCENARIO = "ieee33"
SCAN_S = 1.0
PERIODS_S = {"voltage": 1.0, "flow": 5.0, "injection": 60.0}
WARM_S = 60.0  # until memory counts
LOOK_S = 10.0
MOST_GROWTH_MIB = 1.0


def record_live(folder: Path, duration_s: float) -> dict[str, object]:
    """Figures of a run of ``duration_s``, and of the messages that its recording lacks."""
    measurements = {f"measurements.{kind}.period_s": period_s for kind, period_s in PERIODS_S.items()}
    changes = {"telemetry.ticks": "clock", "run.scan_s": SCAN_S} | measurements
    scenario = check_with_strategy(load_scenario(SCENARIO, changes=changes))
    recording, received, good = folder / "recording", set[Published](), list[bool]()
    uss_mib: dict[str, list[float]] = {}
    with LiveSystem(scenario, folder / "run", SCAN_S) as live, live.system.join(COORDINATOR) as session:
        live.system.start_recorder(recording, None, lambda: live.take() or None)
        subscribe(session, "live", received.add)
        live.wait_until(lambda states: len(states) == len(live.areas))
        live.pass_time(min(WARM_S, duration_s / 4))
        first, until = int(time.time()) + 1, time.monotonic() + duration_s
        while time.monotonic() < until:
            live.pass_time(LOOK_S)
            good += [state.quality == GOOD for state in live.states.values()]
            for name, pid in live.system.pids.items():
                uss_mib.setdefault(name, []).append(psutil.Process(pid).memory_full_info().uss / 2**20)
        last, strays = int(time.time()) - 1, list(live.strays)
        live.pass_time(LOOK_S)
        areas = live.areas
    close_recording(recording)
    recorded = read_recorded(recording)
    wanted = {(table, area, scan) for table in TABLES for area in areas for scan in range(first, last)}
    return {
        "seconds": last - first,
        "scans of areas": len(wanted) // len(TABLES),
        "messages received and not recorded": len((received & wanted) - recorded),
        **{f"scans of areas without {table}": sum(one[0] == table for one in wanted - recorded) for table in TABLES},
        "share of looks at which an area was good": round(sum(good) / len(good), 4),
        "memory of its own at the end, MiB": {name: round(values[-1], 1) for name, values in uss_mib.items()},
        "growth in the second half, MiB": {name: find_growth(values) for name, values in uss_mib.items()},
        "size of the recording, MiB": round(sum(path.stat().st_size for path in recording.rglob("*.*")) / 2**20, 1),
        "ended unasked": strays,
    }


def find_growth(values: list[float]) -> float:
    """Growth from the mean of the third quarter of ``values`` to that of the last, doubled."""
    quarter = max(1, len(values) // 4)
    return round(2 * (sum(values[-quarter:]) - sum(values[-2 * quarter : -quarter] or values[:1])) / quarter, 2)


def find_failures(seen: dict[str, Any]) -> list[str]:
    """Requirements that the figures ``seen`` do not meet."""
    growth = seen["growth in the second half, MiB"]
    grown = [name for name, mebibytes in growth.items() if mebibytes > MOST_GROWTH_MIB]
    checks = {
        "the recording lacks what was received": seen["messages received and not recorded"] == 0,
        f"grew by more than {MOST_GROWTH_MIB:g} MiB: {', '.join(grown)}": not grown,
        "a process ended unasked": not seen["ended unasked"],
    }
    return [failure for failure, holds in checks.items() if not holds]


@click.command(context_settings={"show_default": True})
@click.option("--minutes", type=click.FloatRange(min=0.2), default=90.0)
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), help="Folder.  [default: temporary]")
@figures_option
def main(minutes: float, out: Path | None, figures: str | None) -> None:
    """Exit code 0: all that was received is recorded, and no process has grown; 1: not."""
    with tempfile.TemporaryDirectory() as scratch:
        machine, seen = describe_machine(PACKAGES), record_live(out or Path(scratch), 60.0 * minutes)
    conclude(machine, seen, find_failures(seen), figures)


if __name__ == "__main__":
    main(prog_name="python -m benchmarks.live_recording")
