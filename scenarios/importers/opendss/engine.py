"""The process in which OpenDSS solves a circuit: commands on standard input, the solved circuit on standard output.

Here every file has a limit of 0 bytes, whatever slips through the checks of ``script.py``. Matrices are those of
OpenDSS (YPrim) in siemens, without its shunts that keep ungrounded parts from floating; voltages in kV to ground.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from typing import Any

from dsse_core import operating_system
from scenarios.importers.opendss.script import SERIES

APART = 1e-4  # share of the largest base voltage, above which voltages without these shunts are those of floating parts
MOST_PROBLEMS = 20
MOST_BYTES = 8 * 2**30  # of memory; 8,531 nodes take 0.3 GiB
SOURCES = ("generator", "pvsystem", "storage")
WIDE = "vminpu=0.01 vmaxpu=10"  # per unit: loads and sources as their models have it at any voltage
ANTIFLOAT = 0.01  # parts per million of a transformer, without which OpenDSS may not solve; it has 1


class Engine:
    """OpenDSS with one circuit."""

    def __init__(self) -> None:
        sys.modules["pandas"] = None  # type: ignore[assignment]  # which it imports if it is there, in a second
        import opendssdirect

        self.in_part: list[str] = []
        self.dss: Any = opendssdirect
        self.dss.Basic.AllowEditor(False)
        self.dss.Basic.AllowForms(False)
        self.dss.Basic.AllowChangeDir(False)

    def run(self, commands: list[list[str]]) -> Iterator[str]:
        """Execute commands, each with the place of its text; yields problems."""
        found = 0
        for text, place in commands:
            try:
                self.dss.Text.Command(text)
            except Exception as error:  # of OpenDSS
                found += 1
                yield f"{place}: OpenDSS refuses it: {_say(error)}"
            if found == MOST_PROBLEMS:
                return

    def solve(self) -> Iterator[str]:
        """Solve with controls, as the file has it, then exactly, with controls at rest; yields problems."""
        solution = self.dss.Solution
        solution.MaxControlIterations(max(solution.MaxControlIterations(), 100))
        solution.MaxIterations(max(solution.MaxIterations(), 500))
        if problem := self._solve():
            yield f"OpenDSS finds no power flow: {problem}"
            return
        self.limits = self._find_limits()
        for kind, limits in (
            ("load", f"{WIDE} vlowpu=0.01"),
            ("generator", WIDE),
            ("pvsystem", WIDE),
            ("storage", WIDE),
        ):
            self._edit_all(kind, limits)
        solution.Convergence(1e-11)
        self.dss.Text.Command("set controlmode=off")
        self._edit_all("transformer", f"ppm_antifloat={ANTIFLOAT}")
        if problem := self._solve():
            yield f"OpenDSS finds no exact power flow with its controls at rest: {problem}"

    def _solve(self) -> str:
        try:
            self.dss.Solution.Solve()
        except Exception as error:  # of OpenDSS
            return _say(error)
        return "" if self.dss.Solution.Converged() else "its iteration does not converge"

    def _edit_all(self, kind: str, text: str) -> None:
        if self._count(kind):
            self.dss.Text.Command(f"batchedit {kind}..* {text}")

    def _count(self, kind: str) -> int:
        self.dss.Circuit.SetActiveClass(kind)
        return int(self.dss.ActiveClass.Count())

    def _find_limits(self) -> dict[str, list[float]]:
        """vminpu and vmaxpu of loads and sources, by class.name in lower case."""
        found = dict[str, list[float]]()
        for name in self.dss.Circuit.AllElementNames():
            if name.lower().partition(".")[0] in ("load", *SOURCES):
                found[name.lower()] = [self._ask(name, "vminpu"), self._ask(name, "vmaxpu")]
        return found

    def _ask(self, name: str, word: str) -> float:
        self.dss.Text.Command(f"? {name}.{word}")
        return float(self.dss.Text.Result())

    def describe(self) -> dict[str, Any]:
        dss = self.dss
        found: dict[str, Any] = {
            "nodes": [name.lower() for name in dss.Circuit.AllNodeNames()],
            "v": self._list_voltages(),
            "kv": {},
            "load_mult": dss.Solution.LoadMult(),
            "frequency": dss.Solution.Frequency(),
            "loads": [],
            "sources": [],
            "elements": [],
        }
        for name in dss.Circuit.AllBusNames():
            dss.Circuit.SetActiveBus(name)
            found["kv"][name.lower()] = dss.Bus.kVBase()
        elements = [name.lower().split(".", 1) for name in dss.Circuit.AllElementNames()]
        found["regulated"] = [
            [control.Transformer().lower(), control.Winding()] for control in self._each(dss.RegControls)
        ]
        self._edit_all("transformer", "ppm_antifloat=0")
        bare, size = [] if self._solve() else self._list_voltages(), max(found["kv"].values(), default=0.0)
        if bare and all(abs(one - other) < APART * size for one, other in zip(bare, found["v"], strict=True)):
            found["v"] = bare
        else:  # parts without ground float
            self._edit_all("transformer", f"ppm_antifloat={ANTIFLOAT}")
            dss.YMatrix.SolutionInitialized(False)  # else it begins where it has ended, which may be nan
            self._solve()
        found["loads"] = list(self._describe_loads())
        for kind, name in elements:
            if kind in SOURCES and self._is_enabled(f"{kind}.{name}"):
                found["sources"].append(self._describe_power(kind, name))
        self._edit_all("transformer", "ppm_antifloat=0")
        disabled = [f"{kind}.{name}" for kind, name in elements if not self._is_enabled(f"{kind}.{name}")]
        ties = self._enable_ties(disabled, set(found["nodes"]))
        found["disabled"] = [name for name in disabled if name not in ties]
        open_ends = dict(self._close_open_lines(elements)) | {name: [0, 1] for name in ties}
        dss.YMatrix.BuildYMatrixD(1, 0)  # the command buildy leaves matrices of what has just been closed as they were
        for kind, name in elements:
            if kind in SERIES or kind == "vsource":
                dss.Circuit.SetActiveElement(f"{kind}.{name}")
                if dss.CktElement.Enabled():
                    element = self._describe_element(kind, name) | {"y": list(dss.CktElement.YPrim())}
                    element["open_ends"] = open_ends.get(f"{kind}.{name}", [])
                    found["elements"].append(element | self._describe_class(kind, name))
        found["shapes"] = list(self._describe_shapes({load["shape"] for load in found["loads"]}))
        return found

    def _list_voltages(self) -> list[float]:
        return [value / 1000 for value in self.dss.Circuit.AllBusVolts()]

    def _is_enabled(self, name: str) -> bool:
        self.dss.Circuit.SetActiveElement(name)
        return bool(self.dss.CktElement.Enabled())

    def _each(self, kind: Any) -> Iterator[Any]:
        for _ in kind:
            if self.dss.CktElement.Enabled():
                yield kind

    def _enable_ties(self, disabled: list[str], nodes: set[str]) -> list[str]:
        """Enable what joins two buses, and brings no node beside ``nodes``, so that it has a matrix; its names."""
        buses, element, ties = {node.rpartition(".")[0] for node in nodes}, self.dss.CktElement, list[str]()
        for name in disabled:
            self.dss.Circuit.SetActiveElement(name)
            ends = {bus.split(".")[0].lower() for bus in element.BusNames()}
            if name.partition(".")[0] in SERIES and len(ends) > 1 and ends <= buses:
                ties.append(name)
        self._turn("enable", ties)
        beyond = [name for name in ties if not self._list_nodes(name) <= nodes]
        self._turn("disable", beyond)
        return [name for name in ties if name not in beyond]

    def _turn(self, verb: str, names: list[str]) -> None:
        for name in names:
            self.dss.Text.Command(f"{verb} {name}")
        if names:
            self.dss.Text.Command("makebuslist")

    def _list_nodes(self, name: str) -> set[str]:
        self.dss.Circuit.SetActiveElement(name)
        element = self.dss.CktElement
        n, numbers = element.NumConductors(), element.NodeOrder()
        buses = [bus.split(".")[0].lower() for bus in element.BusNames()]
        return {f"{buses[k // n]}.{number}" for k, number in enumerate(numbers) if number}

    def _close_open_lines(self, elements: list[list[str]]) -> Iterator[tuple[str, list[int]]]:
        """Close what is open, so that its matrix is that of the closed branch; yields each and its open ends."""
        element = self.dss.CktElement
        for kind, name in elements:
            if kind not in SERIES:
                continue
            self.dss.Circuit.SetActiveElement(f"{kind}.{name}")
            conductors = range(1, element.NumConductors() + 1)
            ends = range(1, element.NumTerminals() + 1)
            states = [[bool(element.IsOpen(end, conductor)) for conductor in conductors] for end in ends]
            if element.Enabled() and any(map(any, states)):
                for end in ends:
                    element.Close(end, 0)
                states = [state[: element.NumPhases()] for state in states]
                open_ends = [k for k, state in enumerate(states) if all(state)]
                is_mixed = any(any(state) and not all(state) for state in states)
                if is_mixed or (len(ends) > 2 and 0 < len(open_ends) < len(ends)):
                    self.in_part.append(f"{kind}.{name}")
                yield f"{kind}.{name}", open_ends

    def _describe_element(self, kind: str, name: str) -> dict[str, Any]:
        element = self.dss.CktElement
        return {
            "name": f"{kind}.{name}",
            "buses": [bus.split(".")[0].lower() for bus in element.BusNames()],
            "conductors": list(element.NodeOrder()),
            "phases": element.NumPhases(),
        }

    def _describe_power(self, kind: str, name: str) -> dict[str, Any]:
        element = self.dss.CktElement
        return self._describe_element(kind, name) | {
            "kv": self._ask(f"{kind}.{name}", "kv"),
            "limits": self.limits[f"{kind}.{name}"],
            "is_open": any(element.IsOpen(1, conductor) for conductor in range(1, element.NumConductors() + 1)),
            "powers": list(element.Powers()),  # kW and kvar of each conductor
            "currents": list(element.Currents()),  # A
        }

    def _describe_class(self, kind: str, name: str) -> dict[str, Any]:
        dss = self.dss
        if kind == "line":
            dss.Lines.Name(name)
            return {"amps": dss.CktElement.NormalAmps(), "is_switch": bool(dss.Lines.IsSwitch())}
        if kind == "transformer":
            dss.Transformers.Name(name)
            dss.Transformers.Wdg(1)
            return {"kva": dss.Transformers.kVA()}
        if kind == "vsource":
            dss.Vsources.Name(name)
            own = {"kv": dss.Vsources.BasekV(), "pu": dss.Vsources.PU(), "angle": dss.Vsources.AngleDeg()}
            return own | {"frequency": dss.Vsources.Frequency()}
        return {}

    def _describe_loads(self) -> Iterator[dict[str, Any]]:
        loads = self.dss.Loads
        for _ in self._each(loads):
            name = loads.Name()
            shape = next((s for s in (loads.Yearly(), loads.Daily(), loads.Duty()) if s), "")
            yield self._describe_power("load", name) | {
                "kw": loads.kW(),
                "kvar": loads.kvar(),
                "kv": loads.kV(),
                "model": int(loads.Model()),
                "is_delta": bool(loads.IsDelta()),
                "exponents": [loads.CVRwatts(), loads.CVRvars()],
                "zip": list(loads.ZipV()),
                "is_fixed": int(loads.Status()) == 1,
                "is_exempt": int(loads.Status()) == 2,
                "shape": shape.lower(),
            }

    def _describe_shapes(self, used: set[str]) -> Iterator[dict[str, Any]]:
        shapes = self.dss.LoadShape
        for _ in shapes:
            name = shapes.Name().lower()
            if name in used:
                p, q, hours = list(shapes.PMult()), list(shapes.QMult()), list(shapes.TimeArray())
                yield {
                    "name": name,
                    "hours": shapes.HrInterval(),
                    "times": hours,
                    "p": p,
                    "q": q if len(q) == len(p) else [],
                    "is_actual": bool(shapes.UseActual()),
                }


def _say(error: Exception) -> str:
    text = " ".join(str(error.args[-1] if error.args else error).split())
    return text[:200]


def main() -> None:
    answer = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # so that nothing that OpenDSS prints stands in the answer
    given = json.load(sys.stdin)
    operating_system.confine(MOST_BYTES)
    engine = Engine()
    problems = list(engine.run(given["commands"])) or list(engine.solve())
    json.dump(
        {"problems": problems} if problems else {"problems": [], "in_part": engine.in_part} | engine.describe(), answer
    )
    answer.close()


if __name__ == "__main__":
    main()
