"""power-grid-model's sensors as readings: p.u. and rad, injections positive into the network, flows into the branch.

``power_sigma`` is the standard deviation of the complex power, so that P and Q have ``power_sigma / sqrt(2)`` each.
The power of a node is the sum of what stands there: it is an injection only if a sensor sees every part of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from dsse_core.errors import InvalidInputError
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter
from dsse_core.grid.network import Network
from dsse_core.limits import LARGEST_SIGMA
from dsse_core.printable import listed
from scenarios.importers.imported import NO_INFORMATION, Remark, combine_readings, sum_readings
from scenarios.importers.power_grid_model.data import APPLIANCES, Data, is_asymmetric, list_sensors, rows

KIND = MeasurementKind
BASE_VA = 1e6
BRANCH_FROM, BRANCH_TO, SOURCE, SHUNT, LOAD, GENERATOR, NODE = 0, 1, 2, 3, 4, 5, 9
LOCAL_ANGLE = 0  # of a current, counted from the voltage at its place
SIGN_AT_APPLIANCE = {LOAD: -1.0, GENERATOR: 1.0, SOURCE: 1.0}
PARTS = (("p", KIND.P_INJECTION, KIND.P_FLOW), ("q", KIND.Q_INJECTION, KIND.Q_FLOW))


@dataclass(frozen=True)
class Conversion:
    """The network made of ``data``, and the names of its components here.

    ``measured``: there are sensors, and a load draws the measured power at any voltage; else each load has its own law.
    ``bus_of``: node -> bus; ``branch_of``: branch component or source -> branch id, the ``to`` bus of a source's branch
    being its node; ``shunted``: buses with shunts, which loads of constant impedance are, too, unless ``measured``.
    """

    data: Data
    measured: bool
    network: Network
    bus_of: dict[int, int]
    branch_of: dict[int, str]
    shunted: frozenset[int]


@dataclass
class _Reader:
    """The sensors read so far. ``of_appliances``: injection -> appliance -> readings of its sensors."""

    conversion: Conversion
    readings: list[Measurement] = field(default_factory=list)
    of_appliances: dict[Meter, dict[int, list[Measurement]]] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    unsupplied: list[int] = field(default_factory=list)
    uninformative: dict[int, None] = field(default_factory=dict)
    remarks: list[Remark] = field(default_factory=list)

    @cached_property
    def appliances(self) -> dict[int, int]:
        """Loads, generators and a stiff source in service at supplied nodes -> bus; else a source is a branch."""
        data, bus_of = self.conversion.data, self.conversion.bus_of
        return {
            int(a["id"]): bus_of[int(a["node"])]
            for name in (*APPLIANCES, "source")
            for a in rows(data, name)
            if a["status"] and int(a["node"]) in bus_of and int(a["id"]) not in self.conversion.branch_of
        }

    @cached_property
    def fed_buses(self) -> frozenset[int]:
        return frozenset(self.appliances.values())

    @cached_property
    def source_nodes(self) -> frozenset[int]:
        """Buses where sources behind an impedance feed."""
        network, branch_of = self.conversion.network, self.conversion.branch_of
        sources = [int(source["id"]) for source in self.conversion.data["source"]]
        return frozenset(network.branch(branch_of[source]).to_bus for source in sources if source in branch_of)


def find_metered_branches(data: Data) -> frozenset[int]:
    """The branch components that have a sensor of power or current at an end."""
    sensors = [*list_sensors(data, "power"), *list_sensors(data, "current")]
    ends = (BRANCH_FROM, BRANCH_TO)
    return frozenset(int(s["measured_object"]) for s in sensors if int(s["measured_terminal_type"]) in ends)


def read_sensors(what: str, conversion: Conversion) -> tuple[tuple[Measurement, ...], list[Remark]]:
    """The readings of a converted network, one for each meter, and remarks on the other sensors.

    Raises:
        InvalidInputError: listing every sensor that no meter here can be.
    """
    reader = _Reader(conversion)
    angles = [s for s in list_sensors(conversion.data, "voltage") if not math.isnan(s["u_angle_measured"])]
    _check_angles(reader, angles)
    for sensor in list_sensors(conversion.data, "voltage"):
        _read_voltage(reader, sensor)
    for sensor in list_sensors(conversion.data, "power"):
        _read_power(reader, sensor)
    for sensor in list_sensors(conversion.data, "current"):
        _read_current(reader, sensor)
    injections = list(_sum_injections(reader))
    if reader.problems:
        raise InvalidInputError(what, reader.problems)
    combined, remarks = combine_readings([*reader.readings, *injections])
    if reader.unsupplied:
        text = f"sensor {listed(reader.unsupplied)}: of something out of service, unsupplied or bridged by links"
        reader.remarks.append(Remark("left out", text))
    if reader.uninformative:
        reader.remarks.append(Remark("left out", f"sensor {listed(list(reader.uninformative))}: {NO_INFORMATION}"))
    return combined, [*reader.remarks, *remarks]


def _check_angles(reader: _Reader, sensors: list[Any]) -> None:
    """Leaves out a single angle, which only turns the whole grid; several angles are a problem.

    Several angles need a meter that counts from no bus.
    """
    ids = listed(list(dict.fromkeys(int(sensor["id"]) for sensor in sensors)))
    kind = "asym_voltage_sensor" if is_asymmetric(reader.conversion.data) else "sym_voltage_sensor"
    if len(sensors) == 1 and kind == "sym_voltage_sensor":
        text = f"the angle of voltage sensor {ids}: it only turns the whole grid; angles count from the substation here"
        reader.remarks.append(Remark("left out", text))
    elif sensors:
        reader.problems.append(
            f"{kind} {ids}: their angles count from a common clock, angles here from the substation; leave "
            "u_angle_measured out of all but one, with phases of all"
        )


def _read_voltage(reader: _Reader, sensor: Any) -> None:
    node = int(sensor["measured_object"])
    if node not in reader.conversion.bus_of:
        reader.unsupplied.append(int(sensor["id"]))
        return
    bus = reader.conversion.bus_of[node]
    base = reader.conversion.network.bus(bus).base_kv * 1000 / (math.sqrt(3) if _phase_of(sensor) else 1.0)
    if reading := _reading_of(reader, sensor, float(sensor["u_measured"]) / base, float(sensor["u_sigma"]) / base):
        reader.readings.append(Measurement(Meter(KIND.VM, bus, phases=_phase_of(sensor)), *reading))


def _read_power(reader: _Reader, sensor: Any) -> None:
    terminal, place = int(sensor["measured_terminal_type"]), int(sensor["measured_object"])
    if terminal in (BRANCH_FROM, BRANCH_TO):
        _read_flow(reader, sensor, _end_of(reader, place, terminal), 1.0)
    elif terminal == SHUNT:
        reader.problems.append(
            f"{_kind_of(sensor)} {sensor['id']}: the power of shunt {place} follows from the voltage; no meter reads "
            "it; remove the sensor"
        )
    elif terminal == NODE:
        _read_node(reader, sensor, place)
    elif terminal in SIGN_AT_APPLIANCE:
        _read_appliance(reader, sensor, place, SIGN_AT_APPLIANCE[terminal])
    else:
        reader.problems.append(f"{_kind_of(sensor)} {sensor['id']}: the network model has no place of type {terminal}")


def _end_of(reader: _Reader, component: int, terminal: int) -> tuple[int, str] | None:
    """(bus, branch) where a branch component is metered; None if it is not closed at both ends."""
    branch_id = reader.conversion.branch_of.get(component)
    if branch_id is None:
        return None
    branch = reader.conversion.network.branch(branch_id)
    return (branch.from_bus if terminal == BRANCH_FROM else branch.to_bus), branch_id


def _read_flow(reader: _Reader, sensor: Any, end: tuple[int, str] | None, sign: float) -> None:
    if end is None:
        reader.unsupplied.append(int(sensor["id"]))
        return
    for part, _, kind in PARTS:
        if reading := _power_of(reader, sensor, part, sign):
            reader.readings.append(Measurement(Meter(kind, *end, phases=_phase_of(sensor)), *reading))


def _kind_of(sensor: Any) -> str:
    return "asym_power_sensor" if _phase_of(sensor) else "sym_power_sensor"


def _phase_of(sensor: Any) -> str:
    """The phase of an asymmetric sensor's value; empty of a symmetric one."""
    return str(sensor["phase"]) if isinstance(sensor, dict) else ""


