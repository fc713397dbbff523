"""Results of areas in the units of engineers, and the queue of each area's newest result for a sink."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from agents.messages.packing import StateMessage
from agents.protocol.quality import assess_from_outside
from coordinator.field.gateway.interface import Result
from coordinator.watch.observe.area_flows import make_area_flows
from coordinator.watch.observe.watcher import Watcher
from coordinator.watch.tables import rows_as_json
from dsse_core.errors import InvalidInputError
from dsse_core.grid.partition import Area

BUS_COLUMNS = ("bus", "name", "vm_pu", "va_deg", "vm_kv", "p_kw", "q_kvar", "sigma_vm_pu", "sigma_vm_kv")
OF_NUMBERS = ("quality", "value_age_s", "fresh")
BRANCH_COLUMNS = (
    "branch",
    "name",
    "from_bus",
    "to_bus",
    "p_from_kw",
    "q_from_kvar",
    "i_from_a",
    "p_to_kw",
    "q_to_kvar",
    "i_to_a",
    "loss_kw",
    "loading_percent",
)


def make_result(areas: Mapping[str, Area], state: StateMessage) -> Result:
    """The result in ``state``: quality and its reasons, ages, voltages in kV, flows in kW, kvar and A.

    Key ``problem``: the reason that there are no buses and branches; empty if there are.
    """
    header = state.header
    result: dict[str, Any] = {
        "run": header.run,
        "area": header.sender,
        "time": header.time,
        "scan": header.scan,
        "quality": state.quality,
        "notes": list(state.notes),
        "telemetry_age_s": state.telemetry_age,
        "oldest_reading_s": state.oldest_reading,
        "removed": list(state.removed),
        "buses": [],
        "branches": [],
        "problem": "",
    }
    if (area := areas.get(header.sender)) is None:
        return result | {"problem": "the scenario has no such area"}
    if not state.buses:
        return result | {"problem": "the area has no estimate"}
    try:
        buses, branches = make_area_flows(area, state)
    except InvalidInputError as error:
        return result | {"problem": "; ".join(error.problems)}
    of_bus, of_branch = (("phase", "unbalance_percent"), ("phase", "neutral_a")) if state.phases else ((), ())
    of_buses, of_branches = (
        (*BUS_COLUMNS, *of_bus, "injection_problem", *OF_NUMBERS),
        (*BRANCH_COLUMNS, *of_branch, *OF_NUMBERS),
    )
    return result | {
        "buses": [{key: row[key] for key in of_buses} for row in rows_as_json(buses)],
        "branches": [{key: row[key] for key in of_branches} for row in rows_as_json(branches)],
    }


class SilentAreas:
    """Finds areas of ``run`` that have fallen silent, so that a result says that their numbers are old."""

    def __init__(self, run: str, areas: Iterable[str]) -> None:
        self._watcher = Watcher(run, frozenset(areas))
        self._silent: set[str] = set()  # of which a stale state was handed out

    def take(self, state: StateMessage, now: float) -> None:
        """Takes in a state received at ``now``, s on a monotonic clock."""
        if self._watcher.take_state(state, now):
            self._silent.discard(state.header.sender)

    def find(self, now: float) -> Iterator[StateMessage]:
        """The last state of each area that has fallen silent since the last call, as stale, its ages at ``now``."""
        for area, state in self._watcher.states.items():
            if area in self._silent or not self._watcher.is_silent(area, now):
                continue
            self._silent.add(area)
            age_s = self._watcher.age_of(area, now)
            quality, notes = assess_from_outside(state, f"has sent nothing for {age_s:.1f} s")
            telemetry_age, oldest = state.telemetry_age + age_s, state.oldest_reading + age_s
            header = replace(state.header, time=state.header.time + age_s)  # at which the ages hold
            stale = replace(state, header=header, quality=quality, notes=notes)
            yield replace(stale, telemetry_age=telemetry_age, oldest_reading=oldest)


@dataclass
class ResultQueue(AsyncIterator[Result]):
    """Queue of states for a sink, the newest of each area. A slow sink gets fewer states; the bus never waits.

    ``superseded``: number of states that the sink never got. ``on_written``: called when a state has been written.
    """

    areas: Mapping[str, Area]
    on_written: Callable[[], None] = lambda: None
    written: int = 0
    superseded: int = 0
    _waiting: dict[str, StateMessage] = field(default_factory=dict)
    _is_there: asyncio.Event = field(default_factory=asyncio.Event)
    _at_sink: StateMessage | None = None

    def put(self, state: StateMessage) -> None:
        area = state.header.sender
        self.superseded += area in self._waiting
        self._waiting[area] = state
        self._is_there.set()

    def begin(self) -> None:
        """Queue the state that the last sink had in hand again, unless its area has a newer one."""
        if (state := self._at_sink) is not None:
            self._waiting.setdefault(state.header.sender, state)
            self._at_sink = None

    async def __anext__(self) -> Result:
        if self._at_sink is not None:  # written, as the sink asks for the next one
            self._at_sink = None
            self.written += 1
            self.on_written()
        while not self._waiting:
            self._is_there.clear()
            await self._is_there.wait()
        self._at_sink = self._waiting.pop(next(iter(self._waiting)))
        return make_result(self.areas, self._at_sink)
