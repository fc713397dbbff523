"""Areas on the bus that show a presence token and say something at each heartbeat, and do nothing else."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from agents.transport.zenoh_bus import Session
from tests.support.repeating import repeating

HEARTBEAT_S = 0.1


@contextmanager
def speaking(endpoints: Sequence[str], version: int, run: str, area: str) -> Iterator[None]:
    """One that speaks wire version ``version``, until the end of the block."""
    root = f"dsse/v{version}/{run}"
    with Session.connect(endpoints) as session:
        session.declare_presence(f"{root}/live/area/{area}/1-00000001")
        put = session.publisher(f"{root}/area/{area}/state")
        with repeating(lambda: put(b"of no version that anybody reads here"), HEARTBEAT_S):
            yield
