"""Load shapes of an OpenDSS circuit as files beside the network: shares over time, and the loads that follow them."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from dsse_core.grid.loads import Load

PROFILES, PROFILES_OF_LOADS = "profiles.csv", "profiles_of_loads.csv"


def write_profiles(
    shapes: Sequence[Mapping[str, Any]], loads: Iterable[Mapping[str, Any]], legs: Iterable[tuple[str, Load]]
) -> dict[str, str]:
    """The text of each file by its name; no file without shapes.

    ``legs``: name of the load or source of each leg, and the leg.
    """
    if not shapes:
        return {}
    rows = [["profile", "time_s", "p_share", "q_share"]]
    for shape in shapes:
        largest = max(map(abs, shape["p"]), default=0.0) or 1.0
        divisor = largest if shape["is_actual"] else 1.0
        n, times = len(shape["p"]), shape["times"]
        if len(times) != n:
            times = [k * shape["hours"] for k in range(n)]
        for hour, p, q in zip(times, shape["p"], shape["q"] or shape["p"], strict=False):
            rows.append([shape["name"], f"{hour * 3600:.9g}", repr(p / divisor), repr(q / divisor)])
    of_load = {load["name"]: load["shape"] for load in loads}
    known = {shape["name"] for shape in shapes}
    followed = [["load", "bus", "phases", "profile"]]
    for name, leg in legs:
        if of_load.get(name) in known:
            followed.append([name, str(leg.bus), leg.phases, of_load[name]])
    return {PROFILES: _write(rows), PROFILES_OF_LOADS: _write(followed)}


def _write(rows: Iterable[Sequence[str]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