def _reading_of(reader: _Reader, sensor: Any, value: float, sigma: float) -> tuple[float, float] | None:
    """(value, sigma) in p.u.; None if there is no value, or a sigma that leaves it without weight."""
    if sigma > LARGEST_SIGMA:
        reader.uninformative[int(sensor["id"])] = None
    return None if math.isnan(value) or sigma > LARGEST_SIGMA else (value, sigma)


def _power_of(reader: _Reader, sensor: Any, part: str, sign: float) -> tuple[float, float] | None:
    """(value, sigma) of P or Q in p.u.; None if it is not measured."""
    value, sigma = float(sensor[f"{part}_measured"]), float(sensor[f"{part}_sigma"])
    if math.isnan(sigma):
        sigma = float(sensor["power_sigma"]) / math.sqrt(2)
    base = BASE_VA / 3 if _phase_of(sensor) else BASE_VA
    return _reading_of(reader, sensor, sign * value / base, sigma / base)


def _read_node(reader: _Reader, sensor: Any, node: int) -> None:
    """Reads the power of a node, a problem where it includes a shunt or a source behind an impedance.

    An injection meter here does not include them.
    """
    bus = reader.conversion.bus_of.get(node)
    if bus is None:
        reader.unsupplied.append(int(sensor["id"]))
    elif bus in reader.conversion.shunted or bus in reader.source_nodes:
        reader.problems.append(
            f"{_kind_of(sensor)} {sensor['id']}: the power of node {node} includes a shunt or a source behind its "
            "impedance, which no injection meter sees; put sensors at the other elements there"
        )
    elif bus not in reader.fed_buses:
        text = f"power sensor {sensor['id']} of node {node}: nothing stands there, so that it injects exactly nothing"
        reader.remarks.append(Remark("left out", text))
    else:
        for part, kind, _ in PARTS:
            if reading := _power_of(reader, sensor, part, 1.0):
                reader.readings.append(Measurement(Meter(kind, bus, phases=_phase_of(sensor)), *reading))


