"""Voltage profiles: magnitude and angle of every bus, phase by phase, against its distance from the substation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection

from coordinator.lab.evaluation.comparison import Voltages
from coordinator.lab.evaluation.result import RunOutcome
from coordinator.show.figures.feeder_profile import find_distances
from coordinator.show.figures.style import (
    CENTRALISED,
    COLOUR_OF_PHASE,
    DECENTRALISED,
    LINES,
    MAX_VECTOR,
    PURPLE,
    TRUE,
    Drawing,
    new_figure,
    style_by_phase,
)
from dsse_core.estimation.state_limits import OperatingLimits
from dsse_core.grid.admittance import find_no_load
from dsse_core.grid.gauge import describe_ungrounded
from dsse_core.grid.network import Network
from dsse_core.grid.nodes import PHASES
from dsse_core.results.units import wrap_degrees

LINE_OF_PHASE: list[dict[str, Any]] = [
    {
        "colors": COLOUR_OF_PHASE[phase],
        "linewidths": 1.6 if phase else 0.7,
        "linestyles": LINES[number % 3] if phase else "solid",
        "label": f"phase {phase}" if phase else "branch",
    }
    for number, phase in enumerate(PHASES)
]
"""Style of the lines of branches, for each of PHASES."""


@dataclass(frozen=True)
class Profile:
    """Voltages of all nodes of ``network`` from several sources. ``shown``: name -> voltages and style of their marks,
    the last ones of the result itself. ``limits``: of magnitudes.
    """

    network: Network
    shown: Mapping[str, tuple[Voltages, dict[str, Any]]]
    limits: OperatingLimits


def find_profile(outcome: RunOutcome) -> Profile:
    """The profile of a run: the truth where it is known, the centralised and the decentralised estimate, of which only
    fresh numbers are shown.
    """
    comparison, fresh = outcome.comparison, outcome.buses.fresh
    found = comparison.decentralised
    of_areas = (np.where(fresh, column, np.nan) for column in (found.vm, found.va))
    shown = {
        **({"true (power flow)": (comparison.truth, TRUE)} if comparison.knows_truth else {}),
        "centralised estimate": (comparison.centralised, CENTRALISED),
        "decentralised estimate": (Voltages(*of_areas), DECENTRALISED),
    }
    return Profile(outcome.scenario.network, shown, outcome.scenario.operating_limits)


def draw_magnitudes(profile: Profile) -> Drawing:
    """Figure of the voltage profile with its limits."""
    low, high = profile.limits.lowest_vm, profile.limits.highest_vm
    *_, (voltages, _) = profile.shown.values()
    vm = np.where(voltages.vm == 0.0, np.nan, voltages.vm)  # without supply
    drawing = _draw(profile, "magnitudes", "Voltage profile", "voltage magnitude (p.u.)", lambda v: v.vm, (low, high))
    if np.isnan(vm).all():
        return drawing
    names = profile.network.node_names
    lowest, highest = int(np.nanargmin(vm)), int(np.nanargmax(vm))
    beyond = int((vm < low).sum() + (vm > high).sum())
    known = int(np.isfinite(vm).sum())
    is_balanced = profile.network.table.nodes.is_balanced
    one, many = ("bus", "buses") if is_balanced else ("phase of a bus", "phases of buses")
    facts = "" if known == len(vm) else f"Of {len(vm)} {many} {known} known. "
    facts += (
        f"Lowest: {vm[lowest]:.4f} p.u. at bus {names[lowest]}; highest: {vm[highest]:.4f} p.u. at bus "
        f"{names[highest]}. Limits: {low:g} and {high:g} p.u.; {beyond or 'no'} {one if beyond == 1 else many} beyond "
        "them."
    )
    return Drawing(drawing.name, drawing.title, f"{drawing.caption} {facts}", drawing.figure)


def draw_angles(profile: Profile) -> Drawing:
    """Figure of the voltage angles, which have no limits; of phases, a third of a turn apart, less those at no load."""
    network, of_no_load, label = profile.network, 0.0 * profile.network.table.nodes.phase, "voltage angle (degrees)"
    if not network.table.nodes.is_balanced and network.slack:
        of_no_load = find_no_load(network, network.slack.bus, None, {network.slack.bus: network.slack.va})[1]
        label = "voltage angle less that\nof no load (degrees)"
    return _draw(profile, "angles", "Voltage angles", label, lambda v: wrap_degrees(v.va - of_no_load), ())


def _draw(
    profile: Profile,
    name: str,
    title: str,
    label: str,
    of: Callable[[Voltages], np.ndarray],
    limits: tuple[float, ...],
) -> Drawing:
    network = profile.network
    *_, (voltages, _) = profile.shown.values()
    distance, x_label = find_distances(network)
    distance = distance[network.table.nodes.item]
    figure, (axis,) = new_figure(4.2)
    ours = of(voltages)
    f, t = _find_conductors(network)
    ends, phase = (
        np.stack([np.stack([distance[end], ours[end]], axis=-1) for end in (f, t)], 1),
        network.table.nodes.phase,
    )
    many = len(distance) > 200
    large = len(distance) > MAX_VECTOR
    for number in np.unique(phase[f]).tolist():
        shown = ends[np.isfinite(ends).all(axis=(1, 2)) & (phase[f] == number)]
        drawn = LineCollection(list(shown), **LINE_OF_PHASE[number], rasterized=large)
        axis.add_collection(drawn)
    for which, (voltages, style) in profile.shown.items():
        size = style | ({"markersize": style["markersize"] / 2} if many else {})
        of_phases = style_by_phase(which, size, phase) if style is TRUE else [(slice(None), size | {"label": which})]
        for chosen, own in of_phases:  # estimates stand on the lines of their phases
            axis.plot(distance[chosen], of(voltages)[chosen], linestyle="none", rasterized=large, **own)
    for number, limit in enumerate(limits):
        axis.axhline(limit, color=PURPLE, linestyle="dashed", linewidth=1.5, label="" if number else "limits")
    axis.set_xlabel(x_label)
    axis.set_ylabel(label)
    axis.margins(0.03, 0.06)
    axis.grid(alpha=0.3)
    columns = 5 if network.table.nodes.is_balanced else 3  # of lines, of true voltages, of estimates
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=columns, fontsize="small")
    measured = "the smallest sum of the branches' |r + jx|"
    what = "bus" if network.table.nodes.is_balanced else "phase of every bus"
    remark = describe_ungrounded(network.gauge.ungrounded)
    caption = f"Every {what} against its distance from the substation, {measured}. {remark}".strip()
    return Drawing(name, title, caption, figure)


def _find_conductors(network: Network) -> tuple[np.ndarray, np.ndarray]:
    """The nodes at the from and at the to end of each phase of each branch in service that has it at both."""
    table, ports, n = network.table, network.table.ports, len(network.table.active)
    at_from = np.flatnonzero(ports.item < n)
    at_to = ports.find(ports.item[at_from] + n, ports.phase[at_from])
    return table.port_node[at_from[at_to >= 0]], table.port_node[at_to[at_to >= 0]]
