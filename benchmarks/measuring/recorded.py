"""Messages of areas: those in a recording, and those that a listener beside the recorder receives."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from agents.messages.keys import all_readings, all_states
from agents.messages.packing import ReadingsMessage, StateMessage, decode
from agents.transport.zenoh_bus import Session
from coordinator.watch.recording.parquet import read_rows

TABLES = ("readings", "states")
Published = tuple[str, str, int]
"""Table of a recording, area and scan."""


def subscribe(session: Session, run: str, take: Callable[[Published], None]) -> None:
    """Call ``take`` with each message that an area of ``run`` publishes of a scan."""

    def on_message(_: str, payload: bytes) -> None:
        message = decode(payload)
        if isinstance(message, StateMessage | ReadingsMessage) and message.header.scan:
            table = "states" if isinstance(message, StateMessage) else "readings"
            take((table, message.header.sender, message.header.scan))

    for expression in (all_states(run), all_readings(run)):
        session.subscribe(expression, on_message)


def read_recorded(recording: Path) -> set[Published]:
    """Entries of the closed tables in the folder ``recording``."""
    return {
        (table, area, scan)
        for table in TABLES
        for path in (recording / table).glob("*.parquet")
        for area, scan in read_rows(path, ["area", "scan"])
    }
