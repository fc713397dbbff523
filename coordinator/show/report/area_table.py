"""The areas of a scenario as text: a table with a summary, or TOML tables to paste into a scenario file."""

from __future__ import annotations

from collections.abc import Sequence

from coordinator.watch.tables import format_table
from dsse_core.grid.division import build_partition
from dsse_core.grid.partition import Partition
from dsse_core.printable import printable
from scenarios.files.saved_network import format_toml
from scenarios.scenario import Scenario

MAX_NAMED = 5


def format_areas(scenario: Scenario) -> str:
    """A row for each area (its buses, neighbours, meters), and a summary of all areas."""
    partition = scenario.partition
    owned = _count_owned(partition)
    meters = partition.split_meters(scenario.meters)
    header = ("area", "buses", "owned", "boundary buses", "parent", "variables", "children", "meters")
    rows = [
        (
            area.name,
            str(len(area.network.buses)),
            str(owned[area.name]),
            _name_some(area.boundary_buses),
            area.parent.area if area.parent else "-",
            str(area.boundaries[area.parent.area].d) if area.parent else "-",
            _name_some([n.area for n in area.neighbours if not n.is_parent]),
            str(len(meters[area.name])),
        )
        for area in partition.areas
    ]
    return "\n".join([format_table(header, rows), "", *map(printable, _summarise(partition, owned))])


def _summarise(partition: Partition, owned: dict[str, int]) -> list[str]:
    n_bus, n_area = len(partition.network.buses), len(partition.areas)
    largest, smallest = max(owned, key=owned.__getitem__), min(owned, key=owned.__getitem__)
    lines = [
        f"{partition.network.name}: {n_bus} buses in {n_area} areas; the largest, {largest}, owns {owned[largest]}, "
        f"the smallest, {smallest}, {owned[smallest]}; the mean is {n_bus / n_area:.1f}"
    ]
    if n_area > 1:
        path, boundaries = partition.longest_path, partition.boundaries
        star = max(boundaries, key=lambda bus: len(boundaries[bus]))
        shown = path if len(path) <= 2 * MAX_NAMED else (*path[:MAX_NAMED], "...", *path[-MAX_NAMED:])
        lines += [
            f"longest path of the tree: {len(path)} areas, {' - '.join(shown)}",
            f"boundary buses: {len(boundaries)} ({100 * len(boundaries) / n_bus:.2g} % of all); "
            f"at most {len(boundaries[star])} areas meet at one, at bus {star}",
        ]
    return lines


def format_area_tables(partition: Partition) -> str:
    """``[areas.NAME]`` tables that make the same areas, to paste into a scenario file."""
    holders = _find_holders(partition)
    plain = build_partition(partition.network, partition.listed, holders=holders)
    tables = []
    for area in partition.areas:
        lines = [f"[areas.{area.name}]", f"buses = {[*partition.listed[area.name]]}"]
        if held := [branch for branch, name in holders.items() if name == area.name]:
            lines += [f"holds = {format_toml(held)}"]
        if area.slack_vm is not None and area != plain.area(area.name):
            lines += [f"slack_bus = {area.slack_bus}", f"slack_vm_pu = {area.slack_vm}"]
        tables.append("\n".join(lines))
    return "\n\n".join(tables)


def _find_holders(partition: Partition) -> dict[str, str]:
    """Branch between areas -> the area that holds it."""
    return {
        branch.id: area.name
        for area in partition.areas
        for branch in area.network.branches
        if not {branch.from_bus, branch.to_bus} <= set(partition.listed[area.name])
    }


def _count_owned(partition: Partition) -> dict[str, int]:
    """Area -> number of buses that it owns."""
    return {area.name: len(area.network.buses) - len(area.not_owned) for area in partition.areas}


def _name_some(items: Sequence[object]) -> str:
    more = f", {len(items) - MAX_NAMED} more" if len(items) > MAX_NAMED else ""
    return (", ".join(map(str, items[:MAX_NAMED])) or "-") + more
