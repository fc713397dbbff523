"""Checks of a pandapower network before its conversion: complete, without elements that no network here holds, and
without tables and columns that pandapower's own conversion does not look at.

Columns that pandapower knows, such as ratings, costs and limits, are not reported: those that its power flow does not
use change no power flow. Other columns may be notes of a user, or have a misspelt name.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator
from numbers import Real
from typing import Any

import numpy as np

from dsse_core.files.wording import Suggestions
from dsse_core.printable import listed, shortened
from scenarios.importers.imported import Remark, find_source_problems

PLACE, POSITIVE, NUMBER, FLAG = "the index of a bus", "a positive number", "a number", "true or false"
ANYTHING, NUMBER_OR_NOTHING = "anything", "a number or nothing"
COLUMNS = {
    "bus": {"vn_kv": POSITIVE, "name": ANYTHING},
    "line": {"from_bus": PLACE, "to_bus": PLACE, "length_km": POSITIVE, "parallel": POSITIVE}
    | dict.fromkeys(("r_ohm_per_km", "x_ohm_per_km", "c_nf_per_km", "g_us_per_km"), NUMBER),
    "trafo": {"hv_bus": PLACE, "lv_bus": PLACE}
    | dict.fromkeys(("sn_mva", "vn_hv_kv", "vn_lv_kv", "vk_percent", "parallel"), POSITIVE)
    | dict.fromkeys(("vkr_percent", "pfe_kw", "i0_percent", "shift_degree"), NUMBER),
    "impedance": {"from_bus": PLACE, "to_bus": PLACE, "sn_mva": POSITIVE}
    | dict.fromkeys(("rft_pu", "xft_pu", "rtf_pu", "xtf_pu", "gf_pu", "bf_pu", "gt_pu", "bt_pu"), NUMBER),
    "ext_grid": {"bus": PLACE, "vm_pu": POSITIVE, "va_degree": NUMBER, "slack_weight": NUMBER},
    "gen": {"bus": PLACE, "vm_pu": POSITIVE, "p_mw": NUMBER, "scaling": NUMBER, "slack_weight": NUMBER},
    "shunt": {"bus": PLACE, "vn_kv": POSITIVE, "p_mw": NUMBER, "q_mvar": NUMBER, "step": NUMBER},
    "ward": {"bus": PLACE} | dict.fromkeys(("ps_mw", "qs_mvar", "pz_mw", "qz_mvar"), NUMBER),
    "motor": {"bus": PLACE, "efficiency_percent": POSITIVE, "cos_phi": POSITIVE}
    | dict.fromkeys(("pn_mech_mw", "loading_percent", "scaling"), NUMBER),
} | {
    name: {"bus": PLACE} | dict.fromkeys(("p_mw", "q_mvar", "scaling"), NUMBER) for name in ("load", "sgen", "storage")
}
"""Element table -> the columns that the conversion uses, and what stands there."""
ASYMMETRIC = ("asymmetric_load", "asymmetric_sgen")
BY_PHASE = {f"{part}_{phase}_{unit}": NUMBER for phase in "abc" for part, unit in (("p", "mw"), ("q", "mvar"))}
COLUMNS |= {name: {"bus": PLACE, "type": ANYTHING, "scaling": NUMBER} | BY_PHASE for name in ASYMMETRIC}
BRANCHES = ("line", "trafo", "impedance")
"""Tables whose numbers are checked only in service; pandapower multiplies those of other tables by 0 instead."""
ALL_COLUMNS = {name: columns | {"in_service": FLAG} for name, columns in COLUMNS.items()} | {
    "switch": {"bus": PLACE, "element": NUMBER, "et": ANYTHING, "closed": FLAG, "z_ohm": NUMBER},
    "measurement": {"element": NUMBER, "value": NUMBER_OR_NOTHING, "std_dev": NUMBER_OR_NOTHING}
    | dict.fromkeys(("measurement_type", "element_type", "side"), ANYTHING),
}
ALWAYS_DIVIDED_BY = ("sn_mva", "vk_percent")
"""Columns of these tables that are checked out of service, too: pandapower divides by them in any case."""
SHARES = tuple(f"const_{kind}_{part}_percent" for kind in "zi" for part in "pq")
"""Columns that the table of loads may have."""
SWITCHED = {"b": "bus", "l": "line", "t": "trafo"}
"""Type of a switch -> the table of its element."""
LARGEST_INDEX = 10_000_000  # pandapower makes arrays of this length
SUPPORTED = {*COLUMNS, "switch"}
NO_ELEMENTS = {"controller", "measurement"}
LONGEST_SHOWN = 80  # characters of a name
NOT_NEEDED = {"bus_geodata", "line_geodata", "characteristic", "poly_cost", "pwl_cost", "group", "measurement"}
"""Tables that change no power flow."""


def find_broken(net: Any) -> Iterator[str]:
    """Every missing table or column, reference to a missing index, and number that cannot be computed with."""
    for name in ("sn_mva", "f_hz"):
        if not _is_positive(net.get(name)):
            yield f"{name} is {net.get(name)!r}; {POSITIVE} is expected"
    if missing := [name for name in ALL_COLUMNS if not hasattr(net.get(name), "columns")]:
        yield f"table {listed(missing)} is missing"
        return
    bad = {name: [i for i in net[name].index if not _is_index(i)] for name in ALL_COLUMNS}
    if any(bad.values()):
        for name, found in bad.items():
            if found:
                named = listed([f"{i!s:.40}" for i in found])
                yield f"{name} {named}: an index is a whole number, 0 to {LARGEST_INDEX}"
        return
    for name, columns in ALL_COLUMNS.items():
        table = net[name]
        if repeated := sorted(set(table.index[table.index.duplicated()])):
            yield f"{name} {listed(repeated)}: defined more than once"
        if len(table) and (missing := [column for column in columns if column not in table.columns]):
            yield f"table {name} has {len(table)} elements but no column {listed(missing)}"
        elif len(table):
            shares = [column for column in SHARES if name == "load" and column in table.columns]
            yield from _find_broken_elements(net, name, columns | dict.fromkeys(shares, NUMBER))


def _find_broken_elements(net: Any, name: str, columns: dict[str, str]) -> Iterator[str]:
    table, buses = net[name], set(net.bus.index)
    for column, expected in columns.items():
        only_working = name in BRANCHES and expected in (POSITIVE, NUMBER) and column not in ALWAYS_DIVIDED_BY
        used = table[table.in_service.astype(bool)] if only_working else table
        values = zip(used.index, used[column], strict=True)
        yield from _describe(name, column, expected, [(i, v) for i, v in values if not _is(v, expected, buses)])
    if name == "trafo":
        both = zip(table.index, table.vk_percent, table.vkr_percent, strict=True)
        bad = [(i, vkr) for i, vk, vkr in both if _is_positive(vk) and _is_number(vkr) and abs(vkr) > vk]
        yield from _describe(name, "vkr_percent", "a number that is at most vk_percent", bad)
    if name == "switch":
        yield from _find_lost_switches(net)


def _find_lost_switches(net: Any) -> Iterator[str]:
    """Switches of elements that are not there."""
    kinds = net.switch.et
    others = net.switch[~kinds.isin([*SWITCHED, "t3"])]  # t3: at three-winding transformers, rejected by themselves
    yield from _describe("switch", "et", f"one of {listed(list(SWITCHED))}", list(others.et.items()))
    for kind, name in SWITCHED.items():
        there = set(net[name].index)
        bad = [(i, v) for i, v in net.switch.element[kinds == kind].items() if not _is(v, PLACE, there)]
        yield from _describe("switch", "element", f"the index of a {name} (et is {kind!r})", bad)


def _describe(name: str, column: str, expected: str, bad: list[tuple[Any, Any]]) -> Iterator[str]:
    if bad:
        found = listed(list(dict.fromkeys(str(value) for _, value in bad)))
        yield f"{name} {listed([i for i, _ in bad])}: {column} is {found}; {expected} is expected"


def _is(value: Any, expected: str, there: set[Any]) -> bool:
    """True where ``value`` is as ``expected``; ``there``: the indices that a PLACE may be."""
    if expected == PLACE:
        return _is_number(value) and value in there
    checks = {POSITIVE: _is_positive, NUMBER: _is_number, NUMBER_OR_NOTHING: _is_number_or_nothing, FLAG: _is_flag}
    return checks.get(expected, _is_anything)(value)


def _is_index(value: Any) -> bool:
    return isinstance(value, int | np.integer) and 0 <= int(value) <= LARGEST_INDEX


def _is_anything(_: Any) -> bool:
    return True


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def _is_number_or_nothing(value: Any) -> bool:
    """True for None and all real numbers: an infinite standard deviation has a meaning, and so may nan."""
    return value is None or (isinstance(value, Real) and not isinstance(value, bool))


def _is_positive(value: Any) -> bool:
    return _is_number(value) and value > 0


def _is_flag(value: Any) -> bool:
    return isinstance(value, Real | np.bool_) and value in (True, False)


def find_unsupported(net: Any) -> Iterator[str]:
    """Every element in service that the network model cannot hold, and sources that are not exactly one.

    Loads of constant current are among them where nothing is measured.
    """
    for name in sorted(net.keys()):
        table = net[name]
        if name.startswith(("res_", "_")) or name in SUPPORTED | NO_ELEMENTS or not hasattr(table, "columns"):
            continue
        if "in_service" in table.columns and len(working := table.index[table.in_service.astype(bool)]):
            named = f"{name} {listed(list(working))}"
            yield f"{named}: the network model cannot hold it; replace it, or take it out of service"
    sources = [(f"ext_grid {i}", int(bus)) for i, bus in net.ext_grid.bus[net.ext_grid.in_service].items()]
    if "slack" in net.gen.columns:
        slack = net.gen.in_service & net.gen.slack.astype(bool)
        sources += [(f"gen {i}", int(bus)) for i, bus in net.gen.bus[slack].items()]
    if len(sources) != 1:
        how = "take the ext_grids and slack gens of the others out of service, or use pandapower.select_subnet"
        yield from find_source_problems(sources, _find_islands(net), how)
    if not len(net.measurement):
        yield from find_constant_currents(net)


def _find_islands(net: Any) -> dict[int, int]:
    """Bus in service -> the smallest bus of its island."""
    topology = importlib.import_module("pandapower.topology")
    islands = topology.connected_components(topology.create_nxgraph(net))
    working = set(net.bus.index[net.bus.in_service.astype(bool)])
    return {int(bus): int(min(island)) for island in islands for bus in island if bus in working}


def find_constant_currents(net: Any) -> Iterator[str]:
    """Every load with a share of constant current, whose power the network model cannot compute.

    Where the load is measured, that power is not needed.
    """
    for part in ("p", "q"):
        column = f"const_i_{part}_percent"
        if column in net.load.columns and len(bad := net.load.index[net.load.in_service & (net.load[column] != 0)]):
            named = f"load {listed(list(bad))}"
            yield f"{named}: {column} is not 0; the network model holds constant power and impedance only"


def find_unread(net: Any) -> Iterator[Remark]:
    """Columns that pandapower does not know, tables of its elements that are not its own, and controllers."""
    tables = importlib.import_module("pandapower.network_structure").get_structure_dict()  # in which nothing is made
    for name in ALL_COLUMNS:
        known = set(tables[name]) | _columns_in_schema(name)
        meant = Suggestions(sorted(known))
        strange = [str(column) for column in net[name].columns if column not in known] if len(net[name]) else []
        if strange:
            shown = [f"{shortened(column, LONGEST_SHOWN)}{meant.find(column)}" for column in strange]
            yield Remark("left out", f"columns of table {name} that pandapower does not know: {listed(shown)}")
    foreign = [
        shortened(str(name), LONGEST_SHOWN)
        for name, table in net.items()
        if name not in tables and name not in NOT_NEEDED and not str(name).startswith(("res_", "_"))
        if hasattr(table, "columns") and len(table)
    ]
    if foreign:
        yield Remark("left out", f"table {listed(foreign)}: pandapower has no elements of this name")
    controllers = net.get("controller")  # not a table where a strange file has it so
    if hasattr(controllers, "columns") and len(controllers):
        yield Remark("left out", f"controller {listed(list(controllers.index))}: not run, taps stay where they are")


def _columns_in_schema(name: str) -> set[str]:
    """Columns that pandapower knows beyond those of its empty tables."""
    schema = getattr(importlib.import_module(f"pandapower.network_schema.{name}"), f"{name}_schema")
    return set(schema.columns)
