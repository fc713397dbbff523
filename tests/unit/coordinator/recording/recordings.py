"""Recordings for the tests, made by the simulator."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from agents.area_files.area_file import AreaFile
from agents.messages.keys import live_key, readings_key, state_key
from agents.messages.packing import Header, Incarnation, ReadingsMessage, StateMessage, encode
from coordinator.deployment.split import area_files
from coordinator.recording.entries import APPEARED, MESSAGE, Entry
from scenarios.scenario import Scenario, load_scenario

Record = Callable[[Sequence[Entry]], Path]
"""Of the fixture ``record``."""
RUN = "grid"
AT = 1_700_000_000.0  # s since 1970, within an hour UTC
ME = Incarnation(1_700_000_000_000, 7)


def load_areas_of(scenario: Scenario | None = None) -> list[AreaFile]:
    return area_files(scenario or load_scenario("ieee33"), RUN, ["tcp/127.0.0.1:7447"])


def make_state(content: AreaFile, scan: int = 1, sequence: int = 1, at: float = AT, **fields: object) -> StateMessage:
    """A state of an area all of whose buses have 1 p.u."""
    buses = tuple(bus.id for bus in content.area.network.buses)
    zeros = (0.0,) * len(buses)
    known: dict[str, object] = {
        "buses": buses,
        "vm": (1.0,) * len(buses),
        "va": zeros,
        "sigma_vm": zeros,
        "sigma_va": zeros,
        "referenced": True,
        "objective": 1.0,
        "degrees_of_freedom": 2,
        "checked": True,
        "quality": "good",
        "telemetry_age": 0.0,
        **dict.fromkeys(("removed", "critical", "notes", "old_sides"), ()),
        **dict.fromkeys(("messages", "bytes", "lost"), 0),
    }
    known |= {key: {} for key in ("sent", "received", "rejected", "faults", "ages", "scans")}
    header = Header(RUN, content.area.name, ME, scan, sequence, at)
    return StateMessage(header=header, **{**known, **fields})  # type: ignore[arg-type]


def make_readings(content: AreaFile, scan: int = 1, sequence: int = 1, at: float = AT) -> ReadingsMessage:
    meters = tuple(meter.id for meter in content.meters)
    header = Header(RUN, content.area.name, ME, scan, sequence, at)
    values = tuple(0.1 * k for k in range(len(meters)))
    return ReadingsMessage(header, at, meters, values, (0.01,) * len(meters), (at - 0.5,) * len(meters))


def entry_of(message: StateMessage | ReadingsMessage, at: float = AT) -> Entry:
    """As it would have arrived ``at``."""
    make_key = state_key if isinstance(message, StateMessage) else readings_key
    return Entry(MESSAGE, at, make_key(RUN, message.header.sender), encode(message))


def appeared(area: str, at: float = AT) -> Entry:
    return Entry(APPEARED, at, live_key(RUN, "area", area, ME))


def read_table(folder: Path, table: str) -> list[dict[str, object]]:
    """All rows of a closed table, in order."""
    import pyarrow.parquet

    files: Sequence[Path] = sorted((folder / table).glob("*.parquet"))
    return [row for file in files for row in pyarrow.parquet.read_table(file).to_pylist()]
