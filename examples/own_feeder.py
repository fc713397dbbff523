"""A feeder of your own: from a list of cables and loads to tables and a figure.

    python examples/own_feeder.py [FOLDER]

Change the lists below. FOLDER gets network.json, scenario.toml, the tables of the estimate and voltages.pdf.
"""

import json
import sys
from pathlib import Path

import matplotlib.pyplot as plt

import consensus_dsse as dsse

KV = 20.0
SUBSTATION = 1
CABLES = [  # from, to, km, ohm per km: r and x, rating in A
    (1, 2, 1.2, 0.161, 0.117, 362),
    (2, 3, 0.9, 0.161, 0.117, 362),
    (3, 4, 1.5, 0.161, 0.117, 362),
    (4, 5, 0.8, 0.253, 0.119, 270),
    (5, 6, 1.1, 0.253, 0.119, 270),
    (3, 7, 2.0, 0.253, 0.119, 270),
    (7, 8, 1.4, 0.253, 0.119, 270),
    (8, 9, 0.7, 0.253, 0.119, 270),
]
LOADS = {  # bus: kW and kvar
    2: (350, 90),
    4: (640, 210),
    5: (410, 120),
    6: (880, 260),
    7: (300, 60),
    8: (520, 170),
    9: (760, 250),
}
SCENARIO = """\
version = 1
name = "my-feeder"
description = "My feeder: voltage and flow at the substation and at two stations, forecasts of all loads"
network = "network.json"
areas = { count = 2 }

[measurements]
voltage = { buses = [1, 3, 9], sigma_percent = 0.3 }
flow = { branches = ["1-2", "3-4", "3-7"], sigma_percent = 1.0 }
injection = { buses = "all", sigma_percent = 30.0 }   # forecasts; buses without load inject exactly nothing
"""


def write_files(folder: Path) -> Path:
    """Write the network and the scenario; the path of the scenario."""
    buses = sorted({SUBSTATION, *(end for cable in CABLES for end in cable[:2])})
    network = {
        "name": "my-feeder",
        "data_source": "cable list of my feeder",
        "base_mva": 10.0,
        "bus": {
            "id": buses,
            "base_kv": [KV] * len(buses),
            "p_load_mw": [LOADS.get(bus, (0, 0))[0] / 1000 for bus in buses],
            "q_load_mvar": [LOADS.get(bus, (0, 0))[1] / 1000 for bus in buses],
        },
        "branch": {
            "from": [cable[0] for cable in CABLES],
            "to": [cable[1] for cable in CABLES],
            "r_ohm": [km * r for _, _, km, r, _, _ in CABLES],
            "x_ohm": [km * x for _, _, km, _, x, _ in CABLES],
            "rating_a": [float(cable[5]) for cable in CABLES],
        },
        "source": [{"bus": SUBSTATION, "kind": "slack", "vm_pu": 1.02}],
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "network.json").write_text(json.dumps(network, indent=1))
    path = folder / "scenario.toml"
    path.write_text(SCENARIO)
    return path


def find_distances() -> dict[int, float]:
    """Bus -> km from the substation."""
    km = {SUBSTATION: 0.0}
    for upper, lower, length, *_ in CABLES:  # sorted away from the substation
        km[lower] = km[upper] + length
    return km


def draw_voltages(result: dsse.RunResult, path: Path) -> None:
    """The voltage along the feeder, with three standard deviations."""
    km = find_distances()
    buses, rows = result.buses, range(len(result.buses))
    figure, axes = plt.subplots(figsize=(5, 3), layout="constrained")
    row = {int(buses.bus[k]): k for k in rows}
    for upper, lower, *_ in CABLES:
        ends = [row[upper], row[lower]]
        axes.plot([km[upper], km[lower]], buses.vm_pu[ends], color="C0")
    distances = [km[int(bus)] for bus in buses.bus]
    axes.errorbar(distances, buses.vm_pu, yerr=3 * buses.sigma_vm_pu, fmt="o", capsize=3, label="estimate, 3 sigma")
    axes.plot(distances, buses.true_vm_pu, "kx", label="truth")
    axes.set(xlabel="distance from the substation in km", ylabel="voltage in p.u.")
    axes.legend()
    figure.savefig(path)


def main(folder: Path) -> None:
    path = write_files(folder)
    scenario = dsse.load_scenario(path)
    print(scenario)
    print(dsse.power_flow(scenario))

    result = dsse.simulate(scenario, out=folder / "run")  # `dsse.run` does it with real processes
    print(result)
    branches = result.branches
    for k in branches.loading_percent.argsort()[::-1][:3]:
        name, amperes, load = branches.branch[k], branches.i_from_a[k], branches.loading_percent[k]
        print(f"branch {name}: {amperes:.1f} A, {load:.0f} % of its rating")
    for k in result.buses.vm_pu.argsort()[:3]:
        bus, vm_kv, sigma = result.buses.bus[k], result.buses.vm_kv[k], result.buses.sigma_vm_pu[k]
        print(f"bus {bus}: {vm_kv:.3f} kV, standard deviation {sigma * KV * 1000:.0f} V")
    draw_voltages(result, folder / "voltages.pdf")
    print(f"tables in {result.folder}, figure {folder / 'voltages.pdf'}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "my-feeder"))
