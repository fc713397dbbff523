"""A watcher's view as JSON, for ``dsse watch --json`` and for the page."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, fields
from typing import Any

from coordinator.watch.observe.causes import Cause
from coordinator.watch.observe.summary import Summary
from coordinator.watch.observe.view import AreaView, Extreme, View
from coordinator.watch.tables import columns_as_json
from dsse_core.results.table import Table

READ_BY_CAUSES = "meetings", "noted", "vanished"  # in the causes, in words
OF_AREA = tuple(field.name for field in fields(AreaView) if field.name not in ("name", *READ_BY_CAUSES))


def describe_view(view: View) -> dict[str, Any]:
    """A view as ``dsse watch --json`` prints it: areas by name."""
    names = "others", "more_others", "duplicates", "other_versions", "strangers"
    about = {name: getattr(view, name) for name in names}
    return {"run": view.run, **about, "areas": {area.name: _describe_area(area) for area in view.areas}}


def describe_causes(causes: Iterable[Cause]) -> list[dict[str, Any]]:
    """Causes as the page and ``dsse watch --json`` have them; ``text``: all in one sentence, with the time of here."""
    return [{"text": str(cause), "scope": cause.scope, "remark": cause.remark, **asdict(cause)} for cause in causes]


def _describe_area(area: AreaView) -> dict[str, Any]:
    values = {name: getattr(area, name) for name in OF_AREA}
    described = {name: _describe_extreme(v) if isinstance(v, Extreme) else v for name, v in values.items()}
    age_s, is_fresh = area.freshness.value_age_s, area.freshness.fresh
    return {"state": area.state, "fresh": is_fresh, "value_age_s": None if math.isnan(age_s) else age_s} | described


def _describe_extreme(extreme: Extreme) -> dict[str, Any]:
    return {"value": extreme.value, "at": extreme.at}


def describe_tables(tables: Mapping[str, Table]) -> dict[str, dict[str, list[Any]]]:
    """Name -> the columns of a table, each with all its values; None for unknown values."""
    return {name: columns_as_json(table) for name, table in tables.items()}


def describe_summary(summary: Summary) -> dict[str, Any]:
    """A summary by its quantities."""
    return asdict(summary)
