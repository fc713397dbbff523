"""Interface of subscribers to a simulation: they receive every message, state and presence, and change nothing."""

from __future__ import annotations

from collections.abc import Sequence

from agents.messages.packing import Message, ReadingsMessage, StateMessage
from agents.protocol.configuration import Configuration


class Subscriber:
    """Receives every event of the simulated bus, in order. This base class ignores them."""

    def begin(self, run: str, files: Sequence[Configuration]) -> None:
        """Takes the name of the run and its area files, before all events."""

    def take_state(self, at: float, state: StateMessage) -> None:
        """Takes a state that an area has published at ``at``."""

    def take_readings(self, at: float, readings: ReadingsMessage) -> None:
        """Takes the readings that an area has used, published at ``at``."""

    def take_presence(self, at: float, area: str, alive: bool) -> None:
        """Takes the appearance or the end of an area's presence token."""

    def take_message(self, at: float, receiver: str, message: Message, arrives: bool) -> None:
        """Takes a message to a neighbour: once when it is sent, and again when it ``arrives``."""
