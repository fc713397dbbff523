"""Who looks at a simulation: sees every message and state, and changes nothing."""

from __future__ import annotations

from collections.abc import Sequence

from agents.area_files.area_file import AreaFile
from agents.messages.packing import Message, ReadingsMessage, StateMessage


class Audience:
    """Is shown all that happens on the simulated bus, in its order; this one does not look."""

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
