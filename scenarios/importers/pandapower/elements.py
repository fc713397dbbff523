"""Elements of a pandapower network: buses of rows of its matrices, names, ratings, places, and what is left out."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from dsse_core.files.bounded_parsing import parse_json
from dsse_core.printable import listed
from scenarios.importers.imported import Remark, current_rating, rating
from scenarios.importers.pandapower.checks import BRANCHES, COLUMNS


def name_rows(net: Any, ppc: Mapping[str, Any]) -> tuple[dict[int, int], dict[int, int]]:
    """Bus -> the smallest bus that is one with it; row of the matrices ``ppc`` -> its bus, a new one at open ends."""
    row_of = net._pd2ppc_lookups["bus"]
    row_of_bus = {int(bus): int(row_of[bus]) for bus in net.bus.index if 0 <= row_of[bus] < len(ppc["bus"])}
    id_of_row: dict[int, int] = {}
    for bus, row in sorted(row_of_bus.items()):
        id_of_row.setdefault(row, bus)
    bus_of = {bus: id_of_row[row] for bus, row in row_of_bus.items()}
    new = {row: int(net.bus.index.max()) + 1 + row for row in range(len(ppc["bus"])) if row not in id_of_row}
    return bus_of, id_of_row | new


def read_place(net: Any, bus: int) -> tuple[float, float] | tuple[None, None]:
    """The place of a bus from its GeoJSON point; None where it has none."""
    try:
        x, y = parse_json(str(net.bus.geo.get(bus)))["coordinates"][:2]
        place = float(x), float(y)
    except (ValueError, TypeError, KeyError, AttributeError):  # of a table without places
        return None, None
    return place if all(map(math.isfinite, place)) else (None, None)


def describe_element(net: Any, name: str, index: int, base: float) -> dict[str, Any]:
    """Name and rating of an element, as arguments of ``Branch``; of parallel ones the rating of all together."""
    element = net[name].loc[index]
    called = element.get("name")
    described: dict[str, Any] = {"name": called if isinstance(called, str) else ""}
    many = element.get("parallel", 1) * element.get("df", 1.0)
    if name == "line":
        from_kv, to_kv = (float(net.bus.vn_kv.at[element[end]]) for end in ("from_bus", "to_bus"))
        described |= current_rating(float(element.get("max_i_ka", math.nan)) * many, from_kv, to_kv, base)
    elif name == "trafo":
        described["s_max"] = rating(float(element.sn_mva) * many, base)
    return described


def find_left_out(net: Any, bus_of: dict[int, int], converted: Collection[tuple[str, int]]) -> Iterator[Remark]:
    """Buses without supply with what stands there, and elements that are out of service."""
    dark = [int(bus) for bus in net.bus.index if bus not in bus_of]
    if dark:
        load = net.load[net.load.in_service & net.load.bus.isin(dark)]
        p_mw = float((load.p_mw * load.scaling).sum())
        yield Remark("left out", f"bus {listed(dark)} with {p_mw:g} MW of load: out of service or unsupplied")
    for name in BRANCHES:
        if missing := [int(i) for i in net[name].index if (name, int(i)) not in converted]:
            yield Remark("left out", f"{name} {listed(missing)}: out of service, open at both ends or unsupplied")
    for name in [name for name in COLUMNS if name not in ("bus", *BRANCHES)]:
        if idle := net[name].index[~net[name].in_service.astype(bool)].tolist():
            yield Remark("left out", f"{name} {listed(idle)}: out of service")
