"""Feeders of OpenDSS as network files with phases by parameters, and the voltages that OpenDSS finds with them, the
buses of switches merged: ``test_import_opendss.py`` compares both with the importer's. ``ieee123`` is the shipped file.
"""

from __future__ import annotations

import functools
import json
from pathlib import Path

import numpy as np

from dsse_core.grid.network import Network
from scenarios.files.network_file import load_case, load_network

HERE = Path(__file__).parent
NAMES = ("ieee13", "ieee34", "ieee37", "ieee123", "4bus-dy", "4bus-yd", "4bus-grdyd", "4bus-yy", "4bus-oyod")
SHIPPED = ("ieee123",)  # read from there


@functools.cache
def load_feeder(name: str) -> Network:
    return load_case(name) if name in SHIPPED else load_network(HERE / f"{name}.json")


def load_voltages(name: str) -> np.ndarray:
    """The voltages that OpenDSS finds at the nodes of a feeder but its source, complex, p.u.; nan where it has none."""
    known = json.loads((HERE / "voltages.json").read_text(encoding="utf-8"))[name]
    found = [known.get(node, (np.nan, np.nan)) for node in load_feeder(name).node_names]
    vm, va = np.array(found).T
    v: np.ndarray = vm * np.exp(1j * np.radians(va))
    return v
