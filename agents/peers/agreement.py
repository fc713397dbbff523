"""Agreement of two neighbours on the entries that both area files have; a file may have been edited by hand."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

from agents.messages.packing import HeartbeatMessage, Incarnation, LoadMessage, Message
from dsse_core.grid.partition import Area


class Agreement:
    """Contradictions between each neighbour and this area, by the newest messages of the neighbour.

    ``kinds``: of the messages that only areas of ``strategy`` send. An area of another strategy answers heartbeats, so
    that it is present. It never answers messages of these kinds.
    """

    def __init__(self, area: Area, strategy: str, kinds: Collection[str]) -> None:
        self._area = area
        self._strategy = strategy
        self._kinds = frozenset(kinds)
        self._in_file: dict[str, str] = {}
        self._of_variables: dict[str, str] = {}
        self._of_other_strategy: dict[str, Incarnation] = {}

    def find_contradiction(self, message: Message) -> str:
        """Returns the contradiction between the sender of ``message`` and this area, and its cure; or ""."""
        name, incarnation = message.header.sender, message.header.incarnation
        if isinstance(message, HeartbeatMessage):
            self._in_file[name] = find_contradiction(self._area, message)
        elif message.kind in self._kinds:
            self._of_other_strategy.pop(name, None)
        elif not isinstance(message, LoadMessage):
            self._of_other_strategy[name] = incarnation
        if (variables := getattr(message, "variables", None)) is not None:
            self._of_variables[name] = compare_variables(self._area, name, variables)
        if self._of_other_strategy.get(name) == incarnation:
            return f"strategy is {self._strategy!r} here and another in the area file of {name}; correct one of them"
        return self._in_file.get(name, "") or self._of_variables.get(name, "")


def describe_boundary(area: Area, name: str) -> dict[str, Any]:
    """Returns the fields of a heartbeat to neighbour ``name`` that repeat entries of the area file."""
    return {
        "towards_hub": area.towards_hub == name,
        "is_parent": area.parent is not None and area.parent.area == name,
        "areas": area.n_areas,
        "base_mva": area.network.base_mva,
    }


def compare_variables(area: Area, name: str, found: Sequence[str]) -> str:
    """Returns the contradiction between the variables of a boundary in ``area`` and those ``found`` in a message of
    neighbour ``name``, and the keys to correct; or "".
    """
    own = area.boundaries[name].names
    if tuple(found) == own:
        return ""
    return (
        f"the boundary has the variables {', '.join(own)} here and {', '.join(found)} in the area file of {name}; "
        "correct neighbour.is_parent, neighbour.bus or neighbour.variables in one of the two area files"
    )


def find_contradiction(area: Area, message: HeartbeatMessage) -> str:
    """Returns the contradiction between the sender's area file and that of ``area``, and the key to correct; or "".

    All edges of the tree must point towards one hub. Otherwise two areas wait for each other for ever.
    """
    name = message.header.sender
    own = describe_boundary(area, name)
    for key, file_key, place in (
        ("towards_hub", "exchange.towards_hub", "lies towards the hub"),
        ("is_parent", "neighbour.is_parent", "is the parent"),
    ):
        if own[key] == getattr(message, key):
            who = f"{name} and this area each say" if own[key] else f"neither {name} nor this area says"
            return f"{who} that the other {place}; correct {file_key} in one of the two area files"
    for key, file_key in (("areas", "exchange.areas"), ("base_mva", "network.base_mva")):
        if own[key] != (found := getattr(message, key)):
            return f"{file_key} is {own[key]:g} here and {found:g} in the area file of {name}; correct one of them"
    return ""
