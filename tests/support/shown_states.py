"""States as areas show them, for those who watch."""

from __future__ import annotations

from dataclasses import replace

from agents.messages.packing import Header, Incarnation, StateMessage


def a_state(**changes: object) -> StateMessage:
    """A good state of area1."""
    body = {
        **{"buses": (1,), "vm": (1.0,), "va": (0.0,), "sigma_vm": (0.001,), "sigma_va": (0.001,), "referenced": True},
        **{"objective": 1.0, "degrees_of_freedom": 1, "removed": (), "critical": (), "checked": True},
        **{
            "sent": {},
            "received": {},
            "messages": 5,
            "bytes": 500,
            "lost": 0,
            "rejected": {},
            "notes": (),
            "faults": {},
        },
        **{"quality": "good", "telemetry_age": 0.1, "ages": {"area2": 0.2}, "scans": {}, "old_sides": ()},
    }
    return StateMessage(Header("run", "area1", Incarnation(1, 1), 1, 1, 0.0), **(body | changes))  # type: ignore[arg-type]


def published_by(area: str, incarnation: Incarnation, **changes: object) -> StateMessage:
    return replace(a_state(**changes), header=Header("run", area, incarnation, 1, 1, 0.0))
