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

APART = 1e-4  # share of the largest base voltage, above which voltages without these shunts are those of floating parts
MOST_PROBLEMS = 20
MOST_BYTES = 8 * 2**30  # of memory; 8,531 nodes take 0.3 GiB
SERIES = ("line", "transformer", "reactor", "capacitor")
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
        loads = self.dss.Loads
        return {loads.Name(): [loads.Vminpu(), loads.Vmaxpu()] for _ in loads}

    def describe(self) -> dict[str, Any]:
        dss = self.dss
        found: dict[str, Any] = {
            "nodes": [name.lower() for name in dss.Circuit.AllNodeNames()],
            "v": self._list_voltages(),
            "kv": {},
            "load_mult": dss.Solution.LoadMult(),
            "loads": list(self._describe_loads()),
            "sources": [],
            "elements": [],
        }
        for name in dss.Circuit.AllBusNames():
            dss.Circuit.SetActiveBus(name)
            found["kv"][name.lower()] = dss.Bus.kVBase()
        elements = [name.lower().split(".", 1) for name in dss.Circuit.AllElementNames()]
        for kind, name in elements:
            if kind in SOURCES:
                dss.Circuit.SetActiveElement(f"{kind}.{name}")
                if dss.CktElement.Enabled():
                    found["sources"].append(
                        self._describe_element(kind, name) | {"powers": list(dss.CktElement.Powers())}
                    )
        found["regulated"] = [
            [control.Transformer().lower(), control.Winding()] for control in self._each(dss.RegControls)
        ]
        self._edit_all("transformer", "ppm_antifloat=0")
        if not self._solve():
            bare, size = self._list_voltages(), max(found["kv"].values(), default=0.0)
            if all(abs(one - other) < APART * size for one, other in zip(bare, found["v"], strict=True)):
                found["v"] = bare  # else parts without ground float
        open_ones = set(self._close_open_lines(elements))
        dss.Text.Command("buildy")
        for kind, name in elements:
            if kind in SERIES or kind == "vsource":
                dss.Circuit.SetActiveElement(f"{kind}.{name}")
                if dss.CktElement.Enabled():
                    element = self._describe_element(kind, name) | {"y": list(dss.CktElement.YPrim())}
                    element["is_open"] = f"{kind}.{name}" in open_ones
                    found["elements"].append(element | self._describe_class(kind, name))
        found["disabled"] = [f"{k}.{n}" for k, n in elements if not self._is_enabled(f"{k}.{n}")]
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

    def _close_open_lines(self, elements: list[list[str]]) -> Iterator[str]:
        """Close what is open, so that its matrix is that of the closed branch."""
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
                is_whole = any(all(state[: element.NumPhases()]) for state in states)
                yield f"{kind}.{name}"
                if not is_whole:
                    self.in_part.append(f"{kind}.{name}")

    def _describe_element(self, kind: str, name: str) -> dict[str, Any]:
        element = self.dss.CktElement
        return {
            "name": f"{kind}.{name}",
            "buses": [bus.split(".")[0].lower() for bus in element.BusNames()],
            "conductors": list(element.NodeOrder()),
            "phases": element.NumPhases(),
        }

    def _describe_class(self, kind: str, name: str) -> dict[str, Any]:
        dss = self.dss
        if kind == "line":
            return {"amps": dss.CktElement.NormalAmps()}
        if kind == "transformer":
            dss.Transformers.Name(name)
            dss.Transformers.Wdg(1)
            return {"kva": dss.Transformers.kVA()}
        if kind == "vsource":
            dss.Vsources.Name(name)
            return {"kv": dss.Vsources.BasekV(), "pu": dss.Vsources.PU(), "angle": dss.Vsources.AngleDeg()}
        return {}

    def _describe_loads(self) -> Iterator[dict[str, Any]]:
        dss, loads = self.dss, self.dss.Loads
        for _ in self._each(loads):
            name = loads.Name()
            shape = next((s for s in (loads.Yearly(), loads.Daily(), loads.Duty()) if s), "")
            yield self._describe_element("load", name) | {
                "kw": loads.kW(),
                "kvar": loads.kvar(),
                "kv": loads.kV(),
                "model": int(loads.Model()),
                "is_delta": bool(loads.IsDelta()),
                "exponents": [loads.CVRwatts(), loads.CVRvars()],
                "zip": list(loads.ZipV()),
                "is_fixed": int(loads.Status()) == 1,
                "is_exempt": int(loads.Status()) == 2,
                "limits": self.limits[name],
                "shape": shape.lower(),
                "powers": list(dss.CktElement.Powers()),
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
