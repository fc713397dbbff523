"""Description of the API in OpenAPI 3.1: its paths, and the types of its answers, whose schemas msgspec writes."""

from __future__ import annotations

from typing import Any, Literal, NotRequired, TypedDict

import msgspec

from coordinator.lab.evaluation.answers import version_of
from coordinator.show.web.history import KINDS_WITH_A_PAST
from coordinator.watch.observe.summary import Summary

Number = float | None
"""A number; null where it is not known."""
Columns = dict[str, list[Number | str | bool]]
"""Name of a column -> its values, one for each row."""


class Health(TypedDict):
    """The server runs."""

    status: Literal["ok"]
    mode: Literal["live", "playback"]


class BusColumns(TypedDict):
    """Columns of the grid's buses; ``phase``: abc, or the phases that the bus has; ``x``, ``y``: columns and rows of
    the drawing, or coordinates where it is a map.
    """

    id: list[int]
    phase: list[str]
    name: list[str]
    base_kv: list[Number]
    x: list[float]
    y: list[float]
    distance: list[Number]
    area: list[str]
    areas: list[list[str]]


class BranchColumns(TypedDict):
    """Columns of the grid's branches."""

    id: list[str]
    from_bus: list[int]
    to_bus: list[int]
    in_service: list[bool]
    area: list[str]


class Nodes(TypedDict):
    """Columns of the nodes of a grid with phases: a row for each phase of a bus, a, b, c, s1 or s2."""

    bus: list[int]
    phase: list[str]


class Conductors(TypedDict):
    """Columns of the conductors of a grid with phases: a row for each phase of a branch."""

    branch: list[str]
    phase: list[str]


class Meeting(TypedDict):
    """A neighbour and a bus at which it meets the area."""

    area: str
    bus: int


class GridArea(TypedDict):
    """An area of the grid."""

    name: str
    buses: list[int]
    neighbours: list[Meeting]


class OperatingLimits(TypedDict):
    """Limits of the grid in operation, from the scenario's ``[quality]``."""

    lowest_vm_pu: float
    highest_vm_pu: float
    most_loading_percent: float
    most_residual: float
    most_unbalance_percent: float


class Grid(TypedDict):
    """Drawing of the grid, which rarely changes; ``known``: from a scenario, else from the states on the bus.

    ``nodes``: of a grid with phases; ``conductors``: of one that is known.
    """

    version: str
    mode: str
    known: bool
    title: str
    axis: str
    is_map: bool
    operating_limits: OperatingLimits
    buses: BusColumns
    branches: BranchColumns
    areas: list[GridArea]
    nodes: NotRequired[Nodes]
    conductors: NotRequired[Conductors]


class Event(TypedDict):
    """A change from one moment to the next, in words."""

    time: float
    area: str
    kind: str
    text: str


Link = TypedDict("Link", {"from": str, "to": str, "age_s": Number, "alive": bool})
"""Link from one area to a neighbour, as the receiver reports it."""


class RootCause(TypedDict):
    """A root cause, in words; ``effects``: of it on areas; ``since``: on the clock of ``at``.

    ``severity``: alarm or warning. ``scope``: grid or data, with a ``remark`` that says so. ``mark``: a word or two for
    a map.
    """

    text: str
    scope: str
    remark: str
    kind: str
    what: str
    action: str
    severity: str
    mark: str
    since: Number
    areas: list[str]
    buses: list[int]
    branches: list[str]
    meters: list[str]
    effects: list[str]


class Moment(TypedDict):
    """All that a page shows at one moment; before the first view only number, mode and time.

    ``buses``, ``branches``: a row for each in the order of the grid, with phases for each of its nodes and conductors;
    without a scenario with the ``id`` of each, and its ``phase``. ``fresh`` of a row: its numbers are of the present;
    quality and ``value_age_s`` are those of its area. Only fresh numbers count in ``summary``. ``worst_nodes``: where
    a bus has several rows, of each bus the row whose fresh voltage is nearest to a limit, or farthest beyond.
    """

    causes: NotRequired[list[RootCause]]
    number: int
    mode: str
    time: float
    at: NotRequired[float]
    grid_version: NotRequired[str]
    view: NotRequired[dict[str, Any]]
    summary: NotRequired[Summary]
    buses: NotRequired[Columns]
    worst_nodes: NotRequired[list[int]]
    branches: NotRequired[Columns]
    meters: NotRequired[Columns]
    meter_counts: NotRequired[dict[str, int]]
    links: NotRequired[list[Link]]
    events: NotRequired[list[Event]]
    scan_s: NotRequired[Number]
    messages: NotRequired[list[dict[str, Any]]]
    has_messages: NotRequired[bool]


