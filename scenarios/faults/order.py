"""Problems of events that cannot happen, or not as stated, after the events before them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from scenarios.files.fault_tables import MOMENTARY, EventTable


def find_time_problems(events: Sequence[EventTable], timeout_s: float) -> Iterable[str]:
    """Events that the time limit of the run would cut off."""
    for i, event in enumerate(events, 1):
        if _over_s(event) >= timeout_s:
            yield (
                f"faults.events[{i}]: is over {_over_s(event):g} s after the start, but run.timeout_s is "
                f"{timeout_s:g}; raise timeout_s or let it happen earlier"
            )


def find_order_problems(events: Sequence[EventTable]) -> Iterable[str]:
    """Events that meet a process that is dead, frozen or silent by then, and cuts of links that are cut already."""
    killed: dict[str, int] = {}
    lasting: dict[frozenset[str], int] = {}
    for i, event in sorted(enumerate(events, 1), key=lambda item: item[1].at_s):
        whom = frozenset(event.names)
        j = lasting.get(whom)
        if j is not None and event.at_s < _over_s(events[j - 1]):
            yield (
                f"faults.events[{i}].{event.kind}: falls into faults.events[{j}], {_describe(events[j - 1])} until "
                f"{_over_s(events[j - 1]):g} s; let it happen earlier or later"
            )
        dead = [name for name in event.names if name in killed] if event.kind not in ("restart", "cut") else []
        for name in dead:
            yield (
                f"faults.events[{i}].{event.kind}: {name} is dead by then, killed by faults.events[{killed[name]}]; "
                "restart it before, or remove one of the two"
            )
        if event.kind in MOMENTARY:
            killed.pop(event.names[0], None)
        else:
            lasting[whom] = i
        if event.kind == "kill":
            killed[event.names[0]] = i


def _over_s(event: EventTable) -> float:
    return event.at_s + (event.for_s or 0.0)


def _describe(event: EventTable) -> str:
    return f"{event.kind} {' and '.join(event.names)}"
