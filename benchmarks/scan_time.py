"""``python -m benchmarks.scan_time``: processor time of all areas for one scan, in one process on the simulator."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before anything loads numpy

import statistics
import time
from dataclasses import dataclass

import click

from agents.protocol.rounds import RoundsProtocol
from benchmarks.exchange.worlds import SCANS, draw_row, read_ieee33
from benchmarks.fault_histories.history import World
from benchmarks.measuring.machine import describe_machine
from coordinator.lab.simulator.simulator import SimulatedBus
from dsse_core.link_faults import LinkFaults

STEP_S = 0.001  # virtual time between two looks at whether all areas are at the end
REST_S = 1.0  # virtual, between two scans
LIMIT_S = 60.0  # virtual, for a scan
PACKAGES = ("consensus-dsse", "numpy", "scipy")


@dataclass(frozen=True)
class ScanTimes:
    """Processor times, s, of the first scan and of each later one, until all areas are at its end."""

    cold: float
    warm: tuple[float, ...]


def time_scans(world: World, scans: int) -> ScanTimes:
    """Run ``scans`` scans, with the readings of ``world`` in turn."""
    links = {(area.name, n.area): LinkFaults() for area in world.partition.areas for n in area.neighbours}
    bus = SimulatedBus(world.files(links, 0), world.telemetry[0])
    times = [_time_scan(bus)]
    for scan in range(1, scans):
        bus.run(REST_S)
        bus.next_scan(world.telemetry[scan % len(world.telemetry)])
        times.append(_time_scan(bus))
    return ScanTimes(times[0], tuple(times[1:]))


def _time_scan(bus: SimulatedBus) -> float:
    start, until = time.process_time(), bus.now + LIMIT_S
    while not all(_is_at_the_end(protocol, bus.scan) for protocol in bus.protocols.values()):
        if bus.now >= until:
            raise click.ClickException(f"scan {bus.scan} has no end within {LIMIT_S:g} s")
        bus.run(STEP_S)
    return time.process_time() - start


def _is_at_the_end(protocol: object, scan: int) -> bool:
    assert isinstance(protocol, RoundsProtocol)
    return protocol.outcome is not None and protocol.scan == scan


@click.command(context_settings={"show_default": True})
@click.option("--row", "rows", type=click.IntRange(2), multiple=True, help="Also so many areas in a row.")
@click.option("--scans", type=click.IntRange(2), default=40, help="Of ieee33, the first one cold; of rows three.")
def main(rows: tuple[int, ...], scans: int) -> None:
    """Take the processor time of a scan; of warm ones the least, as nothing but other work makes one take more."""
    for name, text in describe_machine(PACKAGES).items():
        click.echo(f"{name}: {text}")
    worlds = [("ieee33", read_ieee33(), scans), *((f"{n} areas in a row", draw_row(n), SCANS) for n in rows)]
    click.echo("\n| case | cold, ms | warm, ms: least, median | ms an area |\n|---|---|---|---|")
    for case, world, count in worlds:
        times = time_scans(world, count)
        least, median = 1e3 * min(times.warm), 1e3 * statistics.median(times.warm)
        each = least / len(world.partition.areas)
        click.echo(f"| {case} | {1e3 * times.cold:.4g} | {least:.4g}, {median:.4g} | {each:.3g} |")


if __name__ == "__main__":
    main(prog_name="python -m benchmarks.scan_time")
