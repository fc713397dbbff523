"""Feeders of a size, and the same as files of another project and with real readings."""

from __future__ import annotations

import sys
from pathlib import Path

from dsse_core.grid.network import Control, Network
from scenarios.files.readings.file import save_readings
from scenarios.files.saved_network import name_network_file, save_network
from scenarios.generate.generated_files import write_generated
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry

BUSES_OF_AN_AREA = 500
SEED = 7
NETWORK = "network.json"
SLACK_TYPE, LOAD_TYPE = 3, 1


def count_areas(n_bus: int) -> int:
    return max(2, n_bus // BUSES_OF_AN_AREA)


def write_inputs(folder: Path, n_bus: int) -> None:
    """``scenario.toml`` with its network, ``measured.toml`` with ``readings.csv``, and ``case.m``, in ``folder``.

    The network is JSON whatever its size: TOML takes many times as long, and an exponent over both means nothing.
    """
    path = write_generated(folder, n_bus, SEED, n_area=count_areas(n_bus))
    scenario = load_scenario(path)
    save_network(folder / NETWORK, scenario.network, "a feeder of dsse generate")
    named = f'network = "{name_network_file(n_bus)}"'
    path.write_text(path.read_text(encoding="utf-8").replace(named, f'network = "{NETWORK}"'), encoding="utf-8")
    real = [m for m in make_telemetry(scenario).union if m.sigma > 0]
    save_readings(folder / "readings.csv", scenario.network, real)
    head, _, _ = path.read_text(encoding="utf-8").partition("[measurements]")
    measured = f'{head}[telemetry]\nsource = "file"\nfile = "readings.csv"\n'
    (folder / "measured.toml").write_text(measured, encoding="utf-8")
    (folder / "case.m").write_text(format_matpower(scenario.network), encoding="utf-8")


def format_matpower(network: Network) -> str:
    """A MATPOWER case, version 2, of a radial feeder without shunts; columns as in its ``caseformat``."""
    base = network.base_mva
    slack = next(g for g in network.generators if g.control is Control.SLACK)
    buses = [
        f"{b.id} {SLACK_TYPE if b.id == slack.bus else LOAD_TYPE} {b.p_load * base!r} {b.q_load * base!r} "
        f"0 0 1 1 0 {b.base_kv!r} 1 1.1 0.9;"
        for b in network.buses
    ]
    branches = [
        f"{b.from_bus} {b.to_bus} {b.r!r} {b.x!r} {b.b!r} 0 0 0 0 0 1 -360 360;" for b in network.active_branches
    ]
    return "\n".join(
        [
            "function mpc = case_of_benchmark",
            "mpc.version = '2';",
            f"mpc.baseMVA = {base!r};",
            "mpc.bus = [",
            *buses,
            "];",
            f"mpc.gen = [{slack.bus} 0 0 0 0 {slack.vm!r} {base!r} 1 0 0];",
            "mpc.branch = [",
            *branches,
            "];\n",
        ]
    )


if __name__ == "__main__":
    write_inputs(Path(sys.argv[1]), int(sys.argv[2]))