def _read_appliance(reader: _Reader, sensor: Any, component: int, sign: float) -> None:
    bus = reader.appliances.get(component)
    if component in reader.conversion.branch_of:  # a source behind its impedance
        _read_flow(reader, sensor, _end_of(reader, component, BRANCH_TO), -sign)
    elif bus is None:
        reader.unsupplied.append(int(sensor["id"]))
    else:
        for part, kind, _ in PARTS:
            if reading := _power_of(reader, sensor, part, sign):
                meter = Meter(kind, bus, phases=_phase_of(sensor))
                at = reader.of_appliances.setdefault(meter, {})
                at.setdefault(component, []).append(Measurement(meter, *reading))


def _sum_injections(reader: _Reader) -> Iterator[Measurement]:
    """The injections of the buses where every appliance is measured; those of other buses stay unknown."""
    at_bus: dict[int, set[int]] = {}
    for component, bus in reader.appliances.items():
        at_bus.setdefault(bus, set()).add(component)
    for meter, of_appliances in reader.of_appliances.items():
        if missing := at_bus[meter.bus] - of_appliances.keys():
            text = (
                f"sensors of {listed(sorted(of_appliances))} at bus {meter.at} ({meter.kind}): "
                f"{listed(sorted(missing))} stands there, too, without a sensor, so that they say nothing of the grid"
            )
            reader.remarks.append(Remark("left out", text))
        else:
            means = [combine_readings(readings)[0][0] for readings in of_appliances.values()]
            yield sum_readings(meter, [(m.value, m.sigma) for m in means])


def _read_current(reader: _Reader, sensor: Any) -> None:
    terminal = int(sensor["measured_terminal_type"])
    end = _end_of(reader, int(sensor["measured_object"]), terminal) if terminal in (BRANCH_FROM, BRANCH_TO) else None
    if end is None:
        reader.unsupplied.append(int(sensor["id"]))
        return
    size = math.sqrt(3) * reader.conversion.network.bus(end[0]).base_kv * 1000 / BASE_VA
    current = _reading_of(reader, sensor, float(sensor["i_measured"]) * size, float(sensor["i_sigma"]) * size)
    if current is None:
        return
    phase, sigma = float(sensor["i_angle_measured"]), float(sensor["i_angle_sigma"])
    voltage = _find_voltage(reader, end[0])
    if int(sensor["angle_measurement_type"]) == LOCAL_ANGLE and voltage and math.isfinite(phase) and sigma <= math.pi:
        for kind, reading in zip((KIND.P_FLOW, KIND.Q_FLOW), _powers(voltage, current, (phase, sigma)), strict=True):
            reader.readings.append(Measurement(Meter(kind, *end), *reading))
        return
    reader.readings.append(Measurement(Meter(KIND.CURRENT, *end), *current))
    text = f"the angle of current sensor {sensor['id']}: current meters here have a magnitude only"
    if int(sensor["angle_measurement_type"]) == LOCAL_ANGLE and not voltage:
        text += f", and no voltage sensor at bus {end[0]} makes powers of it"
    reader.remarks.append(Remark("left out", text))


def _find_voltage(reader: _Reader, bus: int) -> tuple[float, float] | None:
    """(value, sigma) of all voltage sensors of a bus together, p.u.; None without a sensor."""
    found, _ = combine_readings(m for m in reader.readings if m.meter == Meter(KIND.VM, bus))
    return (found[0].value, found[0].sigma) if found else None


def _powers(
    voltage: tuple[float, float], current: tuple[float, float], phase: tuple[float, float]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """(value, sigma) of P and of Q, p.u., from those of V, I and the angle phi by which power is ahead of 0.

    P = V I cos phi and Q = V I sin phi, their standard deviations to first order of three independent errors. The
    errors of P and Q are independent of each other where those of I / |I| and phi are alike.
    """
    (v, sigma_v), (i, sigma_i), (phi, sigma_phi) = voltage, current, phase
    p, q = v * i * math.cos(phi), v * i * math.sin(phi)
    along, across = math.hypot(sigma_v * i, sigma_i * v), v * i * sigma_phi
    sigma_p = math.hypot(along * math.cos(phi), across * math.sin(phi))
    sigma_q = math.hypot(along * math.sin(phi), across * math.cos(phi))
    return (p, sigma_p), (q, sigma_q)
