"""The files of a generated feeder: a network file and a scenario file that runs on it."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.grid.network import Network
from scenarios.files.saved_network import name_network_file, save_network
from scenarios.files.whole_folder import written_whole
from scenarios.generate.feeder import Tree, generate_feeder

METERS_STREAM = 1  # of the seed; the network has stream 0, so that it is the same whatever the meters are
VOLTMETER_EVERY = {"standard": 10, "sparse": 50}  # buses
SCENARIO_FILE = "scenario.toml"

SCENARIO = """\
# Written by: {command}

version = 1
name = "{name}"
description = "{description}"
seed = {seed}
network = "{network}"
strategy = "information"
areas = {{ count = {n_area} }}

[measurements]
floor_kva = 1.0
zero_injection = "virtual"
voltage = {{ buses = {voltmeters}, sigma_percent = 0.2 }}
flow = {{ branches = {flow_meters}, sigma_percent = 1.0 }}
injection = {{ buses = "all", sigma_percent = {injection_percent} }}

[run]
beat_s = {beat_s}
"""
SHORTEST_HEARTBEAT_S, LONGEST_HEARTBEAT_S = 0.2, 10.0
REPEATS_PER_S = 100  # of all areas together, each with its whole state: the load of a watcher


def write_generated(
    folder: Path,
    n_bus: int,
    seed: int,
    *,
    n_area: int,
    lowest_vm: float = 0.94,
    n_pv: int = 0,
    meters: Literal["standard", "sparse"] = "standard",
) -> Path:
    """Write network file and ``scenario.toml`` into ``folder``, always the same ones; the path of the scenario.

    ``standard``: a voltmeter at the substation and at one bus in ten, flow meters on all branches, injection meters
    of 10 %. ``sparse``: a voltmeter at one bus in fifty, flow meters where trunks and laterals begin, injections from
    load profiles (30 %).

    Raises:
        InvalidInputError: more areas than branches, or as ``generate_feeder``.
        OSError: ``folder`` cannot be made or written; then it is as before.
    """
    if n_area >= n_bus:
        problem = f"{n_area} areas are asked for, but {n_bus} buses have {n_bus - 1} branches; ask for fewer"
        raise InvalidInputError("generated feeder", [problem])
    network, tree = generate_feeder(n_bus, np.random.default_rng([seed, 0]), lowest_vm=lowest_vm, n_pv=n_pv)
    command = f"dsse generate --buses {n_bus} --seed {seed} --areas {n_area} --lowest-vm {lowest_vm} --meters {meters}"
    command += f" --pv {n_pv}" if n_pv else ""
    scenario = _format_scenario(command, network, tree, seed, n_area, meters)
    with written_whole(folder) as new:
        save_network(new / name_network_file(n_bus), network, f"made up by: {command}")
        (new / SCENARIO_FILE).write_text(scenario, encoding="utf-8")
    return folder / SCENARIO_FILE


def _format_scenario(
    command: str, network: Network, tree: Tree, seed: int, n_area: int, meters: Literal["standard", "sparse"]
) -> str:
    rng = np.random.default_rng([seed, METERS_STREAM])
    n_bus = len(network.buses)
    drawn = rng.choice(np.arange(2, n_bus + 1), size=(n_bus - 1) // VOLTMETER_EVERY[meters], replace=False)
    flow_meters = '"all"'
    if meters == "sparse":
        flow_meters = "[" + ", ".join(f'"{network.branches[row - 1].id}"' for row in tree.heads) + "]"
    return SCENARIO.format(
        command=command,
        name=f"{network.name}-{seed}",
        description=f"A made-up feeder of {n_bus} buses in {n_area} areas, {meters} meters",
        seed=seed,
        network=name_network_file(n_bus),
        n_area=n_area,
        voltmeters=[1, *sorted(drawn.tolist())],
        flow_meters=flow_meters,
        injection_percent=10.0 if meters == "standard" else 30.0,
        beat_s=min(max(n_area / REPEATS_PER_S, SHORTEST_HEARTBEAT_S), LONGEST_HEARTBEAT_S),
    )
