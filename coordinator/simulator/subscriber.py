"""Who receives the events of a simulation: every message, state and presence; a subscriber changes nothing."""

from __future__ import annotations

from collections.abc import Sequence

from agents.area_files.area_file import AreaFile
from agents.messages.packing import Message, ReadingsMessage, StateMessage


class Subscriber:
    """Receives every event of the simulated bus, in order; this one ignores them."""

    def begin(self, run: str, files: Sequence[AreaFile]) -> None:
        """Before anything else: the name of the run, and what its areas are given."""

    def take_state(self, at: float, state: StateMessage) -> None:
        """An area has published ``state``."""

    def take_readings(self, at: float, readings: ReadingsMessage) -> None:
        """An area has published the readings that it has used."""

    def take_presence(self, at: float, area: str, alive: bool) -> None:
        """An area has appeared or vanished."""

    def take_message(self, at: float, receiver: str, message: Message, arrives: bool) -> None:
        """A message to a neighbour has been sent, or ``arrives``."""
