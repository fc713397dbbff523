"""Writer of network files: TOML with a table for each bus and branch, or JSON with a list for each key."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from dsse_core.errors import InvalidInputError
from dsse_core.files.kinds import NETWORK_FILE
from dsse_core.files.quantities import BRANCH_ID
from dsse_core.grid.loads import Load
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.nodes import Primitive, share_of_power
from dsse_core.limits import LONGEST_NAME
from dsse_core.results.units import base_current
from scenarios.files.network_columns import default_branch_id

MOST_BUSES_IN_TOML = 5000  # larger networks become JSON, which is read much faster, and larger than TOML may be


def name_network_file(n_bus: int) -> str:
    """The name of the network file that a command writes."""
    return "network.toml" if n_bus <= MOST_BUSES_IN_TOML else "network.json"


def save_network(path: Path, network: Network, data_source: str) -> None:
    """Write a network file that ``load_network`` reads back, TOML or JSON; impedances in p.u., numbers to 15 digits.

    Raises:
        InvalidInputError: listing every branch whose id a network file cannot hold.
    """
    if problems := list(_find_id_problems(network)):
        raise InvalidInputError(NETWORK_FILE.called(path), problems)
    head = {"name": network.name, "data_source": data_source, "base_mva": float(network.base_mva)}
    base = network.base_mva
    has_phases = not network.table.nodes.is_balanced
    rest = {"load": [_load_row(load, 1000 * network.node_mva) for load in network.loads]} if network.loads else {}
    rest |= {"source": [_source_row(generator, network) for generator in network.generators]}
    if path.suffix == ".json":
        branches = [_branch_row(b, network) for b in network.branches] if has_phases else _branch_columns(network)
        columns = {"bus": _bus_columns(network), "branch": branches} | rest
        path.write_text(json.dumps(head | columns), encoding="utf-8")
        return
    rows = {
        "bus": [_bus_row(bus, base) for bus in network.buses],
        "branch": [_branch_row(branch, network) for branch in network.branches],
    } | rest
    lines = [f"{key} = {format_toml(value)}" for key, value in head.items()]
    for table, items in rows.items():
        lines += ["", f"{table} = [", *(f"    {_inline(item)}," for item in items), "]"]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _bus_columns(network: Network) -> dict[str, list[Any]]:
    """A list for each key; keys of defaults only are left out."""
    buses = network.buses
    base = [network.base_mva * share_of_power(bus.phases) for bus in buses]
    columns: dict[str, list[Any]] = {
        "name": [bus.name for bus in buses],
        "phases": [bus.phases for bus in buses],
        "p_load_mw": [bus.p_load * of for bus, of in zip(buses, base, strict=True)],
        "q_load_mvar": [bus.q_load * of for bus, of in zip(buses, base, strict=True)],
        "g_shunt_mw": [bus.g_shunt * of for bus, of in zip(buses, base, strict=True)],
        "b_shunt_mvar": [bus.b_shunt * of for bus, of in zip(buses, base, strict=True)],
    }
    given: dict[str, list[Any]] = {"id": [bus.id for bus in buses], "base_kv": [bus.base_kv for bus in buses]}
    places = {key: [getattr(bus, key) for bus in buses] for key in ("x", "y")}
    given |= {key: column for key, column in columns.items() if any(column)}
    return given | {key: column for key, column in places.items() if any(value is not None for value in column)}


def _branch_columns(network: Network) -> dict[str, list[Any]]:
    """A list for each key; keys of defaults only are left out."""
    branches = network.branches
    columns: dict[str, tuple[list[Any], object]] = {
        "id": ([_written_id(branch) or "" for branch in branches], ""),
        "b_pu": ([branch.b for branch in branches], 0.0),
        "g_pu": ([branch.g for branch in branches], 0.0),
        "tap_ratio": ([branch.tap for branch in branches], 1.0),
        "tap_steps": ([branch.tap_steps for branch in branches], 0.0),
        "shift_deg": ([math.degrees(branch.shift) for branch in branches], 0.0),
        "in_service": ([branch.in_service for branch in branches], True),
        "switch": ([branch.switch for branch in branches], False),
        "name": ([branch.name for branch in branches], ""),
        "rating_a": ([_rating_a(branch, network) for branch in branches], None),
        "rating_mva": ([_rating_mva(branch, network) for branch in branches], None),
    }
    given: dict[str, list[Any]] = {
        "from": [branch.from_bus for branch in branches],
        "to": [branch.to_bus for branch in branches],
        "r_pu": [branch.r for branch in branches],
        "x_pu": [branch.x for branch in branches],
    }
    return given | {key: column for key, (column, default) in columns.items() if any(v != default for v in column)}


def _find_id_problems(network: Network) -> Iterable[str]:
    """Ids that are neither written nor those that ``load_network`` gives to the branches."""
    taken: set[str | None] = {branch.id for branch in network.branches if _written_id(branch)}
    for branch in network.branches:
        if not _written_id(branch):
            expected = default_branch_id(branch.from_bus, branch.to_bus, taken)
            taken.add(expected)
            if branch.id != expected:
                yield (
                    f"branch {branch.id!r}: a network file has ids of at most {LONGEST_NAME} lower-case letters, "
                    f"digits, _ and -, or calls this branch {expected!r}; rename it"
                )


def _written_id(branch: Branch) -> str | None:
    """The id where the file gives it; None where ``load_network`` makes it from the ends, or a file cannot hold it."""
    is_default = branch.id.partition("#")[0] == f"{branch.from_bus}-{branch.to_bus}"
    return None if is_default or not BRANCH_ID.fullmatch(branch.id) else branch.id


def _bus_row(bus: Bus, base: float) -> dict[str, object]:
    row: dict[str, object] = {"id": bus.id, "base_kv": bus.base_kv}
    if bus.name:
        row["name"] = bus.name
    if bus.phases:
        row["phases"] = bus.phases
        base *= share_of_power(bus.phases)
    for key in ("p_load", "q_load", "g_shunt", "b_shunt"):
        if power := getattr(bus, key):
            row[f"{key}_{'mw' if key in ('p_load', 'g_shunt') else 'mvar'}"] = power * base
    return row | {key: value for key in ("x", "y") if (value := getattr(bus, key)) is not None}


def _branch_row(branch: Branch, network: Network) -> dict[str, object]:
    row: dict[str, object] = {"from": branch.from_bus, "to": branch.to_bus}
    if (branch_id := _written_id(branch)) is not None:
        row["id"] = branch_id
    row |= _ports_row(branch.primitive) if branch.primitive else {"r_pu": branch.r, "x_pu": branch.x}
    optional = {
        "b_pu": (branch.b, 0.0),
        "g_pu": (branch.g, 0.0),
        "tap_ratio": (branch.tap, 1.0),
        "tap_steps": (branch.tap_steps, 0.0),
        "shift_deg": (math.degrees(branch.shift), 0.0),
        "in_service": (branch.in_service, True),
        "switch": (branch.switch, False),
        "name": (branch.name, ""),
        "rating_a": (_rating_a(branch, network), None),
        "rating_mva": (_rating_mva(branch, network), None),
    }
    return row | {key: value for key, (value, default) in optional.items() if value != default}


def _ports_row(primitive: Primitive) -> dict[str, object]:
    """The phases and the admittances over the ports, as lower triangles."""
    matrices = {"ports": primitive.y} | ({"charging": primitive.charging} if primitive.charging.any() else {})
    row: dict[str, object] = {"phases": primitive.from_phases}
    if primitive.to_phases != primitive.from_phases:
        row["to_phases"] = primitive.to_phases
    for of, matrix in matrices.items():
        for letter, part in (("g", matrix.real), ("b", matrix.imag)):
            row[f"{letter}_{of}_pu"] = [part[k, : k + 1].tolist() for k in range(len(part))]
    return row


def _load_row(load: Load, base_kw: float) -> dict[str, object]:
    row = {"bus": load.bus, "phases": load.phases, "p_kw": [load.s.real * base_kw], "q_kvar": [load.s.imag * base_kw]}
    return row | ({"exponents": list(load.exponents)} if any(load.exponents) else {})


def _rating_a(branch: Branch, network: Network) -> float | None:
    if branch.i_max is None:
        return None
    return branch.i_max * base_current(network.base_mva, network.bus(branch.from_bus).base_kv)


def _rating_mva(branch: Branch, network: Network) -> float | None:
    if branch.s_max is None:
        return None
    return branch.s_max * network.base_mva * share_of_power(branch.primitive.from_phases if branch.primitive else "")


def _source_row(generator: Generator, network: Network) -> dict[str, object]:
    base = network.base_mva * share_of_power(network.bus(generator.bus).phases)
    row: dict[str, object] = {"bus": generator.bus, "kind": str(generator.control)}
    row |= {k: p * base for k, p in (("p_mw", generator.p), ("q_mvar", generator.q)) if p}
    if generator.control is not Control.POWER:
        row["vm_pu"] = generator.vm
    if generator.control is Control.SLACK:
        row["va_deg"] = math.degrees(generator.va)
    return row


def _inline(row: Mapping[str, object]) -> str:
    return "{ " + ", ".join(f"{key} = {format_toml(value)}" for key, value in row.items()) + " }"


def format_toml(value: object) -> str:
    """``value`` as TOML; texts are JSON's, which are TOML's but for the delete character."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, list):
        return f"[{', '.join(map(format_toml, value))}]"
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(float(value)) if isinstance(value, float) else str(value)  # exact
