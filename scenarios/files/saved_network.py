"""Writer of network files: TOML with a table for each bus and branch, or JSON with a list for each key."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from dsse_core.errors import InvalidInputError
from dsse_core.files.kinds import NETWORK_FILE
from dsse_core.files.quantities import BRANCH_ID
from dsse_core.grid.loads import Load, Shunt
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.nodes import Primitive, share_of_power
from dsse_core.limits import LONGEST_NAME
from dsse_core.results.units import base_current
from scenarios.files.network_columns import default_branch_id
from scenarios.files.network_phases import find_nominal_across

MOST_BUSES_IN_TOML = 5000  # larger networks become JSON, which is read much faster, and larger than TOML may be
LEFT_OUT: dict[str, object] = {"in_service": True, "switch": False, "estimate_tap": False, "tap_ratio": 1.0}
LEFT_OUT |= dict.fromkeys(("id", "name", "phases", "to_phases"), "")
LEFT_OUT |= dict.fromkeys(
    ("p_load_mw", "q_load_mvar", "g_shunt_mw", "b_shunt_mvar", "b_pu", "g_pu", "tap_steps", "shift_deg"), 0.0
)  # of a key, its value where a table leaves it out; null of others


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
    main = {
        "bus": [_bus_row(bus, base) for bus in network.buses],
        "branch": [_branch_row(branch, network) for branch in network.branches],
    }
    kw = 1000 * network.node_mva
    rest = {"load": [_load_row(load, kw) for load in network.loads]} if network.loads else {}
    rest |= {"shunt": [_shunt_row(shunt, kw) for shunt in network.shunts]} if network.shunts else {}
    rest |= {"source": [_source_row(generator, network) for generator in network.generators]}
    if path.suffix == ".json":
        columns: dict[str, Any] = {key: _columns_of(rows) or [] for key, rows in main.items()}
        path.write_text(json.dumps(head | columns | rest), encoding="utf-8")
        return
    rows = main | rest
    lines = [f"{key} = {format_toml(value)}" for key, value in head.items()]
    for table, items in rows.items():
        lines += ["", f"{table} = [", *(f"    {_inline(item)}," for item in items), "]"]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _columns_of(rows: Sequence[Mapping[str, object]]) -> dict[str, list[Any]]:
    """A list for each key that a row has; of a row without it the value that leaves it out."""
    keys = dict.fromkeys(key for row in rows for key in row)
    return {key: [row.get(key, LEFT_OUT.get(key)) for row in rows] for key in keys}


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
        "b_pu": branch.b,
        "g_pu": branch.g,
        "tap_ratio": branch.tap,
        "tap_steps": branch.tap_steps,
        "estimate_tap": branch.estimate_tap,
        "shift_deg": math.degrees(branch.shift),
        "in_service": branch.in_service,
        "switch": branch.switch,
        "name": branch.name,
        "rating_a": _rating_a(branch, network),
        "rating_mva": _rating_mva(branch, network),
    }
    return row | {key: value for key, value in optional.items() if value != LEFT_OUT.get(key)}


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


def _shunt_row(shunt: Shunt, base_kw: float) -> dict[str, object]:
    y = shunt.y * find_nominal_across(shunt.phases) ** 2 * base_kw
    return {"bus": shunt.bus, "phases": shunt.phases, "g_kw": [y.real], "b_kvar": [y.imag]}


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