class Past(TypedDict):
    """Times and columns of one bus, branch, meter or area, null where nothing fresh was there; with phases a column for
    each, such as ``vm_pu.a``. ``complete``: false where more of them will be found.
    """

    time: list[float]
    columns: dict[str, list[Number]]
    complete: bool


class Rows(TypedDict):
    """Columns of some rows of a table that has ``total`` rows; with phases a bus or branch has one for each."""

    total: int
    rows: Columns


class Frames(TypedDict):
    """Times of the moments that can be played back, s from ``since``; ``complete``: none will be added."""

    times: list[float]
    since: float
    remarks: list[str]
    complete: bool


class Problem(TypedDict):
    """The problem of a question."""

    problem: str


ANSWERS: dict[str, Any] = {
    "/health": Health,
    "/api/grid": Grid,
    "/api/now": Moment,
    "/api/stream": Moment,
    "/api/history": Past,
    "/api/rows": Rows,
    "/api/frames": Frames,
    "/api/frame/{number}": Moment,
    "/api/openapi.json": dict[str, Any],
}
"""Path -> the type of its answer."""
PATHS = {
    "/health": "Sign that the server runs, and its mode.",
    "/api/grid": "The grid, which rarely changes: buses and their places, branches, areas, limits, all in one order.",
    "/api/now": "The newest moment: areas, links, events, the worst meters, voltages in the order of the grid.",
    "/api/stream": "The same as server-sent events, at most four a second.",
    "/api/history": "The recent past of one bus, branch, meter or area: times, and a list for each column.",
    "/api/rows": "All columns of one bus, branch or meter, or of some, meters the worst first; total: of how many.",
    "/api/frames": "Times of moments that can be played back, none of a live page; remarks; complete: no more come.",
    "/api/frame/{number}": "One of these moments, as /api/now.",
    "/api/openapi.json": "This description.",
}
TEXT, WHOLE = {"type": "string"}, {"type": "integer", "minimum": 0}
PARAMETERS: dict[str, list[dict[str, Any]]] = {
    "/api/history": [
        {"name": "kind", "in": "query", "required": True, "schema": TEXT | {"enum": list(KINDS_WITH_A_PAST)}},
        {"name": "id", "in": "query", "required": True, "schema": TEXT, "description": "bus number, or id"},
    ],
    "/api/rows": [
        {"name": "kind", "in": "query", "required": True, "schema": TEXT | {"enum": ["bus", "branch", "meter"]}},
        {"name": "id", "in": "query", "schema": TEXT, "description": "of one bus, branch or meter"},
        {"name": "at", "in": "query", "schema": TEXT, "description": "of meters: the bus or branch that they are at"},
        {"name": "first", "in": "query", "schema": WHOLE, "description": "of many; 0"},
        {"name": "count", "in": "query", "schema": WHOLE, "description": "how many; 1000 at most"},
        {"name": "frame", "in": "query", "schema": WHOLE, "description": "of a playback; the last"},
    ],
    "/api/frame/{number}": [{"name": "number", "in": "path", "required": True, "schema": WHOLE}],
}
WRONG = {
    "/api/history": {"400": {"description": "the question is wrong, and why"}},
    "/api/rows": {
        "400": {"description": "the question is wrong, and why"},
        "404": {"description": "there is no such moment, and how many there are"},
    },
    "/api/frame/{number}": {"404": {"description": "there is no such moment, and how many there are"}},
}
GUARDED = {
    "401": {"description": "the page has a token, which is missing or wrong"},
    "403": {"description": "request by the page of another site"},
    "421": {"description": "request under a name that is not the page's"},
}


def describe_api() -> dict[str, Any]:
    """The OpenAPI document of all paths, which are read-only."""
    types = [*ANSWERS.values(), Problem]
    schemas, named = msgspec.json.schema_components(types, ref_template="#/components/schemas/{name}")
    answer_of, problem = dict(zip(ANSWERS, schemas, strict=False)), schemas[-1]
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "A running feeder",
            "version": version_of("consensus-dsse") or "0",
            "description": "Read-only. Units stand at the end of names: vm_pu, va_deg, p_kw.",
        },
        "paths": {path: {"get": _describe(path, text, answer_of[path], problem)} for path, text in PATHS.items()},
        "components": {"schemas": named},
    }


def _describe(path: str, text: str, answer: dict[str, Any], problem: dict[str, Any]) -> dict[str, Any]:
    media = "text/event-stream" if path == "/api/stream" else "application/json"
    wrong = {
        status: said | {"content": {"application/json": {"schema": problem}}}
        for status, said in WRONG.get(path, {}).items()
    }
    answers = {"200": {"description": text, "content": {media: {"schema": answer}}}} | wrong | GUARDED
    return {"summary": text, "parameters": PARAMETERS.get(path, []), "responses": answers}
