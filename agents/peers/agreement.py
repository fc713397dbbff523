"""What the area files of two neighbours say of both, and must say alike; one of them may have been edited by hand."""

from __future__ import annotations

from typing import Any

from agents.messages.packing import HeartbeatMessage
from dsse_core.grid.partition import Area


def describe_boundary(area: Area, name: str) -> dict[str, Any]:
    """What a heartbeat to neighbour ``name`` says of the area file."""
    return {
        "towards_hub": area.towards_hub == name,
        "is_parent": area.parent is not None and area.parent.area == name,
        "areas": area.n_areas,
        "base_mva": area.network.base_mva,
    }


def find_contradiction(area: Area, message: HeartbeatMessage) -> str:
    """Where the area file of the sender contradicts that of ``area``, and which key to correct; empty if it does not.

    Without one hub towards which all edges of the tree point two areas wait for each other for ever.
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
