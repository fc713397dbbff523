"""Circuits of OpenDSS as networks: the power flow is OpenDSS's own, and what no network can hold is refused by name.

With OpenDSS (extra opendss) alone. The IEEE feeders are read where OPENDSS_FEEDERS names a checkout of
github.com/dss-extensions/electricdss-tst at 3b20839.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.estimation.estimator import estimate_state
from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.network import Network
from dsse_core.grid.nodes import Primitive, name_node
from dsse_core.grid.radial_order import Tree, find_tree
from dsse_core.power_flow.newton_raphson import solve_power_flow
from dsse_core.results.units import base_current
from scenarios.files.network_file import load_network
from scenarios.importers import import_grid
from scenarios.importers.imported_files import write_imported
from scenarios.importers.opendss.reader import Circuit, solve_circuit
from scenarios.importers.opendss.script import Command, read_script
from scenarios.importers.opendss.vocabulary import Words, load_vocabulary
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.ieee_feeders import load_feeder, load_voltages
from tests.support.levels import further

pytest.importorskip("opendssdirect", reason="needs OpenDSS: pip install '.[opendss]'")
FEEDERS = Path(os.environ.get("OPENDSS_FEEDERS", "")) / "Version8/Distrib/IEEETestCases"
TOY = """clear
set defaultbasefrequency=60
new circuit.toy basekv=12.47 pu=1.02 mvasc3=200 mvasc1=180
new linecode.three nphases=3 rmatrix=[0.3465 | 0.156 0.3375 | 0.158 0.1535 0.3414] units=mi
~ xmatrix=[1.0179 | 0.5017 1.0478 | 0.4236 0.3849 1.0348] cmatrix=[15 | -5 16 | -2 -3 14]
new transformer.sub phases=3 windings=2 xhl=6 %imag=1 %noloadloss=0.5
~ wdg=1 bus=sourcebus conn=delta kv=12.47 kva=5000 %r=0.5
~ wdg=2 bus=650 conn=wye kv=4.16 kva=5000 %r=0.5
new transformer.reg1 phases=1 xhl=1 kvas=[1666 1666] buses=[650.1 r60.1] kvs=[2.4 2.4] %loadloss=0.01
new transformer.reg2 like=reg1 buses=[650.2 r60.2]
new transformer.reg3 like=reg1 buses=[650.3 r60.3]
new regcontrol.r1 transformer=reg1 winding=2 vreg=124 band=2 ptratio=20
new regcontrol.r2 transformer=reg2 winding=2 vreg=122 band=2 ptratio=20
new line.main bus1=r60 bus2=632 linecode=three length=2000 units=ft normamps=600
new line.lateral phases=2 bus1=632.3.2 bus2=645.3.2 r1=0.2 x1=0.3 r0=0.5 x0=0.9 c1=10 c0=5 length=0.5
new line.single phases=1 bus1=632.1 bus2=652.1 r1=0.3 x1=0.4 c1=0 length=0.5
new line.tie bus1=645.2.3 bus2=633.2.3 phases=2 r1=0.1 x1=0.1 switch=y
open line.tie 1
new line.spare phases=1 bus1=633.3 bus2=645.3 r1=0.1 x1=0.1 enabled=no
new line.nowhere phases=1 bus1=633.3 bus2=646.3 r1=0.1 x1=0.1 enabled=no
new reactor.series bus1=632 bus2=633 r=0.01 x=0.1
new transformer.open1 phases=1 buses=[633.1.2 671.1.2] conns=[delta delta] kvs=[4.16 0.48] kvas=[100 100] xhl=3
new transformer.open2 phases=1 buses=[633.3.2 671.3.2] conns=[delta delta] kvs=[4.16 0.48] kvas=[100 100] xhl=3
new transformer.star phases=3 windings=2 buses=[633.1.2.3.4 634] conns=[wye delta] kvs=[4.16 0.48] kvas=[300 300] xhl=4
new transformer.tap phases=1 windings=3 buses=[652.1 x1.1.0 x1.0.2] kvs=[2.4 0.12 0.12] kvas=[25 25 25]
~ xhl=2.04 xht=2.04 xlt=1.36 %rs=[0.6 1.2 1.2] %noloadloss=0.2
new line.service phases=2 bus1=x1.1.2 bus2=s1.1.2 r1=0.05 x1=0.03 r0=0.06 x0=0.05 c1=0 c0=0 length=0.2
new capacitor.whole bus1=632 kv=4.16 kvar=300
new capacitor.delta bus1=633 kv=4.16 kvar=60 conn=delta
new reactor.shunt bus1=632.1 phases=1 kv=2.4 kvar=20
new loadshape.day npts=3 interval=0.5 mult=(0.2 1.0 0.6)
new loadshape.actual npts=2 hour=(0 2) mult=(1.5 3.0) useactual=yes interval=0
new loadshape.unused npts=1 mult=(1)
new load.m1 bus1=632 kv=4.16 kw=600 kvar=300 conn=delta model=1
new load.m2 bus1=645.2.3 phases=1 kv=4.16 kw=100 kvar=50 conn=delta model=2
new load.m3 bus1=645.3 phases=1 kv=2.4 kw=50 kvar=30 model=3
new load.m4 bus1=632.1 phases=1 kv=2.4 kw=80 kvar=40 model=4 cvrwatts=0.8 cvrvars=3
new load.m5 bus1=652.1 phases=1 kv=2.3 kw=60 kvar=20 model=5
new load.m8 bus1=633.2 phases=1 kv=2.4 kw=90 kvar=45 model=8 zipv=[0.2 0.3 0.5 0.5 0.4 0.1 0.3]
new load.pair bus1=632.1.2 phases=2 kv=4.16 kw=40 kvar=10
new load.behind bus1=634 kv=0.48 kw=90 kvar=40 conn=delta yearly=day
new load.fixed bus1=671.1.2 phases=1 kv=0.48 kw=20 kvar=5 conn=delta status=fixed
new load.half bus1=s1.1 phases=1 kv=0.12 kw=3 kvar=1 daily=actual
new load.other bus1=s1.2 phases=1 kv=0.12 kw=4 pf=0.95
new load.both bus1=s1.1.2 phases=1 kv=0.24 kw=5 kvar=1 conn=delta
new generator.g bus1=633 kv=4.16 kw=90 kvar=30 model=1
new pvsystem.pv bus1=645.2.3 phases=1 conn=delta kv=4.16 kva=50 pmpp=40 irradiance=0.8 pf=0.95
new energymeter.m line.main 1
set loadmult=0.9
set voltagebases=[12.47 4.16 0.48 0.208]
calcvoltagebases
solve
setbusxy bus=632 x=3 y=4
"""


def write(folder: Path, text: str, name: str = "toy.dss") -> Path:
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


def compare(path: Path, within: Path | None = None) -> tuple[Network, float, float]:
    """The imported network, nothing fused, and its largest differences of voltages to OpenDSS, p.u.: to ground, where
    there is one, and between phases."""
    script = read_script(path, within)
    circuit = Circuit(solve_circuit(script, path), script)
    network, _ = circuit.build()
    found = solve_power_flow(network, tolerance=1e-12)
    mine = dict(zip(network.nodes, found.vm * np.exp(1j * found.va), strict=True))
    inside = network.slack.bus
    d = {node: v - circuit.voltages[node] for node, v in mine.items() if node[0] != inside}
    floating = set(network.gauge.ungrounded)
    of_bus: dict[int, list[complex]] = {}
    for (bus, _), apart in d.items():
        of_bus.setdefault(bus, []).append(apart)
    between = max(abs(one - other) for of in of_bus.values() for one in of for other in of)
    return network, max(abs(apart) for node, apart in d.items() if node[0] not in floating), between


def test_the_power_flow_of_all_kinds_of_elements_is_that_of_opendss(tmp_path: Path) -> None:
    network, to_ground, between = compare(write(tmp_path, TOY))
    assert network.n_nodes == 31
    assert (to_ground, between) < (1e-8, 1e-8)
    taps = {branch.name: branch for branch in network.branches}
    y = taps["transformer.reg1, transformer.reg2, transformer.reg3"].primitive.y
    assert y[0, 3] / y[3, 3] == pytest.approx(-1.0125)  # OpenDSS's control has moved it
    assert isinstance(find_tree(network, network.slack.bus), Tree)


def test_what_was_changed_is_said_and_profiles_stand_beside(tmp_path: Path) -> None:
    switch = "new line.switch phases=1 bus1=652.1 bus2=653.1 switch=y r1=1e-4 x1=0 c1=0 length=1e-3\n"
    second = "new vsource.second bus1=632 basekv=4.16 enabled=no\n"
    imported = import_grid(write(tmp_path, TOY.replace("new load.m1", f"{switch}{second}new load.m1")))
    network = imported.network
    remarks = {remark.text.split(":")[0]: remark.what for remark in imported.remarks}
    assert remarks == {
        "energymeter (1)": "left out",
        "line.tie, line.spare": "note",
        "line.nowhere, vsource.second": "left out",
        "line.switch": "changed",
        "switches have ids": "note",
        "generator.g, pvsystem.pv": "changed",
        "load.m5": "changed",
        "load.m8": "changed",
        "loadshape.actual": "changed",
    }
    buses = {bus.name or str(bus.id): bus for bus in network.buses}
    assert (buses["632"].x, buses["632"].y, buses["s1"].phases) == (3.0, 4.0, "s1s2")
    branches = {branch.name: branch for branch in network.branches}
    assert branches["transformer.reg1, transformer.reg2, transformer.reg3"].id == "650-60"
    assert [branches[name].in_service for name in ("line.main", "line.tie", "line.spare")] == [True, False, False]
    assert branches["line.spare"].primitive.y[0, 0] == pytest.approx(
        -branches["line.spare"].primitive.y[0, 1], rel=1e-6
    )
    assert branches["line.tie"].primitive.y[0, 0] == pytest.approx(-branches["line.tie"].primitive.y[0, 2], rel=1e-6)
    assert [name for name, branch in branches.items() if branch.switch] == ["line.tie", "line.spare", "line.switch"]
    assert branches["line.switch"].r > 1e-4 * network.median_impedance
    _, summary = write_imported(tmp_path / "cut", imported, ["line.switch"])
    assert "line.switch" in summary
    assert 'switches = ["652-653"]' in (tmp_path / "cut" / "scenario.toml").read_text()
    _ = write_imported(tmp_path / "areas", imported, 2)
    assert 'areas = { count = 2, ties = ["645-633", "633-645"] }' in (tmp_path / "areas" / "scenario.toml").read_text()
    assert branches["line.main"].i_max * base_current(network.base_mva, 4.16) == pytest.approx(600)
    produced = [load for load in network.loads if load.s.real < 0]
    assert sum(load.s.real for load in produced) * network.node_mva == pytest.approx(-0.09 - 0.032, abs=1e-6)
    shares = imported.files["profiles.csv"].splitlines()
    assert shares[:4] == ["profile,time_s,p_share,q_share", "day,0,0.2,0.2", "day,1800,1.0,1.0", "day,3600,0.6,0.6"]
    assert shares[4:] == ["actual,0,0.5,0.5", "actual,7200,1.0,1.0"]
    assert imported.files["profiles_of_loads.csv"].splitlines()[1].startswith("load.behind,634,ab,day")


def test_a_network_file_has_the_matrices_of_opendss_and_a_scenario_the_names_of_metered_buses(tmp_path: Path) -> None:
    imported = import_grid(write(tmp_path, TOY))
    path, _ = write_imported(tmp_path / "toy", imported)
    assert "# Bus 1000 is sourcebus, 60 is r60; network.toml names the others.\n" in path.read_text("utf-8")
    network, again = imported.network, load_network(tmp_path / "toy" / "network.toml")
    for one, other in zip(network.branches, again.branches, strict=True):
        assert isinstance(one.primitive, Primitive)
        assert other.primitive.y == pytest.approx(one.primitive.y, rel=1e-14)


PARAMETERS = """
name = "by parameters"
data_source = "made up"
base_mva = 5.0
source = [{ bus = 1, kind = "slack", vm_pu = 1.0 }]
bus = [
    { id = 1, base_kv = 4.16, phases = "abc" }, { id = 2, base_kv = 4.16, phases = "abc" },
    { id = 3, base_kv = 0.48, phases = "abc" }, { id = 4, base_kv = 4.16, phases = "a" },
    { id = 5, base_kv = 0.208, phases = "s1s2" },
]
load = [
    { bus = 2, phases = "a,bc", p_kw = [90, 60], q_kvar = [30, 20] },
    { bus = 3, phases = "ab,bc,ca", p_kw = [40, 60, 20], q_kvar = [10, 30, 5], exponents = [1, 2] },
    { bus = 4, phases = "a", p_kw = [70], q_kvar = [20] },
    { bus = 5, phases = "s1,s2", p_kw = [3, 5], q_kvar = [1, 1] },
]
[[branch]]
from = 1
to = 2
phases = "abc"
r_ohm = [[0.3465], [0.156, 0.3375], [0.158, 0.1535, 0.3414]]
x_ohm = [[1.0179], [0.5017, 1.0478], [0.4236, 0.3849, 1.0348]]
b_us = [[5.65486677646], [-1.88495559215, 6.03185789489], [-0.75398223686, -1.13097335529, 5.27787565803]]
[[transformer]]
windings = [{ bus = 2, phases = "abc", kv = 4.16, connection = "FROM" },
            { bus = 3, phases = "abc", kv = 0.48, connection = "TO", taps = 1.025 }]
