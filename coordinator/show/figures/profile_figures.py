"""Voltage profiles: magnitude and angle of every bus against its distance from the substation."""

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
    DECENTRALISED,
    GREY,
    MAX_VECTOR,
    PURPLE,
    TRUE,
    Drawing,
    new_figure,
)
from dsse_core.estimation.state_limits import OperatingLimits
from dsse_core.grid.network import Network
from dsse_core.results.units import wrap_degrees


@dataclass(frozen=True)
class Profile:
    """Voltages of all buses of ``network`` from several sources. ``shown``: name -> voltages and style of their marks,
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
    vm = voltages.vm
    drawing = _draw(profile, "magnitudes", "Voltage profile", "voltage magnitude (p.u.)", lambda v: v.vm, (low, high))
    if np.isnan(vm).all():
        return drawing
    ids = profile.network.table.bus_id
    lowest, highest = int(np.nanargmin(vm)), int(np.nanargmax(vm))
    beyond = int((vm < low).sum() + (vm > high).sum())
    known = int(np.isfinite(vm).sum())
    facts = "" if known == len(vm) else f"Of {len(vm)} buses {known} known. "
    facts += (
        f"Lowest: {vm[lowest]:.4f} p.u. at bus {ids[lowest]}; highest: {vm[highest]:.4f} p.u. at bus {ids[highest]}. "
        f"Limits: {low:g} and {high:g} p.u.; {beyond or 'no'} bus{'' if beyond == 1 else 'es'} beyond them."
    )
    return Drawing(drawing.name, drawing.title, f"{drawing.caption} {facts}", drawing.figure)


def draw_angles(profile: Profile) -> Drawing:
    """Figure of the voltage angles, which have no limits."""
    return _draw(profile, "angles", "Voltage angles", "voltage angle (degrees)", lambda v: wrap_degrees(v.va), ())


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
    figure, (axis,) = new_figure(4.2)
    ours = of(voltages)
    ends = np.stack([np.stack([distance[end], ours[end]], axis=-1) for end in (network.table.f, network.table.t)], 1)
    shown = ends[np.isfinite(ends).all(axis=(1, 2))]
    many = len(distance) > 200
    large = len(distance) > MAX_VECTOR
    axis.add_collection(LineCollection(list(shown), colors=GREY, linewidths=0.7, label="branch", rasterized=large))
    for which, (voltages, style) in profile.shown.items():
        size = style | ({"markersize": style["markersize"] / 2} if many else {})
        axis.plot(distance, of(voltages), linestyle="none", label=which, rasterized=large, **size)
    for number, limit in enumerate(limits):
        axis.axhline(limit, color=PURPLE, linestyle="dashed", linewidth=1.5, label="" if number else "limits")
    axis.set_xlabel(x_label)
    axis.set_ylabel(label)
    axis.margins(0.03, 0.06)
    axis.grid(alpha=0.3)
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize="small")
    measured = "the smallest sum of the branches' |r + jx|"
    return Drawing(name, title, f"Every bus against its distance from the substation, {measured}.", figure)
