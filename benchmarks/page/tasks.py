"""Tasks of a browser's main thread by processor time, which waiting for a processor does not lengthen."""

from __future__ import annotations

import bisect
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

CATEGORIES = ("toplevel", "devtools.timeline", "disabled-by-default-devtools.timeline", "v8")
TASK = "RunTask"  # clicks and keys are served only after it ends
MAIN_THREAD = "CrRendererMain"


@dataclass(frozen=True)
class Task:
    """``cpu_ms``: processor time of the thread; ``wall_ms``: from beginning to end; ``at_ms``: since the first task.

    ``inside``: the events that took most of it, with their processor time, ms.
    """

    at_ms: float
    cpu_ms: float
    wall_ms: float
    inside: tuple[tuple[str, float], ...]


def find_tasks(trace: bytes) -> list[Task]:
    """The tasks of the main thread that has computed most, that of the page, the longest first."""
    events = json.loads(trace)["traceEvents"]
    mains = {
        (event["pid"], event["tid"])
        for event in events
        if event["name"] == "thread_name" and event["args"]["name"] == MAIN_THREAD
    }
    timed: dict[tuple[int, int], list[Mapping[str, Any]]] = {main: [] for main in mains}
    for event in events:
        if event["ph"] == "X" and "tdur" in event and (event["pid"], event["tid"]) in timed:
            timed[event["pid"], event["tid"]].append(event)
    page = max(timed.values(), key=lambda own: sum(e["tdur"] for e in own if e["name"] == TASK), default=[])
    page.sort(key=lambda event: event["ts"])
    tasks = [event for event in page if event["name"] == TASK]
    first = tasks[0]["ts"] if tasks else 0
    found = [
        Task((task["ts"] - first) / 1e3, task["tdur"] / 1e3, task["dur"] / 1e3, tuple(_look_inside(task, page)))
        for task in sorted(tasks, key=lambda event: -event["tdur"])
    ]
    return found


def _look_inside(task: Mapping[str, Any], events: Sequence[Mapping[str, Any]]) -> Iterable[tuple[str, float]]:
    """The events that took most of ``task``, with their processor time, ms; ``events``: sorted by their beginning.

    A trace has hundreds of thousands of events, and nearly as many tasks, so events are found by their time.
    """
    first, last = (
        bisect.bisect_left(events, at, key=itemgetter("ts")) for at in (task["ts"], task["ts"] + task["dur"])
    )
    within = [event for event in events[first:last] if event["name"] != TASK and event["tdur"] > 1000]
    for event in sorted(within, key=lambda e: -e["tdur"])[:8]:
        data = event.get("args", {}).get("data", {})
        what = data.get("functionName") or data.get("type") or ""
        where = f"{data['url'].rsplit('/', 1)[-1]}:{data.get('lineNumber', '')}" if data.get("url") else ""
        yield " ".join(filter(None, (event["name"], what, where))), event["tdur"] / 1e3
