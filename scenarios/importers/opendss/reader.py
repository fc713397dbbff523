"""OpenDSS circuits as networks with phases: branches by OpenDSS's own primitive matrices, loads by their parameters."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.grid.loads import Load
from dsse_core.grid.network import ZERO_LINE, Branch, Bus, Control, Generator, Network
from dsse_core.grid.nodes import PHASES, Primitive, list_phases, share_of_power
from dsse_core.grid.primitives import find_size
from dsse_core.printable import listed, printable
from dsse_core.results.units import base_current
from scenarios.files.network_columns import default_branch_id
from scenarios.files.network_phases import find_nominal_across
from scenarios.importers.fused_branches import fuse_zero_impedances
from scenarios.importers.imported import (
    ROUNDING,
    Imported,
    Remark,
    check_extra,
    find_places,
    leave_out_islands,
    list_shunt_legs,
    rating,
)
from scenarios.importers.opendss.profiles import write_profiles
from scenarios.importers.opendss.script import Script, read_script

LONGEST_S = 120.0  # of OpenDSS on one circuit; 8,531 nodes take 2 s
ALIKE = 1e-6  # share of a load's current within which it is that of OpenDSS; and of a matrix, of its transpose
NO_CURRENT = 1e-10  # p.u., round-off of a load of nothing
NO_SHUNT = 1e-6  # p.u., below which what an element draws that is open at one end is left out
NO_RATING_A = 400.0  # of lines that state none, OpenDSS's default
UNITS = ", "  # between the names of units that are one branch
LEAST_OF_SWITCH = 2 * ZERO_LINE  # share of the median impedance, by which a switch stays a branch
LARGEST_NUMBER = 10**9  # of a bus, taken from its name
OF_THREE = ("", "a", "b", "c")
HALVES = ("", "s1", "s2")
BUS_MODELS = {1: (0.0, 0.0), 2: (2.0, 2.0), 3: (0.0, 2.0), 5: (1.0, 1.0), 6: (0.0, 0.0), 7: (0.0, 2.0)}
"""Model of a load -> exponents of P and Q."""
FIXED_Q = (6, 7)  # models whose Q no load multiplier changes
CONVERTED = ("line", "transformer", "reactor", "capacitor", "load", "generator", "pvsystem", "storage")


def read_opendss(path: Path, within: Path | None = None) -> Imported:
    """Read a circuit of OpenDSS, with taps as its controls leave them.

    ``within``: folder of the files that it may name, by default its own.

    Raises:
        InvalidInputError: listing every statement that is not known to be harmless, and all that OpenDSS refuses or a
            network with phases cannot hold.
    """
    script = read_script(path, within)
    check_extra("opendssdirect", "opendss", str(path))
    answer = solve_circuit(script, path)
    try:
        return Circuit(answer, script).finish(path)
    except InvalidInputError as error:
        raise InvalidInputError(str(path), error.problems) from None


def solve_circuit(script: Script, path: Path, longest_s: float = LONGEST_S) -> dict[str, Any]:
    """The answer of OpenDSS, in a process of its own: see ``engine.py``.

    Raises:
        InvalidInputError: what OpenDSS refuses, or it takes longer than ``longest_s``, or dies.
    """
    given = json.dumps({"commands": [[command.text, command.place] for command in script.commands]})
    quiet = {"PYTHONPATH": os.pathsep.join(sys.path), "OPENBLAS_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    with tempfile.TemporaryDirectory(prefix="dsse-opendss-") as folder:
        try:
            done = subprocess.run(
                [sys.executable, "-P", "-m", "scenarios.importers.opendss.engine"],
                input=given,
                capture_output=True,
                encoding="utf-8",
                errors="replace",
                cwd=folder,
                env=os.environ | quiet,
                timeout=longest_s,
            )
        except subprocess.TimeoutExpired:
            problem = f"OpenDSS has not solved it within {longest_s:g} s and was stopped"
            raise InvalidInputError(str(path), [problem]) from None
    if done.returncode < 0:
        text = (
            f"OpenDSS crashed on the circuit (signal {-done.returncode}); look for a number far beyond those of grids"
        )
        raise InvalidInputError(str(path), [text])
    if done.returncode:
        last = printable(done.stderr.strip().splitlines()[-1] if done.stderr.strip() else "it says nothing")
        raise InvalidInputError(str(path), [f"the process of OpenDSS ended with code {done.returncode}: {last}"])
    answer: dict[str, Any] = json.loads(done.stdout)
    if answer["problems"]:
        raise InvalidInputError(str(path), [printable(problem) for problem in answer["problems"]])
    return answer


class Circuit:
    """A solved circuit; all ``problems`` of it as text."""

    def __init__(self, answer: Mapping[str, Any], script: Script) -> None:
        self.answer, self.script = answer, script
        self.kv: Mapping[str, float] = answer["kv"]  # to ground
        self.number = dict(_number_buses(list(self.kv)))
        self.problems, self.remarks = list[str](), list(script.remarks)
        self.elements: list[dict[str, Any]] = answer["elements"]
        self.splits = _find_splits(self.elements)
        self.phases = self._find_phases()
        self.stars = self._find_stars()
        self.base_mva = self._choose_base()
        self.taken, self.legs = set[str](), list[tuple[str, Load]]()
        if without := [bus for bus, kv in self.kv.items() if not kv > 0]:
            text = "no base voltage; write 'set voltagebases=[...]', in kV between lines, and 'calcvoltagebases'"
            raise InvalidInputError(script.name, [f"bus {listed(without)}: {text}"])

    def build(self) -> tuple[Network, str]:
        """The network as OpenDSS has it, and the bus of its source."""
        source_bus, source, feeding = self._build_source()
        branches, shunts = [feeding] if feeding else [], dict[str, complex]()
        for element in self.elements:
            if not element["name"].startswith("vsource."):
                branches += self._build_element(element, shunts)
        branches = self._join_units(branches)
        for load in self.answer["loads"]:
            self.legs += [(load["name"], leg) for leg in self._build_load(load)]
        for of_power in self.answer["sources"]:
            self.legs += [(of_power["name"], leg) for leg in self._build_producer(of_power)]
        if not self.problems:
            self._check_currents()
        if self.problems:
            raise InvalidInputError(self.script.name, self.problems)
        assert feeding is not None
        assert source is not None
        buses = [Bus(source.bus, self._between(source_bus), "source", phases="abc")]
        for bus, number in self.number.items():
            called, y = "" if bus == str(number) else bus, shunts.get(bus, 0j)
            x, y_place = self.script.places.get(bus, (None, None))
            text = self.phases[bus]
            buses.append(Bus(number, self._between(bus), called, 0.0, 0.0, y.real, y.imag, x=x, y=y_place, phases=text))
        network = Network(
            self.script.name,
            self.base_mva,
            tuple(buses),
            tuple(branches),
            (source,),
            tuple(leg for _, leg in self.legs),
        )
        network, gone = leave_out_islands(network)
        self.remarks += gone
        return network, source_bus

    def finish(self, path: Path) -> Imported:
        """The network without impedances near zero, its remarks, profiles and places of meters."""
        network, source_bus = self.build()
        head = self.number[source_bus]
        there = {bus.id for bus in network.buses}
        names = [name for name, leg in self.legs if leg.bus in there]
        network, fused = fuse_zero_impedances(self._keep_switches(network))
        ids = (branch.id.replace("#", "-") for branch in network.branches)  # as area files have them
        network = replace(network, branches=tuple(map(lambda b, k: replace(b, id=k), network.branches, ids)))
        self.remarks += [*fused, *self._find_remarks()]
        if switches := [f"{branch.id} is {branch.name}" for branch in network.branches if branch.switch]:
            self.remarks.append(Remark("note", f"switches have ids: {listed(switches)}"))
        named = Counter(name.partition(".")[0] for name in (*(e["name"] for e in self.elements), *dict.fromkeys(names)))
        converted = {"buses": len(network.buses), "nodes": network.n_nodes}
        converted |= {f"{kind}s": named[kind] for kind in CONVERTED}
        regulating = {f"transformer.{name}" for name, _ in self.answer["regulated"]}
        regulators = [b for b in network.active_branches if not regulating.isdisjoint(b.name.split(UNITS))]
        loads = list(zip(names, network.loads, strict=True))
        return Imported(
            network,
            f"OpenDSS circuit {path.name}",
            converted,
            tuple(self.remarks),
            substation=head,
            places=find_places(network, head, regulators),
            files=write_profiles(self.answer["shapes"], self.answer["loads"], loads),
        )

    def _keep_switches(self, network: Network) -> Network:
        """``network`` with the impedances of its switches raised where they would make one bus of two: a switch is a
        branch, so that it may be operated, and areas cut at it."""
        least, branches, names = LEAST_OF_SWITCH * network.median_impedance, list[Branch](), list[str]()
        for branch in network.branches:
            share = abs(complex(branch.r, branch.x)) / least if least else 1.0
            if branch.switch and branch.primitive and share < 1.0:
                y, charging = branch.primitive.y, branch.primitive.charging
                primitive = replace(branch.primitive, y=charging + share * (y - charging))
                names.append(branch.name)
                branch = replace(branch, r=branch.r / share, x=branch.x / share, primitive=primitive)
            branches.append(branch)
        if names:
            text = f"switches have at least {least:.3g} p.u., {LEAST_OF_SWITCH:g} of the median impedance"
            self.remarks.append(Remark("changed", f"{listed(names)}: {text}"))
        return replace(network, branches=tuple(branches))

    def _between(self, bus: str) -> float:
        return round(math.sqrt(3) * self.kv[bus], 9)

    def _choose_base(self) -> float:
        """The power of all loads to one digit, MVA."""
        total = sum(abs(complex(load["kw"], load["kvar"])) for load in self.answer["loads"]) / 1000
        return float(f"{total:.0e}") if total > 1e-3 else 1.0

    def _find_phases(self) -> dict[str, str]:
        nodes: dict[str, set[int]] = {bus: set() for bus in self.kv}
        for node in self.answer["nodes"]:
            bus, _, number = node.rpartition(".")
            if int(number) <= 3:
                nodes[bus].add(int(number))
        for bus in self.splits:
            if 3 in nodes[bus]:
                self.problems.append(
                    f"bus {bus}: behind a centre-tapped transformer it has a node 3; only 1 and 2 are known"
                )
        return {bus: "".join(self._name_phase(bus, k) for k in sorted(of_bus)) for bus, of_bus in nodes.items()}

    def _name_phase(self, bus: str, node: int) -> str:
        names = HALVES if bus in self.splits else OF_THREE
        return names[node] if node < len(names) else ""

    def _find_stars(self) -> set[tuple[str, int]]:
        """Nodes above 3 that one element alone touches: its star points."""
        touching = Counter[tuple[str, int]]()
        for element in (*self.elements, *self.answer["loads"], *self.answer["sources"]):
            touching.update({place for place in _list_conductors(element) if place[1] > 3})
        of_elements = {place for element in self.elements for place in _list_conductors(element)}
        return {place for place, count in touching.items() if count == 1 and place in of_elements}

    def _refuse(self, element: Mapping[str, Any], problem: str) -> None:
        self.problems.append(f"{printable(element['name'])}: {problem}")

    def fold(self, element: Mapping[str, Any]) -> tuple[list[tuple[str, int]], np.ndarray]:
        """The nodes of an element, bus after bus, and its admittances between them in p.u., star points eliminated."""
        conductors = _list_conductors(element)
        y = np.array(element["y"])
        n = len(conductors)
        Y = (y[0::2] + 1j * y[1::2]).reshape(n, n).T
        touched = abs(Y).max(axis=1, initial=0.0) > 0
        kept = [k for k, (_, node) in enumerate(conductors) if node > 0 and touched[k]]
        order = list(dict.fromkeys(bus for bus, _ in conductors))
        places = sorted(dict.fromkeys(conductors[k] for k in kept), key=lambda at: (order.index(at[0]), at[1]))
        fold = np.array([[conductors[k] == at for k in kept] for at in places], dtype=float).reshape(
            len(places), len(kept)
        )
        Y = fold @ Y[np.ix_(kept, kept)] @ fold.T
        is_star = np.array([at in self.stars for at in places], dtype=bool)
        if is_star.any():
            to_star = Y[np.ix_(~is_star, is_star)]
            Y = Y[np.ix_(~is_star, ~is_star)] - to_star @ np.linalg.pinv(Y[np.ix_(is_star, is_star)]) @ to_star.T
            places = [at for at in places if at not in self.stars]
        kv = np.array([self.kv[bus] for bus, _ in places])
        return places, self._make_symmetric(element, Y) * np.outer(kv, kv) / (self.base_mva / 3)

    def _make_symmetric(self, element: Mapping[str, Any], Y: np.ndarray) -> np.ndarray:
        """The matrix without its round-off; one that is not symmetric is refused."""
        if abs(Y - Y.T).max(initial=0.0) > ALIKE * abs(Y).max(initial=0.0):
            self._refuse(
                element, "its matrix is not symmetric, as where z1 and z2 differ; a branch has a symmetric one"
            )
        return np.asarray((Y + Y.T) / 2)

    def _check_nodes(self, element: Mapping[str, Any], places: Iterable[tuple[str, int]]) -> bool:
        neutral = [f"{bus}.{node}" for bus, node in places if not self._name_phase(bus, node)]
        if neutral:
            problem = (
                f"node {listed(neutral)}: a neutral is no node here; ground it, or reduce it with Kron's reduction"
            )
            self._refuse(element, problem)
        return not neutral

    def _build_source(self) -> tuple[str, Generator | None, Branch | None]:
        sources = [element for element in self.elements if element["name"].startswith("vsource.")]
        if len(sources) != 1:
            names = listed([element["name"] for element in sources]) or "none"
            self.problems.append(f"one vsource feeds a network, the substation; enabled are: {names}")
            return "", None, None
        element, frequency = sources[0], self.answer["frequency"]
        bus, conductors = element["buses"][0], element["conductors"]
        if element["frequency"] != frequency:
            problem = (
                f"has {element['frequency']:g} Hz, and the circuit is solved at {frequency:g} Hz, where it gives no"
            )
            self._refuse(element, f"{problem} voltage; write set defaultbasefrequency before new circuit, and no other")
            return bus, None, None
        if conductors != [1, 2, 3, 0, 0, 0]:
            problem = f"stands at nodes {listed(conductors)}; the substation has nodes 1, 2, 3 against the ground"
            self._refuse(element, problem)
            return bus, None, None
        of_node = np.array(element["y"])
        kv = self.kv[bus]
        one_end = (of_node[0::2] + 1j * of_node[1::2]).reshape(6, 6).T[:3, :3] * kv**2 / (self.base_mva / 3)
        Y = np.kron([[1, -1], [-1, 1]], self._make_symmetric(element, one_end))
        number = max(self.number.values()) + 1
        branch = self._name_branch(element, Primitive("abc", "abc", Y, np.zeros_like(Y)), number, self.number[bus])
        vm = element["kv"] / math.sqrt(3) * element["pu"] / kv
        return bus, Generator(number, Control.SLACK, vm=vm, va=math.radians(element["angle"])), branch

    def _name_branch(self, element: Mapping[str, Any], primitive: Primitive, from_bus: int, to_bus: int) -> Branch:
        name = default_branch_id(from_bus, to_bus, self.taken)
        self.taken.add(name)
        size = find_size(primitive)
        return Branch(
            name, from_bus, to_bus, r=size.real, x=size.imag, name=printable(element["name"]), primitive=primitive
        )

    def _build_element(self, element: Mapping[str, Any], shunts: dict[str, complex]) -> Iterator[Branch]:
        """The branch of an element, or its legs; ``shunts`` are those of buses with a shunt at each phase."""
        if element["name"] in self.answer["in_part"]:
            self._refuse(element, "some of its conductors are open; open or close all of them")
        places, Y = self.fold(element)
        if not self._check_nodes(element, places):
            return
        buses = list(dict.fromkeys(bus for bus, _ in places))
        if len(buses) > 2:
            self._refuse(element, f"joins {len(buses)} buses, {listed(buses)}; an element joins two")
        elif len(buses) == 2:
            yield self._build_branch(element, places, Y, buses)
            closed = [bus for k, bus in enumerate(element["buses"]) if k not in element["open_ends"]]
            if len(closed) == 1:
                self._add_rest(element, places, Y, closed[0], shunts)
        elif buses and not element["open_ends"]:
            self._add_shunt(element["name"], buses[0], [self._name_phase(*at) for at in places], Y, shunts)
        elif buses and len(element["open_ends"]) == 1 and element["name"].startswith(("line.", "transformer.")):
            self._refuse(element, f"is open at one of its ends, which are both at bus {buses[0]}; open both")

    def _join_units(self, branches: Iterable[Branch]) -> list[Branch]:
        """Elements of one phase beside each other, each at other phases, as one branch, since else they are a loop:
        units of a bank, or a line that is written phase by phase."""
        of_one = {printable(element["name"]) for element in self.elements if element["phases"] == 1}
        units, taken = dict[Hashable, list[Branch]](), Counter[Hashable]()
        for branch in branches:
            beside: Hashable = branch.id
            if branch.name in of_one:
                kind, places = branch.name.partition(".")[0], _list_ports(branch)
                place = (kind, branch.in_service, frozenset(places))
                taken[place] += 1
                beside = (*place[:2], frozenset(bus for bus, _ in places), taken[place])
            units.setdefault(beside, []).append(branch)
        return [of[0] if len(of) == 1 else _join(of) for of in units.values()]

    def _add_rest(
        self,
        element: Mapping[str, Any],
        places: Sequence[tuple[str, int]],
        Y: np.ndarray,
        bus: str,
        shunts: dict[str, complex],
    ) -> None:
        """Add the charging or excitation that an element open at one end draws at the other one, ``bus``."""
        here = np.array([at[0] == bus for at in places])
        across = Y[np.ix_(here, ~here)]
        rest = Y[np.ix_(here, here)] - across @ np.linalg.pinv(Y[np.ix_(~here, ~here)]) @ across.T
        if abs(rest).max() > NO_SHUNT:
            self._add_shunt(
                element["name"], bus, [self._name_phase(*at) for at in places if at[0] == bus], rest, shunts
            )
            text = f"open at one end, what it draws at bus {bus} is a shunt there; leave it out to close the branch"
            self.remarks.append(Remark("changed", f"{printable(element['name'])}: {text}"))

    def _build_branch(
        self, element: Mapping[str, Any], places: Sequence[tuple[str, int]], Y: np.ndarray, buses: Sequence[str]
    ) -> Branch:
        phases = ["".join(self._name_phase(*at) for at in places if at[0] == bus) for bus in buses]
        n, charging = len(list_phases(phases[0])), np.zeros(Y.shape, dtype=complex)
        if element["name"].startswith("line.") and phases[0] == phases[1]:
            for at in (slice(0, n), slice(n, 2 * n)):
                charging[at, at] = Y[at, :n] + Y[at, n:]
            charging[abs(charging) < ROUNDING * abs(Y).max()] = 0.0
            charging = (charging + charging.T) / 2
        primitive = Primitive(phases[0], phases[1], Y, charging)
        branch = self._name_branch(element, primitive, *(self.number[bus] for bus in buses))
        amps, kva = element.get("amps", NO_RATING_A), element.get("kva", 0.0)
        if amps != NO_RATING_A and self.kv[buses[0]] == self.kv[buses[1]]:
            current = base_current(self.base_mva, self._between(buses[0]))
            branch = replace(branch, i_max=rating(amps / current * self.base_mva, self.base_mva))
        elif kva:
            branch = replace(branch, s_max=rating(kva / 1000 / share_of_power(phases[0]), self.base_mva))
        is_switch = element["name"].startswith("line.") and (element["is_switch"] or bool(element["open_ends"]))
        return replace(branch, in_service=not element["open_ends"], switch=is_switch)

    def _add_shunt(self, name: str, bus: str, phases: Sequence[str], Y: np.ndarray, shunts: dict[str, complex]) -> None:
        """A shunt of the bus where it is alike at each phase, else legs of constant impedance."""
        is_alike = abs(Y - np.eye(len(Y)) * Y[0, 0]).max(initial=0.0) <= ROUNDING * abs(Y).max(initial=0.0)
        if is_alike and "".join(phases) == self.phases[bus]:
            shunts[bus] = shunts.get(bus, 0j) + complex(Y[0, 0])
            return
        self.legs += [(name, leg) for leg in list_shunt_legs(self.number[bus], phases, Y)]

    def _list_legs(self, element: Mapping[str, Any]) -> list[str]:
        """The phases of each leg of a load or source; empty where one is no phase."""
        n, conductors = element["phases"], element["conductors"]
        bus = element["buses"][0]
        if _is_delta(element):
            pairs = [(conductors[k], conductors[(k + 1) % len(conductors)]) for k in range(n)]
        else:
            pairs = [(conductors[k], conductors[n] if len(conductors) > n else 0) for k in range(n)]
        if not self._check_nodes(element, [(bus, k) for k in dict.fromkeys(k for pair in pairs for k in pair) if k]):
            return []
        ends = [[self._name_phase(bus, k) for k in pair if k] for pair in pairs]
        if not all(len(set(of_leg)) == len(pair) > 0 for of_leg, pair in zip(ends, ends, strict=True)):
            self._refuse(
                element, f"stands at nodes {listed(conductors)} of bus {bus}; a leg joins two nodes, or one and ground"
            )
            return []
        return ["".join(of_leg) for of_leg in ends]

    def _build_load(self, load: Mapping[str, Any]) -> Iterator[Load]:
        bus, n, model, across = load["buses"][0], load["phases"], load["model"], _find_across(load)
        parts = _list_parts(load)
        if not parts:
            self._refuse(load, f"model {model} of loads is not read; models 1 to 8 are")
            return
        factor = 1.0 if load["is_fixed"] or load["is_exempt"] else self.answer["load_mult"]
        for leg in self._list_legs(load):
            u = self.kv[bus] * find_nominal_across(leg) / across
            for of_p, of_q, p, q in parts:
                kw, kvar = p * load["kw"] * factor / n, q * load["kvar"] * (1 if model in FIXED_Q else factor) / n
                s = complex(kw * u**of_p, kvar * u**of_q) / 1000 / (self.base_mva / 3)
                yield Load(self.number[bus], leg, s, (of_p, of_q))

    def _build_producer(self, source: Mapping[str, Any]) -> Iterator[Load]:
        """The constant power of the solved state, as a load that produces it."""
        legs, powers = self._list_legs(source), source["powers"]
        s = [complex(*powers[k : k + 2]) / 1000 / (self.base_mva / 3) for k in range(0, len(powers), 2)]
        whole = sum(s)
        for k, leg in enumerate(legs):
            is_to_ground = len(list_phases(leg)) == 1
            yield Load(self.number[source["buses"][0]], leg, s[k] if is_to_ground else whole / len(legs))

    def _check_currents(self) -> None:
        """Refuse loads and sources that are open, or whose legs draw other currents than OpenDSS at its voltages."""
        of_element: dict[str, list[Load]] = {}
        for name, leg in self.legs:
            of_element.setdefault(name, []).append(leg)
        for element in (*self.answer["loads"], *self.answer["sources"]):
            if element["is_open"]:
                self._refuse(element, "is open; disable it, or close it")
                continue
            bus = element["buses"][0]
            phases = [self._name_phase(bus, node) for node in element["conductors"]]
            theirs, mine = dict.fromkeys(phases, 0j), dict.fromkeys(phases, 0j)
            a = element["currents"]
            for phase, re_a, im_a in zip(phases, a[0::2], a[1::2], strict=True):
                theirs[phase] += complex(re_a, im_a) * self.kv[bus] / 1000 / (self.base_mva / 3)
            for leg in of_element.get(element["name"], []):
                ends = list_phases(leg.phases)
                u = self.voltages[leg.bus, ends[0]] - (self.voltages[leg.bus, ends[1]] if ends[1:] else 0.0)
                share = abs(u) / find_nominal_across(leg.phases)
                s = complex(leg.s.real * share ** leg.exponents[0], leg.s.imag * share ** leg.exponents[1])
                i = (s / u).conjugate()
                mine[ends[0]] += i
                if ends[1:]:
                    mine[ends[1]] -= i
            size = max(map(abs, (*theirs.values(), *mine.values())), default=0.0)
            apart = max((abs(theirs[phase] - mine[phase]) for phase in phases if phase), default=0.0)
            if not apart <= ALIKE * size + NO_CURRENT:
                text = (
                    f"its currents in OpenDSS are not those that its model gives, apart by {apart / size:.1g} of them"
                )
                self._refuse(element, f"{text}; write it as loads of its phases")

    @cached_property
    def voltages(self) -> dict[tuple[int, str], complex]:
        """Bus and phase of each node -> the voltage that OpenDSS finds, p.u."""
        v, found = np.array(self.answer["v"]), {}
        for node, u in zip(self.answer["nodes"], v[0::2] + 1j * v[1::2], strict=True):
            bus, _, number = node.rpartition(".")
            if phase := self._name_phase(bus, int(number)):
                found[self.number[bus], phase] = u / self.kv[bus]
        return found

    def _find_remarks(self) -> Iterator[Remark]:
        by_limits: dict[tuple[float, float], list[str]] = {}
        for name, limits in self._find_beyond().items():
            by_limits.setdefault(limits, []).append(name)
        for (least, most), names in by_limits.items():
            text = f"beyond {least:g} and {most:g} p.u. it is constant impedance in OpenDSS, here its model holds"
            yield Remark("changed", f"{listed(names)}: {text}")
        if disabled := self.answer["disabled"]:
            yield Remark("left out", f"{listed(disabled)}: disabled")
        if cut := [load["name"] for load in self.answer["loads"] if load["model"] == 8 and load["zip"][6] > 0]:
            yield Remark("changed", f"{listed(cut)}: OpenDSS cuts it off below a voltage, here it is not")
        for shape in self.answer["shapes"]:
            if shape["is_actual"]:
                text = "its kW are divided by their largest, as shares"
                yield Remark("changed", f"loadshape.{shape['name']}: {text}")
        if opened := [element["name"] for element in self.elements if element["open_ends"]]:
            yield Remark("note", f"{listed(opened)}: open, kept as an open branch; of a shunt left out")
        if produced := [source["name"] for source in self.answer["sources"]]:
            text = "its constant power in the solved state, written as a load that produces it"
            yield Remark("changed", f"{listed(produced)}: {text}")

    def _find_beyond(self) -> dict[str, tuple[float, float]]:
        """Loads and sources whose voltage is beyond the limits of their model as solved, and these, p.u."""
        v, given = self.voltages, {one["name"]: one for one in (*self.answer["loads"], *self.answer["sources"])}
        names = {number: bus for bus, number in self.number.items()}
        found = dict[str, tuple[float, float]]()
        for name, leg in self.legs:
            if load := given.get(name):
                one, *other = (v[leg.bus, phase] for phase in list_phases(leg.phases))
                least, most = load["limits"]
                if not least <= abs(one - sum(other)) * self.kv[names[leg.bus]] / _find_across(load) <= most:
                    found[name] = least, most
        return found


def _list_ports(branch: Branch) -> list[tuple[int, str]]:
    """Bus and phase of each port."""
    assert branch.primitive
    ends = ((branch.from_bus, branch.primitive.from_phases), (branch.to_bus, branch.primitive.to_phases))
    return [(bus, phase) for bus, phases in ends for phase in list_phases(phases)]


def _join(units: Sequence[Branch]) -> Branch:
    """The branch that ``units`` between the same two buses are: the sum of their primitives over all their ports."""
    first, of_units = units[0], [_list_ports(unit) for unit in units]
    touched = sorted({port for of_unit in of_units for port in of_unit}, key=lambda port: PHASES.index(port[1]))
    at_from, at_to = ([port for port in touched if port[0] == bus] for bus in (first.from_bus, first.to_bus))
    ports = [*at_from, *at_to]
    y, charging = np.zeros((2, len(ports), len(ports)), dtype=complex)
    for unit, of_unit in zip(units, of_units, strict=True):
        at = np.ix_(*[[ports.index(port) for port in of_unit]] * 2)
        assert unit.primitive
        y[at] += unit.primitive.y
        charging[at] += unit.primitive.charging
    from_phases, to_phases = ("".join(phase for _, phase in of_end) for of_end in (at_from, at_to))
    primitive = Primitive(from_phases, to_phases, y, charging)
    size, name = find_size(primitive), UNITS.join(unit.name for unit in units)
    i_max = min((unit.i_max for unit in units if unit.i_max is not None), default=None)
    s_max = min((unit.s_max for unit in units if unit.s_max is not None), default=None)
    is_switch = all(unit.switch for unit in units)
    whole = replace(first, r=size.real, x=size.imag, name=name, primitive=primitive, switch=is_switch)
    return replace(whole, i_max=i_max, s_max=s_max)


def _is_delta(element: Mapping[str, Any]) -> bool:
    return bool(element.get("is_delta", len(element["conductors"]) == element["phases"]))


def _find_across(load: Mapping[str, Any]) -> float:
    """The nominal voltage across a leg of a load, kV."""
    return float(load["kv"] / (math.sqrt(3) if load["phases"] > 1 and not _is_delta(load) else 1))


def _list_parts(load: Mapping[str, Any]) -> list[tuple[float, float, float, float]]:
    """Parts of a load: exponents of P and Q, and shares of its P and Q; none of a model that is not known."""
    model = load["model"]
    if model == 8:
        of_p, of_q = load["zip"][:3], load["zip"][3:6]
        return [(e, e, p, q) for e, p, q in zip((2.0, 1.0, 0.0), of_p, of_q, strict=True) if p or q]
    exponents = load["exponents"] if model == 4 else BUS_MODELS.get(model)
    return [(float(exponents[0]), float(exponents[1]), 1.0, 1.0)] if exponents else []


def _list_conductors(element: Mapping[str, Any]) -> list[tuple[str, int]]:
    """Bus and node of each conductor of each end."""
    buses, nodes = element["buses"], element["conductors"]
    n = len(nodes) // len(buses)
    return [(buses[k // n], node) for k, node in enumerate(nodes)]


def _find_splits(elements: Iterable[Mapping[str, Any]]) -> set[str]:
    """Buses behind centre-tapped transformers: a unit has two windings there, from a node to ground and from ground to
    the other; lines carry it on."""
    beside: dict[str, set[str]] = {}
    found = set[str]()
    for element in elements:
        kind, buses = element["name"].partition(".")[0], element["buses"]
        if kind == "transformer" and element["phases"] == 1 and len(buses) == 3 and buses[1] == buses[2]:
            one, other = (element["conductors"][2 * k : 2 * k + 2] for k in (1, 2))
            if one[1] == other[0] == 0 and one[0] != other[1]:
                found.add(buses[1])
        elif kind != "transformer" and len(buses) == 2:
            beside.setdefault(buses[0], set()).add(buses[1])
            beside.setdefault(buses[1], set()).add(buses[0])
    queue = list(found)
    for bus in queue:  # the queue grows
        for other_bus in beside.get(bus, set()) - found:
            found.add(other_bus)
            queue.append(other_bus)
    return found


def _number_buses(names: Sequence[str]) -> Iterator[tuple[str, int]]:
    """Each bus and its id: the number in its name, and 1000 more where that is another bus's."""
    own = {name for name in names if name.isdecimal() and name == str(int(name)) and int(name) < LARGEST_NUMBER}
    taken = set(map(int, own))
    next_free: dict[int, int] = {}
    for name in names:
        if name in own:
            yield name, int(name)
            continue
        first = int("0" + "".join(re.findall(r"\d+$|^\d+|\d+(?=[a-z]$)", name)[:1])) % LARGEST_NUMBER
        number = next_free.get(first, first or 1000)
        while number in taken:
            number += 1000
        next_free[first] = number
        taken.add(number)
        yield name, number
