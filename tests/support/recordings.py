"""Recordings for the tests, made by the simulator."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from agents.messages.keys import live_key, readings_key, state_key
from agents.messages.packing import Header, Incarnation, ReadingsMessage, StateMessage, encode
from agents.protocol.configuration import Configuration
from coordinator.lab.deployment.split import area_files
from coordinator.lab.simulator.simulator import STARTED_AT, SimulatedBus
from coordinator.watch.recording.entries import APPEARED, MESSAGE, Entry
from coordinator.watch.recording.folder import begin_writing
from coordinator.watch.recording.recorder import Recorder
from coordinator.watch.recording.segment_log import SegmentLog
from scenarios.scenario import Scenario, load_scenario
from scenarios.telemetry import make_telemetry

Record = Callable[[Sequence[Entry]], Path]
"""Of the fixture ``record``."""
RUN = "grid"
AT = 1_700_000_000.0  # s since 1970, within an hour UTC
ME = Incarnation(1_700_000_000_000, 7)


def load_areas_of(scenario: Scenario | None = None) -> list[Configuration]:
    return area_files(scenario or load_scenario("ieee33"), RUN, ["tcp/127.0.0.1:7447"])


def make_state(
    content: Configuration, scan: int = 1, sequence: int = 1, at: float = AT, **fields: object
) -> StateMessage:
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


def make_readings(content: Configuration, scan: int = 1, sequence: int = 1, at: float = AT) -> ReadingsMessage:
    meters = tuple(meter.id for meter in content.meters)
    header = Header(RUN, content.area.name, ME, scan, sequence, at)
    values = tuple(0.1 * k for k in range(len(meters)))
    known = meters[:-1]  # of the last one no estimate
    return ReadingsMessage(
        header,
        at,
        meters,
        values,
        (0.01,) * len(meters),
        (at - 0.5,) * len(meters),
        estimates=tuple(value + 0.01 for value in values[: len(known)]),
        normalised=(1.5,) * len(known),
    )


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


def record_simulated(
    folder: Path,
    scans: int = 5,
    scenario: Scenario | str = "ieee33",
    between_s: float = 1.0,
    away: Mapping[str, int] | None = None,
    apart_s: float = 0.0,
    measured_at: Callable[[int, str], float] | None = None,
) -> Path:
    """Scans of ``scenario`` as the simulator has them; ``away``: area -> the scan in which it is not there.

    ``apart_s``: by how much more time, of which nothing is simulated, one scan follows the other. ``measured_at``:
    scan and meter -> when it was read, s of virtual time.
    """
    prepared = load_scenario(scenario) if isinstance(scenario, str) else scenario
    files = load_areas_of(prepared)
    with begin_writing(folder, RUN, files):
        log = SegmentLog(folder)
        recorder = Recorder(log, RUN)

        def take(at: float, message: StateMessage | ReadingsMessage) -> None:
            recorder.take([entry_of(message, STARTED_AT + at + apart_s * message.header.scan)])

        bus = SimulatedBus(files, make_telemetry(prepared, 1).by_area, take, on_readings=take)
        for scan in range(1, scans + 1):
            if scan > 1:
                for name in _find_away(away, scan - 1):
                    bus.start(name)
                for name in _find_away(away, scan):
                    bus.kill(name)
                times = {m.id: measured_at(scan, m.id) for m in prepared.meters} if measured_at else None
                bus.next_scan(make_telemetry(prepared, scan).by_area, measured_at=times)
            bus.run(between_s)
        log.close()
    return folder


def _find_away(away: Mapping[str, int] | None, scan: int) -> list[str]:
    return [name for name, gone in (away or {}).items() if gone == scan]
