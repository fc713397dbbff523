"""Area files of networks with phases and their areas on the simulated bus, beside the centre."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from agents.area_files.area_file import stamp_split
from agents.protocol.configuration import Configuration
from dsse_core.estimation.bad_data import BadDataReport
from dsse_core.grid.measurement import Measurement
from dsse_core.grid.network import Network
from dsse_core.grid.partition import Partition
from dsse_core.link_faults import LinkFaults
from tests.support.simulated_bus import SimulatedBus

SOUND = LinkFaults()


def split_phases(
    partition: Partition, measurements: Sequence[Measurement], faults: LinkFaults = SOUND, **fields: Any
) -> list[Configuration]:
    """The configurations of all areas, every link with ``faults``; ``fields``: of every configuration."""
    given: dict[str, Any] = {"strategy": "information", "endpoints": ("tcp/127.0.0.1:7447",)} | fields
    meters = partition.meters_by_area([m.meter for m in measurements])
    files = [
        Configuration("sim", a, meters[a.name], links={n.area: faults for n in a.neighbours}, **given)
        for a in partition.areas
    ]
    return stamp_split(files, time=0.0)


def read_by_area(partition: Partition, measurements: Sequence[Measurement]) -> dict[str, list[Measurement]]:
    """Area -> its readings."""
    rows = partition.split_meters([m.meter for m in measurements])
    return {name: [measurements[k] for k in of.tolist()] for name, of in rows.items()}


def find_gap(bus: SimulatedBus, network: Network, centre: BadDataReport) -> float:
    """The largest difference between voltages that areas publish and those of the centre, p.u. and rad."""
    gaps = []
    for state in bus.states.values():
        rows = [network.node(*node) for node in state.nodes]
        gaps += [np.abs(np.array(state.vm) - centre.result.vm[rows]).max()]
        gaps += [np.abs(np.array(state.va) - centre.result.va[rows]).max()]
    return float(max(gaps))


def find_qualities(bus: SimulatedBus) -> Mapping[str, str]:
    """Area -> the quality of its state."""
    return {name: state.quality for name, state in bus.states.items()}
