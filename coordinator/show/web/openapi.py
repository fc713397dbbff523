"""Description of the API in OpenAPI 3.1."""

from __future__ import annotations

from typing import Any

from coordinator.lab.evaluation.answers import version_of
from coordinator.show.web.history import KINDS

PATHS = {
    "/health": "Whether the server runs, and in which mode.",
    "/api/grid": "What does not change: buses with their places, branches, areas, limits. Columns have one order.",
    "/api/now": "The newest moment: areas, links, events, the worst meters, voltages in the order of the grid.",
    "/api/stream": "The same as server-sent events, at most four a second.",
    "/api/history": "The recent past of one bus, branch, meter or area: times, and a list for each column.",
    "/api/rows": "All columns of one bus, branch or meter, or of some, meters the worst first; total: of how many.",
    "/api/frames": "Times of the moments that can be played back, none of a live page; remarks; complete: all?",
    "/api/frame/{number}": "One of them, as /api/now.",
    "/api/openapi.json": "This description.",
}
TEXT, WHOLE = {"type": "string"}, {"type": "integer", "minimum": 0}
PARAMETERS: dict[str, list[dict[str, Any]]] = {
    "/api/history": [
        {"name": "kind", "in": "query", "required": True, "schema": TEXT | {"enum": list(KINDS)}},
        {"name": "id", "in": "query", "required": True, "schema": TEXT, "description": "bus number, or id"},
    ],
    "/api/rows": [
        {"name": "kind", "in": "query", "required": True, "schema": TEXT | {"enum": ["bus", "branch", "meter"]}},
        {"name": "id", "in": "query", "schema": TEXT, "description": "of one row"},
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
    "403": {"description": "asked for by the page of another site"},
    "421": {"description": "asked for under a name that is not the page's"},
}


def describe_api() -> dict[str, Any]:
    """The OpenAPI document of all paths, which are read-only."""
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "A running feeder",
            "version": version_of("consensus-dsse") or "0",
            "description": "Read-only. Units stand at the end of names: vm_pu, va_deg, p_kw.",
        },
        "paths": {path: {"get": _describe(path, text)} for path, text in PATHS.items()},
    }


def _describe(path: str, text: str) -> dict[str, Any]:
    media = "text/event-stream" if path == "/api/stream" else "application/json"
    answers = {"200": {"description": text, "content": {media: {}}}} | WRONG.get(path, {}) | GUARDED
    return {"summary": text, "parameters": PARAMETERS.get(path, []), "responses": answers}
