"""Converts the feeders of OpenDSS into network files with phases; a tool that no test runs.

    python -m tests.support.ieee_feeders.convert FOLDER

FOLDER: a checkout of github.com/dss-extensions/electricdss-tst at 3b20839, BSD 3-clause licence, copyright of
DSS-Extensions contributors and of Electric Power Research Institute, Inc. Needs opendssdirect.py 0.9.4, which reads and
solves the files; lines, banks, capacitors and loads are built from their parameters. Loads hold at any voltage.
Antifloat shunts of banks (ppm) are 0, or 0.01 beside parts without ground, which OpenDSS cannot solve without. Switches
are fused; OpenDSS finds its voltages without them, their buses merged by commands, since with them voltages differ by
up to 9e-7 p.u.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.loads import Load
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.nodes import Primitive, list_phases
from dsse_core.grid.primitives import Side, build_bank, build_line, find_size
from scenarios.files.network_columns import default_branch_id
from scenarios.files.network_file import load_case
from scenarios.files.saved_network import save_network
from scenarios.importers.fused_branches import fuse_zero_impedances
from scenarios.importers.imported import Remark
from tests.support.ieee_feeders import SHIPPED

HERE = Path(__file__).parent
SOURCE_OF_ALL = (
    "github.com/dss-extensions/electricdss-tst at 3b20839, BSD 3-clause, EPRI and DSS-Extensions contributors"
)
FOLDER = "Version8/Distrib/IEEETestCases"
TAPS_123 = {"1a": 7, "2a": -1, "3a": 0, "3c": -1, "4a": 8, "4b": 1, "4c": 5}
TAPS_13 = {"1": 10, "2": 8, "3": 11}
SOURCE = "edit Vsource.source MVAsc3=200000 MVAsc1=200000"  # as the other 4-bus feeders; the file has 1e6
MERGED_13 = ("edit line.692675 bus1=671", "edit load.692 bus1=671.3.1", "edit line.671692 enabled=no")
MERGED_123 = (
    *(f"edit regcontrol.creg{name} enabled=no" for name in TAPS_123),
    "edit transformer.reg1a buses=[150 149]",
    "edit line.l116 bus1=13",
    "edit line.l114 bus1=18",
    *(f"edit transformer.reg4{phase} buses=[60.{k} 160r.{k}]" for k, phase in enumerate("abc", 1)),
    "edit line.l118 bus1=97",
    "edit transformer.xfm1 buses=[61 610]",
    *(f"edit line.sw{k} enabled=no" for k in range(1, 9)),
)


def fix_taps(taps: dict[str, int]) -> list[str]:
    steps = [f"Transformer.reg{name}.wdg=2 Tap={1 + 0.00625 * step}" for name, step in taps.items()]
    return [*steps, "set controlmode=off"]


@dataclass(frozen=True)
class Case:
    """A feeder: its file, power base in MVA, commands that fix its taps, and whether it has parts without ground.

    ``merged``: commands that merge the buses of its switches.
    """

    file: str
    base_mva: float
    commands: tuple[str, ...] = ()
    is_ungrounded: bool = False
    merged: tuple[str, ...] = ()


CASES = {
    "ieee13": Case("13Bus/IEEE13Nodeckt.dss", 5.0, tuple(fix_taps(TAPS_13)), merged=MERGED_13),
    "ieee34": Case("34Bus/ieee34Mod1.dss", 2.5),
    "ieee37": Case("37Bus/ieee37.dss", 2.5, is_ungrounded=True),
    "ieee123": Case("123Bus/IEEE123Master.dss", 5.0, tuple(fix_taps(TAPS_123)), True, MERGED_123),
    "4bus-dy": Case("4Bus-DY-Bal/4Bus-DY-Bal.DSS", 6.0),
    "4bus-yd": Case("4Bus-YD-Bal/4Bus-YD-Bal.DSS", 6.0, is_ungrounded=True),
    "4bus-grdyd": Case("4Bus-GrdYD-Bal/4Bus-GrdYD-Bal.DSS", 6.0, is_ungrounded=True),
    "4bus-yy": Case("4Bus-YY-Bal/4Bus-YY-Bal.DSS", 6.0),
    "4bus-oyod": Case("4Bus-OYOD-UnBal/4bus-OYOD-UnBal.dss", 6.0, (SOURCE,), is_ungrounded=True),
}


class Feeder:
    """A feeder as OpenDSS has solved it."""

    def __init__(self, folder: Path, case: Case, further: tuple[str, ...] = ()) -> None:
        import opendssdirect as dss  # in nobody's environment but that of this tool

        self.dss, self.case = dss, case
        dss.Basic.AllowEditor(False)
        before = ["clear", f'compile "{folder / FOLDER / case.file}"', *case.commands, *further]
        before += ["batchedit load..* vminpu=0.4 vmaxpu=1.6 vlowpu=0.3"]
        before += [f"batchedit transformer..* ppm={0.01 if case.is_ungrounded else 0}"]
        after = ["set tolerance=1e-11", "set maxiterations=1000", "set controlmode=off"]
        for commands in (before, after):
            for command in commands:
                dss.Text.Command(command)
            dss.Solution.Solve()
        assert dss.Solution.Converged()
        self.number = dict(self._number_buses([name.lower() for name in dss.Circuit.AllBusNames()]))
        self.kv: dict[str, float] = {}  # to ground
        for name in self.number:
            dss.Circuit.SetActiveBus(name)
            self.kv[name] = dss.Bus.kVBase()
        self.worst, self.taken = 0.0, set[str]()

    @staticmethod
    def _number_buses(names: list[str]) -> Iterator[tuple[str, int]]:
        """Each bus and its id: the number in its name, and 1000 more where that is another bus's."""
        taken = {int(name) for name in names if name.isdecimal()}
        for name in names:
            if name.isdecimal():
                yield name, int(name)
                continue
            number = int("0" + "".join(re.findall(r"\d+$|^\d+|\d+(?=[a-z]$)", name)[:1]))
            while number in taken or number == 0:
                number += 1000
            taken.add(number)
            yield name, number

    def convert(self, name: str) -> tuple[Network, list[Remark]]:
        dss, base = self.dss, self.case.base_mva
        phases: dict[str, set[str]] = {bus: set() for bus in self.number}
        for node in dss.Circuit.AllNodeNames():
            bus, _, number = node.lower().rpartition(".")
            if int(number) <= 3:
                phases[bus].add("abc"[int(number) - 1])
        source_bus, source, feeding = self._convert_source()
        branches = [feeding, *self._convert_lines(), *self._convert_transformers()]
        shunts, loads = self._convert_capacitors({bus: "".join(sorted(of)) for bus, of in phases.items()})
        buses = [Bus(source.bus, round(np.sqrt(3) * self.kv[source_bus], 9), "source", phases="abc")]
        for bus, number in self.number.items():
            kv, text = round(np.sqrt(3) * self.kv[bus], 9), "".join(sorted(phases[bus]))
            called = "" if bus == str(number) else bus
            buses.append(Bus(number, kv, called, b_shunt=shunts.get(bus, 0.0), phases=text))
        loads += list(self._convert_loads())
        return fuse_zero_impedances(Network(name, base, tuple(buses), tuple(branches), (source,), tuple(loads)))

    def voltages(self, whole: Feeder) -> dict[str, list[float]]:
        """Node -> magnitude, p.u., and angle, degrees, with ids and bases of the ``whole`` feeder."""
        v = np.array(self.dss.Circuit.AllBusVolts())
        found = {}
        for node, voltage in zip(self.dss.Circuit.AllNodeNames(), v[0::2] + 1j * v[1::2], strict=True):
            bus, _, phase = node.lower().rpartition(".")
            if int(phase) <= 3:
                u = voltage / whole.kv[bus] / 1000
                key = f"{whole.number[bus]}.{'abc'[int(phase) - 1]}"
                found[key] = [round(float(abs(u)), 12), round(float(np.degrees(np.angle(u))), 10)]
        return found

    def _each(self, kind: Any) -> Iterator[None]:
        for _ in kind:
            if self.dss.CktElement.Enabled():
                yield

    def _ends(self) -> list[tuple[str, list[str]]]:
        """Bus and phases of the conductors of each end of the active element; "" for ground, "n" for a star point."""
        names, n = self.dss.CktElement.BusNames(), self.dss.CktElement.NumConductors()
        order = [["", "a", "b", "c", "n"][min(k, 4)] for k in self.dss.CktElement.NodeOrder()]
        return [(bus.split(".")[0].lower(), order[k * n : (k + 1) * n]) for k, bus in enumerate(names)]

    def _check(self, primitive: Primitive, ends: list[tuple[str, list[str]]]) -> None:
        """Compares with the matrix that OpenDSS has, without its antifloat shunts."""
        y = np.array(self.dss.CktElement.YPrim())
        n = int(np.sqrt(len(y) / 2))
        Y = (y[0::2] + 1j * y[1::2]).reshape(n, n).T
        flat = [(bus, phase) for bus, of_end in ends for phase in of_end]
        sides = primitive.from_phases, primitive.to_phases
        ports = [(ends[k][0], phase) for k in (0, 1) for phase in list_phases(sides[k])]
        if any(phase == "n" for _, phase in flat):
            return
        fold = np.array([[port == conductor for conductor in flat] for port in ports], dtype=float)
        kv = np.array([self.kv[bus] for bus, _ in ports])
        theirs = fold @ Y @ fold.T * np.outer(kv, kv) / (self.case.base_mva / 3)
        self.worst = max(self.worst, float(abs(theirs - primitive.y).max() / abs(theirs).max()))

    def _branch(self, primitive: Primitive, ends: list[tuple[str, list[str]]]) -> Branch:
        self._check(primitive, ends)
        from_bus, to_bus = (self.number[bus] for bus, _ in ends)
        return self._name(primitive, from_bus, to_bus)

    def _name(self, primitive: Primitive, from_bus: int, to_bus: int) -> Branch:
        name = default_branch_id(from_bus, to_bus, self.taken)
        self.taken.add(name)
        size = find_size(primitive)
        return Branch(name, from_bus, to_bus, r=size.real, x=size.imag, primitive=primitive)

    def _convert_source(self) -> tuple[str, Generator, Branch]:
        dss = self.dss
        dss.Vsources.First()
        bus = self._ends()[0][0]
        r1, x1, r0, x0 = (float(dss.Properties.Value(key)) for key in ("R1", "X1", "R0", "X0"))
        z1, z0 = complex(r1, x1), complex(r0, x0)
        base = self.case.base_mva / (3 * self.kv[bus] ** 2)
        primitive = build_line("abc", base * (z1 * np.eye(3) + (z0 - z1) / 3))
        vm = dss.Vsources.BasekV() / np.sqrt(3) * dss.Vsources.PU() / self.kv[bus]
        number = max(self.number.values()) + 1
        branch = self._name(primitive, number, self.number[bus])
        va = np.radians(dss.Vsources.AngleDeg())
        return bus, Generator(number, Control.SLACK, vm=float(vm), va=float(va)), branch

    def _convert_lines(self) -> Iterator[Branch]:
        dss, omega = self.dss, 2 * np.pi * self.dss.Solution.Frequency()
        for _ in self._each(dss.Lines):
            n, length, ends = dss.Lines.Phases(), dss.Lines.Length(), self._ends()
            assert ends[0][1] == ends[1][1]
            given = (dss.Lines.RMatrix(), dss.Lines.XMatrix(), dss.Lines.CMatrix())
            order = np.argsort(ends[0][1])
            R, X, C = (np.array(m).reshape(n, n)[np.ix_(order, order)] * length for m in given)
            base = self.case.base_mva / (3 * self.kv[ends[0][0]] ** 2)
            primitive = build_line("".join(sorted(ends[0][1])), (R + 1j * X) * base, 1e-9j * omega * C / base)
            yield self._branch(primitive, ends)

    def _convert_transformers(self) -> Iterator[Branch]:
        dss = self.dss
        for _ in self._each(dss.Transformers):
            n, ends = dss.CktElement.NumPhases(), self._ends()
            is_delta, kv, tap, r = [], [], [], 0.0
            for k in (1, 2):
                dss.Transformers.Wdg(k)
                is_delta.append(dss.Transformers.IsDelta())
                kv.append(dss.Transformers.kV())
                tap.append(dss.Transformers.Tap())
                r += dss.Transformers.R() / 100
            step = 1
            if is_delta[0] != is_delta[1]:  # the low side lags by 30 degrees
                step = -1 if is_delta[int(np.argmax(kv))] else 1
            sides = []
            for k, (bus, conductors) in enumerate(ends):
                begin, end = conductors[:n], [conductors[n]] * n
                if n > 1 and is_delta[k]:
                    end = [begin[(i + step) % n] for i in range(n)]
                across = kv[k] / np.sqrt(3) if n > 1 and not is_delta[k] else kv[k]
                touched = "".join(sorted({*begin, *end} - {"", "n"}))
                legs = tuple(one + other for one, other in zip(begin, end, strict=True))
                sides.append(Side(touched, legs, (tap[k] * across / self.kv[bus],) * n))
            z = r + 1j * dss.Transformers.Xhl() / 100
            primitive = build_bank(*sides, dss.Transformers.kVA() / 1000 / n / (self.case.base_mva / 3) / z)
            yield self._branch(primitive, ends)

    def _convert_capacitors(self, phases: dict[str, str]) -> tuple[dict[str, float], list[Load]]:
        """The susceptances of buses with a capacitor at each phase; those at some phases as loads."""
        dss, shunts, loads = self.dss, dict[str, float](), list[Load]()
        for _ in self._each(dss.Capacitors):
            n, (bus, conductors) = dss.CktElement.NumPhases(), self._ends()[0]
            assert not dss.Capacitors.IsDelta()
            across = dss.Capacitors.kV() / (np.sqrt(3) if n > 1 else 1)
            b = dss.Capacitors.kvar() / 1000 / n / (self.case.base_mva / 3) * (self.kv[bus] / across) ** 2
            if "".join(sorted(conductors[:n])) == phases[bus]:
                shunts[bus] = shunts.get(bus, 0.0) + b
            else:
                loads += [Load(self.number[bus], phase, -1j * b, (2.0, 2.0)) for phase in conductors[:n]]
        return shunts, loads

    def _convert_loads(self) -> Iterator[Load]:
        dss = self.dss
        for _ in self._each(dss.Loads):
            n, (bus, conductors) = dss.CktElement.NumPhases(), self._ends()[0]
            s = complex(dss.Loads.kW(), dss.Loads.kvar()) / 1000 / n / (self.case.base_mva / 3)
            model = dss.Loads.Model()
            of_model = {1: (0.0, 0.0), 2: (2.0, 2.0), 5: (1.0, 1.0), 4: (dss.Loads.CVRwatts(), dss.Loads.CVRvars())}
            is_delta = dss.Loads.IsDelta() and conductors[1] != ""
            across = dss.Loads.kV() / (np.sqrt(3) if n > 1 and not is_delta else 1)
            for k in range(n):
                leg = conductors[k] + (conductors[(k + 1) % max(n, 2)] if is_delta else "")
                u = self.kv[bus] * (np.sqrt(3) if is_delta else 1) / across
                p, q = of_model[model]
                yield Load(self.number[bus], leg, complex(s.real * u**p, s.imag * u**q), (p, q))


def compare(network: Network, shipped: Network) -> float:
    """The largest difference of their admittances, of the largest of its row; both have their nodes in one order."""
    due, found = (build_admittance(one).ybus.toarray() for one in (network, shipped))
    return float((abs(found - due) / abs(due).max(axis=1, keepdims=True)).max())


def main() -> None:
    voltages = {}
    for name, case in CASES.items():
        feeder = Feeder(Path(sys.argv[1]).absolute(), case)
        network, remarks = feeder.convert(name)
        print(f"{name}: {network.n_nodes} nodes, matrices as OpenDSS has them to {feeder.worst:.1e}")
        print(*(f"    {remark.what}: {remark.text}" for remark in remarks), sep="\n")
        if name in SHIPPED:
            print(f"    its matrix is the shipped one to {compare(network, load_case(name)):.1e}")
        else:
            save_network(HERE / f"{name}.json", network, f"{SOURCE_OF_ALL}, {case.file}")
        voltages[name] = Feeder(Path(sys.argv[1]).absolute(), case, case.merged).voltages(feeder)
    (HERE / "voltages.json").write_text(json.dumps({"source": SOURCE_OF_ALL, **voltages}, indent=0), encoding="utf-8")


if __name__ == "__main__":
    main()