kva = 500.0
r_percent = 1.1
x_percent = 4.0
no_load_percent = 0.4
magnetising_percent = 2.0
[[transformer]]
windings = [{ bus = 2, phases = "a", kv = 4.16, connection = "grounded wye" },
            { bus = 4, phases = "a", kv = 4.16, connection = "grounded wye", taps = [1.0625] }]
kva = 1666.0
r_percent = 0.01
x_percent = 1.0
[[transformer]]
windings = [{ bus = 2, phases = "b", kv = 4.16, connection = "grounded wye" },
            { bus = 5, phases = "s1s2", kv = 0.208, connection = "centre-tapped" }]
kva = 25.0
r_percent = 1.2
x_percent = 2.0
no_load_percent = 0.2
magnetising_percent = 0.5
"""
SAME = """new circuit.same basekv=4.16
edit vsource.source bus1=1 enabled=yes
new line.one bus1=1 bus2=2 length=1 rmatrix=[0.3465 | 0.156 0.3375 | 0.158 0.1535 0.3414]
~ xmatrix=[1.0179 | 0.5017 1.0478 | 0.4236 0.3849 1.0348] cmatrix=[15 | -5 16 | -2 -3 14]
BANK
new transformer.reg phases=1 buses=[2.1 4.1] kvs=[(4.16 3 sqrt /) (4.16 3 sqrt /)] kvas=[1666 1666] xhl=1
~ %rs=[0.005 0.005] taps=[1 1.0625]
new transformer.tap phases=1 windings=3 buses=[2.2 5.1.0 5.0.2] kvs=[(4.16 3 sqrt /) (0.208 3 sqrt /) (0.208 3 sqrt /)]
~ kvas=[25 25 25] xhl=2.4 xht=2.4 xlt=1.6 %rs=[0.6 1.2 1.2] %noloadloss=0.2 %imag=0.5
set voltagebases=[4.16 0.48 0.208]
calcvoltagebases
"""
BANK = """new transformer.t buses=[2NEUTRAL 3NEUTRAL] conns=[CONN CONN] kvs=[4.16 0.48] kvas=[500 500] xhl=4
~ %rs=[0.55 0.55] taps=[1 1.025] %noloadloss=0.4 %imag=2"""
OPEN_DELTA = """new transformer.t phases=1 buses=[2.1.2 3.1.2] conns=[delta delta] kvs=[4.16 0.48] kvas=[250 250] xhl=4
~ %rs=[0.55 0.55] taps=[1 1.025] %noloadloss=0.4 %imag=2
new transformer.u like=t buses=[2.2.3 3.2.3] %imag=2"""
SCENARIO = """
version = 1
name = "own"
description = "a bank"
network = "own.toml"
areas = { count = 1 }
strategy = "information"
[measurements]
zero_injection = "virtual"
voltage = { buses = [1, 2, 4, 5], sigma_percent = 0.5 }
flow = { branches = ["1-2"], sigma_percent = 1.0 }
injection = { buses = "all", sigma_percent = 30.0 }
[telemetry]
source = "network"
"""


def write_bank(at_from: str, at_to: str) -> str:
    """A bank of OpenDSS with the connections of a network file."""
    text = OPEN_DELTA if at_from == "ab,bc" else BANK
    for side in (at_from, at_to):
        text = text.replace("NEUTRAL", ".1.2.3.4" if side == "wye" else "", 1)
        text = text.replace("CONN", side.removeprefix("grounded "), 1)
    return text


@pytest.mark.parametrize(
    "connections",
    [
        ("delta", "grounded wye"),
        *further(
            ("grounded wye", "grounded wye"),
            ("grounded wye", "delta"),
            ("wye", "delta"),
            ("delta", "delta"),
            ("delta", "wye"),
            ("wye", "wye"),
            ("wye", "grounded wye"),
            ("ab,bc", "ab,bc"),
        ),
    ],
)
def test_lines_banks_and_regulators_by_parameters_have_matrices_and_estimate_of_opendss(
    tmp_path: Path, connections: tuple[str, str]
) -> None:
    at_from, at_to = connections
    write(tmp_path, PARAMETERS.replace("FROM", at_from).replace("TO", at_to), "own.toml")
    scenario = load_scenario(write(tmp_path, SCENARIO, "scenario.toml"))
    mine = scenario.network
    script = read_script(write(tmp_path, SAME.replace("BANK", write_bank(at_from, at_to))))
    circuit = Circuit(solve_circuit(script, tmp_path), script)
    circuit.base_mva = 5.0
    named = {branch.name: branch.primitive for branch in circuit.build()[0].branches}
    bank = "transformer.t, transformer.u" if at_from == "ab,bc" else "transformer.t"
    theirs = [named[name] for name in ("line.one", bank, "transformer.reg", "transformer.tap")]
    for branch, primitive in zip(mine.branches, theirs, strict=True):
        assert branch.primitive.y == pytest.approx(primitive.y, rel=1e-8, abs=1e-8 * abs(primitive.y).max())
    branches = [replace(branch, primitive=of) for branch, of in zip(mine.branches, theirs, strict=True)]
    readings = make_telemetry(scenario).union
    one, other = (estimate_state(n, readings) for n in (mine, replace(mine, branches=tuple(branches))))
    assert other.vm == pytest.approx(one.vm, abs=1e-9)
    assert other.va == pytest.approx(one.va, abs=1e-9)


@pytest.mark.parametrize(
    "case",
    [
        ("new transformer.three windings=3 buses=[632 633 7] kvs=[4.16 4.16 0.48]", "transformer.three: joins 3 buses"),
        *further(
            (
                "new line.four phases=2 bus1=632.1.0 bus2=8.1.4\nnew load.q bus1=8.1.4 phases=1 kv=2.4 kw=1",
                "line.four: node 8.4: a neutral is no node",
            ),
            ("new load.n bus1=632.1.4 phases=1 kv=2.4 kw=1", "load.n: node 632.4: a neutral is no node"),
            ("new vsource.two bus1=632 basekv=4.16", "one vsource feeds a network"),
            ("open capacitor.whole 1 2", "capacitor.whole: some of its conductors are open"),
            ("new load.x bus1=632 model=11", "toy.dss line 49: OpenDSS refuses it"),
            ("new line.x bus1=632 bus2=9 linecode=none", "toy.dss line 49: OpenDSS refuses it"),
        ),
    ],
)
def test_what_no_network_can_hold_is_refused_by_name(tmp_path: Path, case: tuple[str, str]) -> None:
    statements, problem = case
    text = TOY.replace("set loadmult", statements + "\nset loadmult")
    with pytest.raises(InvalidInputError) as error:
        import_grid(write(tmp_path, text))
    assert any(found.startswith(problem) for found in error.value.problems), error.value.problems


SMALL = """new circuit.small basekv=4.16 pu=1.02 mvasc3=200 mvasc1=180
new line.main bus1=sourcebus bus2=1 r1=0.2 x1=0.3 r0=0.5 x0=0.9 c1=300 c0=100 length=2
new line.one bus1=1 bus2=01 r1=0.2 x1=0.3 r0=0.5 x0=0.9 c1=3000 c0=1000 length=2
new line.other like=one bus1=1 bus2=01
new load.a bus1=01.1 phases=1 kv=2.4 kw=100 kvar=20
new load.b bus1=01 kv=4.16 kw=100 kvar=50
new load.nothing bus1=01 kv=4.16 kw=0 kvar=0
set voltagebases=[4.16]
calcvoltagebases
"""
TRANSFORMER = (
    "new transformer.t buses=[1 01] conns=[wye wye] kvs=[4.16 4.16] kvas=[900 900] xhl=4 %imag=3 %noloadloss=1\n"
)


@pytest.mark.parametrize(
    "case",
    [
        ("open line.other 2", "line.other: open at one end"),
        (f"{TRANSFORMER}open transformer.t 2", "transformer.t: open at one end"),
        *further(
            ("open line.other 2\nopen line.other 1", "line.other: open, kept"),
            ("new generator.g bus1=01 kv=5.5 kw=90 vminpu=0.95", "generator.g: beyond 0.95 and 1.1 p.u."),
        ),
    ],
)
def test_what_is_written_in_another_form_is_said_and_keeps_the_voltages(tmp_path: Path, case: tuple[str, str]) -> None:
    statements, remark = case
    path = write(tmp_path, f"{SMALL}{statements}\nsolve\n")
    assert compare(path)[1] < 1e-8
    assert [found.text for found in import_grid(path).remarks if found.text.startswith(remark)]


@pytest.mark.parametrize(
    "case",
    [
        ("edit vsource.source z1=[0.1 0.5] z2=[0.3 0.9] z0=[0.2 0.6]", "vsource.source: its matrix is not symmetric"),
        ("new generator.g bus1=01 kv=4.16 kw=90 kvar=30 model=2 conn=delta", "generator.g: its currents in OpenDSS"),
        ("set frequency=50", "vsource.source: has 60 Hz, and the circuit is solved at 50 Hz"),
        *further(
            ("edit vsource.source frequency=50", "vsource.source: has 50 Hz, and the circuit is solved at 60 Hz"),
            ("new reactor.r bus1=1 bus2=01 z1=[1 5] z2=[3 9] z0=[2 6]", "reactor.r: its matrix is not symmetric"),
            ("new line.l phases=1 bus1=1.1 bus2=1.2 c1=4000\nopen line.l 2", "line.l: is open at one of its ends"),
            ("new swtcontrol.s switchedobj=load.a switchedterm=1 normal=open state=open", "load.a: is open"),
        ),
    ],
)
def test_what_would_have_other_voltages_is_refused_by_name(tmp_path: Path, case: tuple[str, str]) -> None:
    statements, problem = case
    with pytest.raises(InvalidInputError) as error:
        import_grid(write(tmp_path, f"{SMALL}{statements}\nsolve\n"))
    assert [found for found in error.value.problems if found.startswith(problem)], error.value.problems


def test_a_limit_of_memory_that_stands_is_not_raised() -> None:
    program = (
        "import resource; from dsse_core.operating_system import confine; resource.setrlimit(resource.RLIMIT_AS, "
        "(2**32, 2**32)); confine(2**33); print(resource.getrlimit(resource.RLIMIT_AS)[1])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert int(done.stdout) == 2**32


@pytest.mark.long
def test_a_crash_of_opendss_is_named(tmp_path: Path) -> None:
    path = write(tmp_path, SMALL)
    script = read_script(path)
    script.commands.append(Command("new load.c bus1=1 phases=100000000", "test"))
    with pytest.raises(InvalidInputError, match="OpenDSS crashed on the circuit"):
        solve_circuit(script, path)


def test_opendss_that_takes_too_long_is_stopped(tmp_path: Path) -> None:
    path = write(tmp_path, TOY)
    with pytest.raises(InvalidInputError, match=r"has not solved it within 0\.01 s"):
        solve_circuit(read_script(path), path, longest_s=0.01)


def test_even_a_statement_that_no_check_stops_writes_nothing(tmp_path: Path) -> None:
    commands = [[line, "-"] for line in TOY.replace("\n~", "").splitlines()[1:] if line]
    target = tmp_path / "written.csv"
    commands.append([f"export voltages {target}", "-"])
    module = [sys.executable, "-P", "-m", "scenarios.importers.opendss.engine"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run(
        module, input=json.dumps({"commands": commands}), text=True, cwd=tmp_path, env=environment, capture_output=True
    )
    assert not target.exists() or target.stat().st_size == 0
    assert sum(path.stat().st_size for path in tmp_path.rglob("*") if path.is_file()) == 0


def test_words_are_those_of_the_installed_opendss() -> None:
    import opendssdirect as dss

    vocabulary = load_vocabulary()
    for number, words in (
        (dss.Executive.NumCommands(), vocabulary.verbs),
        (dss.Executive.NumOptions(), vocabulary.options),
    ):
        name = dss.Executive.Command if words is vocabulary.verbs else dss.Executive.Option
        assert [name(k).lower() for k in range(1, number + 1)] == list(words.order)
    dss.Text.Command("clear")
    dss.Text.Command("new circuit.x")
    dss.Text.Command("new transformer.t")
    dss.Text.Command("new capacitor.c")
    for name, words in vocabulary.classes.items():
        given = {"regcontrol": " transformer=t", "capcontrol": " element=transformer.t capacitor=c"}.get(name, "")
        given = " switchedobj=transformer.t" if name == "swtcontrol" else given
        if name != "vsource":
            dss.Text.Command(f"new {name}.zz{given}")
        else:
            dss.Circuit.SetActiveElement("vsource.source")
        assert [word.lower() for word in dss.Element.AllPropertyNames()] == list(words.order), name
    assert isinstance(vocabulary.verbs, Words)


CASES = [
    pytest.param("13Bus/IEEE13Nodeckt.dss", 1e-8, id="13"),
    pytest.param("34Bus/ieee34Mod1.dss", 1e-8, id="34"),
    pytest.param("37Bus/ieee37.dss", 1e-7, id="37"),
    pytest.param("123Bus/IEEE123Master.dss", 1e-8, id="123"),
    *(
        pytest.param(f"4Bus-{name}-Bal/4Bus-{name}-Bal.DSS", 1e-8, id=name.lower())
        for name in ("DY", "YD", "GrdYD", "YY")
    ),
    pytest.param("4Bus-OYOD-UnBal/4bus-OYOD-UnBal.dss", 1e-8, id="oyod"),
    pytest.param("LVTestCase/Master.dss", 1e-8, id="lv"),
    pytest.param("8500-Node/Master-unbal.dss", 1e-8, id="8500"),
]


@pytest.mark.long
@pytest.mark.skipif(not FEEDERS.is_dir(), reason="OPENDSS_FEEDERS names no checkout of dss-extensions/electricdss-tst")
@pytest.mark.parametrize(("file", "bound"), CASES)
def test_the_power_flow_of_a_test_feeder_is_that_of_opendss(file: str, bound: float) -> None:
    _, to_ground, between = compare(FEEDERS / file, FEEDERS)
    assert between < bound
    assert to_ground < bound


def test_hostile_circuits_leave_nothing(tmp_path: Path) -> None:
    before = sorted(tmp_path.rglob("*"))
    path = write(tmp_path, TOY + "export voltages written.csv\nnew generator.h bus1=632 usermodel=./any.so\n")
    with pytest.raises(InvalidInputError) as error:
        import_grid(path)
    assert len(error.value.problems) == 2
    assert sorted(tmp_path.rglob("*")) == [*before, path]


def fix_taps(**steps: int) -> tuple[str, ...]:
    return (*(f"transformer.{name}.wdg=2 tap={1 + 0.00625 * step}" for name, step in steps.items()), NO_CONTROL)


NO_CONTROL = "set controlmode=off"
STIFF = "edit vsource.source mvasc3=200000 mvasc1=200000"  # as the other 4-bus feeders; the file has 1e6
STORED = {
    "ieee13": ("13Bus/IEEE13Nodeckt.dss", (*fix_taps(reg1=10, reg2=8, reg3=11), "edit line.671692 switch=no")),
    "ieee34": ("34Bus/ieee34Mod1.dss", ()),
    "ieee37": ("37Bus/ieee37.dss", ()),
    **{f"4bus-{name.lower()}": (f"4Bus-{name}-Bal/4Bus-{name}-Bal.DSS", ()) for name in ("DY", "YD", "GrdYD", "YY")},
    "4bus-oyod": ("4Bus-OYOD-UnBal/4bus-OYOD-UnBal.dss", (STIFF,)),
}


TAPS_123 = {"1a": 7, "2a": -1, "3a": 0, "3c": -1, "4a": 8, "4b": 1, "4c": 5}
STORED["ieee123"] = ("123Bus/IEEE123Master.dss", fix_taps(**{f"reg{name}": step for name, step in TAPS_123.items()}))
MERGED = {  # the two buses of each switch as one, since with the impedances of switches voltages are 9e-7 p.u. off
    "ieee13": ("edit line.692675 bus1=671", "edit load.692 bus1=671.3.1", "edit line.671692 enabled=no"),
    "ieee123": (
        *(f"edit regcontrol.creg{name} enabled=no" for name in TAPS_123),
        "edit transformer.reg1a buses=[150 149]",
        "edit line.l116 bus1=13",
        "edit line.l114 bus1=18",
        *(f"edit transformer.reg4{phase} buses=[60.{k} 160r.{k}]" for k, phase in enumerate("abc", 1)),
        "edit line.l118 bus1=97",
        "edit transformer.xfm1 buses=[61 610]",
        *(f"edit line.sw{k} enabled=no" for k in range(1, 9)),
    ),
}


def read_stored(name: str, further_commands: tuple[str, ...] = ()) -> Circuit:
    file, commands = STORED[name]
    script = read_script(FEEDERS / file, FEEDERS)
    script.commands += [Command(text, "test") for text in (*commands, *further_commands)]
    return Circuit(solve_circuit(script, FEEDERS / file), script)


@pytest.mark.long
@pytest.mark.skipif(not FEEDERS.is_dir(), reason="OPENDSS_FEEDERS names no checkout of dss-extensions/electricdss-tst")
@pytest.mark.parametrize("name", [name for name in STORED if name != "ieee123"])
def test_the_feeders_of_the_tests_are_those_of_opendss(name: str) -> None:
    """Their matrices are by parameters, without the 4.2e-8 S that OpenDSS adds at each end of a line."""
    circuit, stored = read_stored(name), load_feeder(name)
    circuit.base_mva = stored.base_mva
    mine = circuit.finish(FEEDERS / STORED[name][0]).network
    assert [(bus.id, bus.phases) for bus in mine.buses] == [(bus.id, bus.phases) for bus in stored.buses]
    theirs, ours = (build_admittance(network).ybus.toarray() for network in (stored, mine))
    assert abs(ours - theirs) / abs(theirs).max(axis=1, keepdims=True) == pytest.approx(0.0, abs=2e-6)
    legs = [[(leg.bus, leg.phases, *leg.exponents) for leg in network.loads] for network in (mine, stored)]
    assert sorted(legs[0]) == sorted(legs[1])
    power = [sorted(leg.s.real * network.base_mva for leg in network.loads) for network in (mine, stored)]
    assert power[0] == pytest.approx(power[1], rel=1e-9, abs=1e-12)
    shunts = [[bus.b_shunt * network.base_mva for bus in network.buses] for network in (mine, stored)]
    assert shunts[0] == pytest.approx(shunts[1], abs=1e-9)


@pytest.mark.long
@pytest.mark.skipif(not FEEDERS.is_dir(), reason="OPENDSS_FEEDERS names no checkout of dss-extensions/electricdss-tst")
@pytest.mark.parametrize("name", STORED)
def test_the_stored_voltages_are_those_of_opendss(name: str) -> None:
    whole, merged = read_stored(name), read_stored(name, MERGED.get(name, ()))
    bus_of = {number: bus for bus, number in merged.number.items()}
    found = {
        name_node(whole.number[bus_of[number]], phase): u * merged.kv[bus_of[number]] / whole.kv[bus_of[number]]
        for (number, phase), u in merged.voltages.items()
    }
    feeder, stored = load_feeder(name), load_voltages(name)
    apart = {node: found[name_node(*node)] - v for node, v in zip(feeder.nodes, stored, strict=True) if not np.isnan(v)}
    for bus in feeder.gauge.ungrounded:  # between phases alone
        of_bus = [node for node in apart if node[0] == bus]
        apart |= {node: apart[node] - apart[of_bus[0]] for node in of_bus}
    assert len(apart) > len(stored) - 7
    assert max(map(abs, apart.values())) < 2e-9
