"""Branches, transformers and loads of a network file with phases: admittances over ports, and legs, in per unit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from dsse_core.grid.loads import Load, Shunt
from dsse_core.grid.nodes import (
    PHASE_ANGLE,
    PHASES,
    Primitive,
    explain_phases,
    list_phases,
    read_phases,
    share_of_power,
)
from dsse_core.grid.physical_ranges import (
    ADMITTANCE,
    BASE_POWER,
    BASE_VOLTAGE,
    EXPONENT,
    IMPEDANCE,
    PERCENT,
    PORT_ADMITTANCE,
    TAP_OF_WINDING,
    Range,
)
from dsse_core.grid.primitives import (
    NEUTRAL,
    Connection,
    Side,
    build_bank,
    build_centre_tapped,
    build_line,
    connect,
    find_size,
)
from dsse_core.printable import listed
from scenarios.files.network_tables import (
    IMPEDANCES,
    OF_PHASES,
    PORTS,
    BranchTable,
    LoadTable,
    Matrix,
    NetworkFile,
    ShuntTable,
    TransformerTable,
    WindingTable,
)

POSITIVE = -1e-9  # least eigenvalue of a resistance, of its largest entry: below it the line would produce power
SINGULAR = 1e12  # condition of an impedance whose inverse has no digits
MOST_OFF_NOMINAL = 4 / 3  # of a winding: below 3^0.5, by which one given to ground instead of between lines is off
HALVES = ("centre-tapped",)  # the winding of a unit with two halves, s1 and s2
LAGGING = (1, 7)  # clocks of a wye and a delta whose low side lags by 30 degrees, and half a turn
HALF_TURN = (5, 6, 7)  # clocks of windings whose ends are exchanged
CLOCKS = {True: (1, 5, 7, 11), False: (0, 6)}  # by: one side is a delta and the other is not


@dataclass
class PhaseParts:
    """The parts of a network file that have phases, and all ``problems`` of them, as text.

    ``branches``: those of the file, then its transformers, each with the size of its admittances for an impedance.
    ``primitives``: their admittances, without any value of a branch that has a problem.
    """

    branches: list[BranchTable] = field(default_factory=list)
    primitives: list[Primitive] = field(default_factory=list)
    loads: list[Load] = field(default_factory=list)
    shunts: list[Shunt] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Place:
    """A table of the file at ``key``; ``kv``, ``phases``: of each bus of the file; ``problems``: found so far."""

    key: str
    base_mva: float
    kv: Mapping[int, float]
    phases: Mapping[int, str]
    problems: list[str]

    def refuse(self, key: str, problem: str) -> None:
        self.problems.append(f"{self.key}{f'.{key}' if key else ''}: {problem}")

    def check(self, limits: Range, key: str, values: np.ndarray | Sequence[float] | float) -> None:
        """Refuses the first of ``values`` that lies outside ``limits``, in the unit of these."""
        for value in np.ravel(values).tolist():
            if found := list(limits.find_problem(f"{self.key}.{key}", value)):
                self.problems.extend(found)
                return


def find_parts_with_phases(file: NetworkFile) -> list[str]:
    """The keys of the tables of ``file``, but those of buses, that only a network with phases has."""
    branches = file.branch if isinstance(file.branch, list) else []
    found = [f"branch[{k}]" for k, branch in enumerate(branches, 1) if _has_phases(branch)]
    return found + [key for key in ("transformer", "load", "shunt") if getattr(file, key)]


def _has_phases(branch: BranchTable) -> bool:
    given = branch.model_fields_set
    return not OF_PHASES.isdisjoint(given) or any(isinstance(getattr(branch, key), list) for key in IMPEDANCES & given)


def read_phase_parts(file: NetworkFile, kv: Mapping[int, float], phases: Mapping[int, str]) -> PhaseParts:
    """The parts of ``file``, whose buses have phases; ``kv``, ``phases``: of each bus, kV between lines."""
    parts = PhaseParts()
    assert isinstance(file.branch, list)  # the caller refuses lists

    def place(key: str) -> _Place:
        return _Place(key, file.base_mva, kv, phases, parts.problems)

    for k, branch in enumerate(file.branch, 1):
        _add(parts, branch, _read_branch(branch, place(f"branch[{k}]")))
    for k, bank in enumerate(file.transformer, 1):
        named = {key: getattr(bank, key) for key in ("id", "in_service", "name", "rating_mva")}
        ends = BranchTable.model_construct(from_=bank.windings[0].bus, to=bank.windings[-1].bus, **named)
        _add(parts, ends, _read_bank(bank, place(f"transformer[{k}]")))
    for k, load in enumerate(file.load, 1):
        parts.loads += _read_loads(load, place(f"load[{k}]"))
    for k, shunt in enumerate(file.shunt, 1):
        parts.shunts += _read_shunts(shunt, place(f"shunt[{k}]"))
    for k, source in enumerate(file.source, 1):
        if source.kind == "voltage":
            problem = "no source but the slack holds the voltage of phases; use kind 'power' with p_mw and q_mvar"
            place(f"source[{k}]").refuse("kind", problem)
        elif source.kind == "slack":
            _check_phases_of_slack(source.bus, place(f"source[{k}]"))
    return parts


def _check_phases_of_slack(bus: int, place: _Place) -> None:
    """Refuses a substation without a phase of a, b, c that other buses have; banks make s1 and s2."""
    held = {*list_phases(place.phases.get(bus, ""))}
    others = {phase: of for of, phases in list(place.phases.items())[::-1] for phase in list_phases(phases)}
    if held and (lacking := sorted({*others} & {*"abc"} - held)):
        beyond = ", ".join(f"{others[phase]}.{phase}" for phase in lacking)
        problem = (
            f"the substation holds phase {', '.join(sorted(held))} of bus {bus} only, and the network has {beyond}"
        )
        place.refuse("bus", f"{problem}; give a bus with all phases")


def _add(parts: PhaseParts, branch: BranchTable, primitive: Primitive) -> None:
    """Adds a branch; its rating becomes that of three phases as much loaded."""
    size, update = find_size(primitive), dict[str, object](dict.fromkeys(IMPEDANCES | PORTS))
    if branch.rating_mva is not None:
        update["rating_mva"] = branch.rating_mva / share_of_power(primitive.from_phases)
    parts.branches.append(branch.model_copy(update=update | {"r_pu": size.real, "x_pu": size.imag}))
    parts.primitives.append(primitive)


def _read_branch(table: BranchTable, place: _Place) -> Primitive:
    """A line by its impedances, or a branch of any kind by its admittances over its ports."""
    before, phases = len(place.problems), table.phases
    if not phases:
        place.refuse("phases", "missing; in a network with phases each branch says those that it joins")
        phases = _shared(place, table.from_, table.to)
    for key, default in (("tap_ratio", 1.0), ("tap_steps", 0.0), ("shift_deg", 0.0)):
        if getattr(table, key) != default:
            place.refuse(key, "a branch with phases is a line; give a [[transformer]]")
    if table.estimate_tap:
        place.refuse("estimate_tap", "taps of networks with phases are not estimated; leave it out")
    at_to = table.to_phases or phases
    for key, text in (("phases", phases), ("to_phases", table.to_phases)):
        if text and not read_phases([text])[0]:
            place.refuse(key, explain_phases(text))
    if len(place.problems) > before:
        return _without_value(phases, at_to)
    if table.g_ports_pu is not None or table.b_ports_pu is not None:
        return _read_ports(table, phases, at_to, place)
    if table.to_phases:
        place.refuse("to_phases", "a line has the same phases at both ends; leave it out, or give g_ports_pu")
    return _read_line(table, phases, place)


def _read_ports(table: BranchTable, phases: str, at_to: str, place: _Place) -> Primitive:
    n, names = len(list_phases(phases)) + len(list_phases(at_to)), f"ports {phases} and {at_to}"
    matrices = [
        np.zeros((n, n)) if (rows := getattr(table, key)) is None else _fill(rows, n, names, key, place)
        for key in ("g_ports_pu", "b_ports_pu", "g_charging_pu", "b_charging_pu")
    ]
    g, b, g_charging, b_charging = matrices
    return Primitive(phases, at_to, g + 1j * b, g_charging + 1j * b_charging)


def _read_line(table: BranchTable, phases: str, place: _Place) -> Primitive:
    before, kv = len(place.problems), place.kv.get(table.from_, 1.0)
    z_base, unit = (kv * kv / place.base_mva, ("ohm", "us")) if table.is_in_ohm else (1.0, ("pu", "pu"))
    if kv != (at_to := place.kv.get(table.to, kv)):
        problem = (
            f"the line joins bus {table.from_} of {kv} kV and bus {table.to} of {at_to} kV; give a [[transformer]]"
        )
        place.refuse(f"r_{unit[0]}", problem)

    def read(letter: str, unit: str) -> np.ndarray:
        return _expand(table, f"{letter}_{unit}", f"{letter}0_{unit}", phases, place)

    z = (read("r", unit[0]) + 1j * read("x", unit[0])) / z_base
    charging = read("g", unit[1]) + 1j * read("b", unit[1])
    charging = charging * 1e-6 * z_base if table.is_in_ohm else charging
    place.check(IMPEDANCE, f"r_{unit[0]}", z.real)
    place.check(IMPEDANCE, f"x_{unit[0]}", z.imag)
    place.check(ADMITTANCE, f"g_{unit[1]}", charging.real)
    place.check(ADMITTANCE, f"b_{unit[1]}", charging.imag)
    if len(place.problems) == before:
        if np.linalg.eigvalsh(z.real)[0] < POSITIVE * abs(z.real).max():
            problem = "the matrix is not positive, a line of it would produce power; correct the entries between phases"
            place.refuse(f"r_{unit[0]}", problem)
        elif not np.linalg.cond(z) < SINGULAR:
            place.refuse(f"x_{unit[0]}", "with r the impedances are singular; correct them, or merge the two buses")
    return build_line(phases, z, charging) if len(place.problems) == before else _without_value(phases, phases)


def _expand(table: BranchTable, key: str, zero_key: str, phases: str, place: _Place) -> np.ndarray:
    """The matrix of a key between ``phases``: of its rows, or of a number and that of the zero sequence."""
    n, value, zero = len(list_phases(phases)), getattr(table, key), getattr(table, zero_key, None)
    if isinstance(value, list):
        if zero is not None:
            place.refuse(zero_key, f"{key} has an entry for each two phases; leave it out")
        return _fill(value, n, f"phases {phases}", key, place)
    if value is None and zero is not None:
        place.refuse(zero_key, f"stands beside {key}, which is missing; give it")
    value = value or 0.0
    between = 0.0 if zero is None else (zero - value) / 3
    return np.full((n, n), between) + value * np.eye(n)


def _fill(rows: Matrix, n: int, of: str, key: str, place: _Place) -> np.ndarray:
    """The symmetric matrix with the rows of a lower triangle."""
    assert isinstance(rows, list)
    matrix = np.zeros((n, n))
    if (found := [len(row) for row in rows]) != [*range(1, n + 1)]:
        wanted = ", ".join(map(str, range(1, n + 1)))
        has = ", ".join(map(str, found)) or "no"
        problem = f"its rows have {has} numbers; the lower triangle of {of} has rows of {wanted}"
        place.refuse(key, problem)
        return matrix
    for k, row in enumerate(rows):
        matrix[k, : k + 1] = matrix[: k + 1, k] = row
    return matrix


def _read_bank(table: TransformerTable, place: _Place) -> Primitive:
    before, windings = len(place.problems), table.windings
    if len(windings) != 2:
        joined = listed(dict.fromkeys(winding.bus for winding in windings))
        problem = (
            f"{len(windings)} windings at bus {joined}; a bank has two, and no element joins three buses; "
            f"give a bank from bus {windings[0].bus} to each other one"
        )
        place.refuse("windings", problem)
        return _without_value(windings[0].phases, windings[-1].phases)
    at_from, at_to = (_read_side(winding, table, k, place) for k, winding in enumerate(windings))
    place.check(BASE_POWER, "kva", table.kva / 1000)
    for percent in ("r_percent", "x_percent", "no_load_percent", "magnetising_percent"):
        place.check(PERCENT, percent, getattr(table, percent))
    if len(place.problems) == before and len(at_from.legs) != len(at_to.legs):
        place.refuse("windings", f"{len(at_from.legs)} and {len(at_to.legs)} windings; each unit has one at both sides")
    if len(place.problems) > before:
        return _without_value(windings[0].phases, windings[1].phases)
    of_unit = table.kva / 1000 / len(at_from.legs) / (place.base_mva / 3)
    z = complex(table.r_percent / 100 / of_unit, table.x_percent / 100 / of_unit)
    if not 1 / PORT_ADMITTANCE.most <= abs(z) <= IMPEDANCE.most:
        limits = f"{1 / PORT_ADMITTANCE.most:g} and {IMPEDANCE.most:g}"
        place.refuse("x_percent", f"the impedance of a unit is {abs(z):g} p.u.; it must lie between {limits}")
        return _without_value(windings[0].phases, windings[1].phases)
    idle = complex(table.no_load_percent, -table.magnetising_percent) / 100 * of_unit
    place.check(ADMITTANCE, "no_load_percent", idle.real)
    place.check(ADMITTANCE, "magnetising_percent", -idle.imag)
    if at_to.legs == HALVES:
        return build_centre_tapped(at_from, at_to, z, idle)
    return build_bank(at_from, at_to, 1 / z, idle)


def _read_side(winding: WindingTable, table: TransformerTable, k: int, place: _Place) -> Side:
    """Side ``k`` of a bank; its turns at the nominal voltage of its bus are 1 p.u. between a phase and ground."""
    before, key, phases = len(place.problems), f"windings[{k + 1}]", winding.phases
    place.check(BASE_VOLTAGE, f"{key}.kv", [winding.kv])
    place.check(TAP_OF_WINDING, f"{key}.taps", winding.taps)
    if not read_phases([phases])[0]:
        place.refuse(f"{key}.phases", explain_phases(phases))
        return Side("", (), ())
    is_delta, other = winding.connection == "delta", table.windings[1 - k]
    clocks = CLOCKS[is_delta != (other.connection == "delta")]
    clock = clocks[0] if table.clock is None else table.clock
    if k == 0 and clock not in clocks:
        known = " or ".join(map(str, clocks))
        place.refuse("clock", f"is {clock}; of {winding.connection!r} to {other.connection!r} it is {known}")
    nominal = place.kv.get(winding.bus, winding.kv)
    if not 1 / MOST_OFF_NOMINAL <= winding.kv / nominal <= MOST_OFF_NOMINAL:
        problem = (
            f"is {winding.kv:g}, and bus {winding.bus} has base_kv {nominal:g}; both are between lines, correct one"
        )
        place.refuse(f"{key}.kv", problem)
    is_low = winding.kv < other.kv or (winding.kv == other.kv and k == 1)
    connection: Connection = "grounded"
    legs: tuple[str, ...] | None = None
    if winding.connection == "wye":
        connection = "wye"
    elif is_delta:
        connection = "delta" if clock in CLOCKS[False] or is_low == (clock in LAGGING) else "delta reversed"
    elif winding.connection == HALVES[0]:
        legs = HALVES
        if k == 0 or phases != "s1s2":
            place.refuse(f"{key}.connection", f"{winding.connection!r} is of the second side, with phases s1s2")
    elif winding.connection != "grounded wye":
        legs = _read_windings(winding, key, place)
    if connection != "grounded" and len(list_phases(phases)) < 3:
        place.refuse(f"{key}.connection", f"{winding.connection!r} needs three phases; say where each winding stands")
    if len(place.problems) > before:
        return Side(phases, (), ())
    turns = winding.kv / nominal * np.asarray(winding.taps)
    turns = -turns if k == 1 and clock in HALF_TURN else turns
    n = len(list_phases(phases)) if legs is None else len(legs)
    if turns.ndim and len(turns) != n:
        place.refuse(f"{key}.taps", f"is {winding.taps}; give one number, or one for each of the windings, {n}")
        return Side(phases, (), ())
    if legs is None:
        return connect(phases, connection, turns.tolist())
    across = np.array([math.sqrt(3) if len(list_phases(leg)) == 2 else 1.0 for leg in legs])
    return Side(phases, legs, tuple((across * turns).tolist()))


def _read_windings(winding: WindingTable, key: str, place: _Place) -> tuple[str, ...]:
    """The place of each winding, such as "ab" or "an"."""
    legs, known = winding.connection.split(","), list_phases(winding.phases)
    for leg in legs:
        ends = list_phases(leg.removesuffix(NEUTRAL)) if leg != NEUTRAL else []
        if (
            leg == ""
            or not 1 <= len(ends) <= 2 - leg.endswith(NEUTRAL)
            or not {*ends} <= {*known}
            or len({*ends}) < len(ends)
        ):
            problem = (
                f"{leg!r} is no winding; give 'grounded wye', 'wye', 'delta', 'centre-tapped', or where each winding "
                f"stands, such as 'ab,bc' or 'an,bn', by phases of {', '.join(known)}"
            )
            place.refuse(f"{key}.connection", problem)
    return tuple(legs)


def _read_legs(table: LoadTable | ShuntTable, keys: tuple[str, str], place: _Place) -> tuple[list[str], np.ndarray]:
    """The phases of each leg, and its complex power, the parts of which stand at ``keys``."""
    legs, there = table.phases.split(","), place.phases.get(table.bus)
    known = list_phases(there or "")
    if there is None:
        place.refuse("bus", f"bus {table.bus} is not defined")
    elif not there:
        place.refuse("bus", f"bus {table.bus} has no phases; give the bus its phases")
    elif known:  # else the phases of the bus are refused
        for leg in legs:
            ends = list_phases(leg) if leg else []
            if len(ends) not in (1, 2) or len({*ends}) < len(ends):
                problem = (
                    f"{leg!r} is no leg; name one phase, of a leg to ground or neutral, or two, such as 'b', 'bc', or "
                    "several legs as 'a,b,c'"
                )
                place.refuse("phases", problem)
            elif missing := [phase for phase in ends if phase not in known]:
                place.refuse("phases", f"bus {table.bus} has no phase {', '.join(missing)}; it has {', '.join(known)}")
    given = [getattr(table, key) for key in keys]
    if given == [None, None]:
        place.refuse("", f"has no power; give {' or '.join(keys)}")
    parts = [[0.0] * len(legs) if values is None else values for values in given]
    for key, values in zip(keys, parts, strict=True):
        if len(values) != len(legs):
            place.refuse(key, f"is {values!s:.200}; give a number for each leg of {table.phases!r}")
    return legs, np.array([complex(p, q) for p, q in zip(*parts, strict=False)])


def _read_shunts(table: ShuntTable, place: _Place) -> list[Shunt]:
    before = len(place.problems)
    legs, power = _read_legs(table, ("g_kw", "b_kvar"), place)
    if len(place.problems) > before:
        return []
    y = power / 1000 / (place.base_mva / 3)
    return [
        Shunt(table.bus, leg, of_leg / find_nominal_across(leg) ** 2)
        for leg, of_leg in zip(legs, y.tolist(), strict=True)
    ]


def _read_loads(table: LoadTable, place: _Place) -> list[Load]:
    before = len(place.problems)
    legs, power = _read_legs(table, ("p_kw", "q_kvar"), place)
    exponents = np.array(table.exponents)
    if exponents.ndim == 1:
        exponents = np.broadcast_to(exponents, (len(legs), 2))
    elif len(exponents) != len(legs):
        found = f"is {table.exponents!s:.200}"
        place.refuse("exponents", f"{found}; give one pair, or a pair for each leg of {table.phases!r}")
    place.check(EXPONENT, "exponents", exponents)
    if table.kv is not None:
        place.check(BASE_VOLTAGE, "kv", table.kv)
    if len(place.problems) > before:
        return []
    loads = []
    for leg, of_leg, (of_p, of_q) in zip(legs, power.tolist(), exponents.tolist(), strict=True):
        nominal = place.kv[table.bus] / math.sqrt(3) * find_nominal_across(leg)
        share = 1.0 if table.kv is None else nominal / table.kv
        s = complex(of_leg.real * share**of_p, of_leg.imag * share**of_q) / 1000 / (place.base_mva / 3)
        loads.append(Load(table.bus, leg, s, (of_p, of_q)))
    return loads


@lru_cache
def find_nominal_across(leg: str) -> float:
    """The nominal voltage across a leg by that of a phase to ground: 3^0.5 between two of a, b, c, 2 of s1 and s2."""
    ends = np.exp(1j * PHASE_ANGLE[[PHASES.index(phase) for phase in list_phases(leg)]])
    return float(abs(ends[0] - ends[1])) if len(ends) == 2 else 1.0


def _shared(place: _Place, *buses: int) -> str:
    """The phases that all ``buses`` have."""
    lists = [list_phases(place.phases.get(bus, "")) for bus in buses]
    return "".join(phase for phase in lists[0] if all(phase in of for of in lists))


def _without_value(phases: str, at_to: str) -> Primitive:
    """Admittances that stand for those of a branch with a problem, of its ports."""
    n = len(list_phases(phases)) + len(list_phases(at_to))
    return Primitive(phases, at_to, np.zeros((n, n)), np.zeros((n, n)))
