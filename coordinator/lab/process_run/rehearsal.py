"""Rehearsal of the warmed parent before it forks many areas: one estimate of a feeder of three areas.

The first run of code creates caches of types and patterns, specialised bytecode and late imports. After the rehearsal
the parent has them. Otherwise each of hundreds of agents would create them, and copy the memory pages.
"""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path

from agents.area_files.area_file import save_area_file, stamp_split
from agents.area_files.reader import load_area_file
from agents.messages.packing import decode, encode
from agents.protocol.configuration import Configuration
from agents.strategies.installed import list_strategies
from coordinator.lab.simulator.simulator import SimulatedBus
from dsse_core.files.drafts import draft_folder, remove_leftovers
from dsse_core.grid.division import build_partition
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.partition import Partition

PREFIX = "dsse-rehearsal-"  # of the names of the folders of its area files
AREAS = ("first", "second", "third")
LARGEST = 61  # buses of an area; larger ones are computed by the same code
SETTLING_S = 0.5  # of virtual time: an estimate, and the repeated messages after it
SIGMA = 0.01


def rehearse(strategy: str, n_bus: int) -> dict[str, str]:
    """Estimates a feeder of three areas of ``n_bus`` buses each, ``LARGEST`` at most. Returns area -> quality.

    Returns an empty table if the strategy fails; it then fails in its area, too, where the failure is reported.
    """
    with contextlib.suppress(Exception):
        return _estimate(strategy, _divide_feeder(min(n_bus, LARGEST)))
    return {}


def _estimate(strategy: str, partition: Partition) -> dict[str, str]:
    meters = partition.meters_by_area(_list_meters(partition.network))
    temporary, files = Path(tempfile.gettempdir()).absolute(), []
    # left by an earlier rehearsal: this process is killed without notice when the check refuses the scenario
    remove_leftovers(temporary, PREFIX)
    with draft_folder(temporary, PREFIX) as folder:
        made = [
            Configuration("rehearsal", area, meters[area.name], strategy, ("tcp/127.0.0.1:0",))
            for area in partition.areas
        ]
        for content in stamp_split(made, time=0.0):
            path = folder / f"{content.area.name}.json"
            save_area_file(path, content)
            files.append(load_area_file(path, list_strategies()))
    readings = {
        content.area.name: [Measurement(m, float(m.kind is MeasurementKind.VM), SIGMA) for m in content.meters]
        for content in files
    }
    bus = SimulatedBus(files, readings)
    bus.run(SETTLING_S)
    for state in bus.states.values():
        decode(encode(state))
    return {name: state.quality for name, state in bus.states.items()}


def _divide_feeder(n_bus: int) -> Partition:
    """A feeder without load. Its areas form a row, and each begins at the last bus of the area before."""
    n = max(n_bus, 2)
    numbers = range(1, len(AREAS) * (n - 1) + 2)
    buses = tuple(Bus(i, 20.0) for i in numbers)
    branches = tuple(Branch(f"{i}-{i + 1}", i, i + 1, 1e-4, 1e-4) for i in numbers[:-1])
    network = Network("rehearsal", 1.0, buses, branches, (Generator(1, Control.SLACK),))
    return build_partition(
        network, {name: list(numbers[k * (n - 1) : (k + 1) * (n - 1) + 1]) for k, name in enumerate(AREAS)}
    )


def _list_meters(network: Network) -> list[Meter]:
    at_buses = (MeasurementKind.VM, MeasurementKind.P_INJECTION, MeasurementKind.Q_INJECTION)
    flows = (MeasurementKind.P_FLOW, MeasurementKind.Q_FLOW)
    meters = [Meter(kind, bus.id) for bus in network.buses for kind in at_buses]
    return [*meters, *(Meter(kind, b.from_bus, b.id) for b in network.branches for kind in flows)]
