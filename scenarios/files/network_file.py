"""Network files: a whole grid in engineering units (kV, MW, Mvar, ohm) as TOML; per unit and radians come out."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Collection, Iterable, Mapping
from itertools import count
from pathlib import Path
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from dsse_core.errors import InvalidInputError
from dsse_core.files.kinds import NETWORK_FILE, FileKind
from dsse_core.files.quantities import Positive
from dsse_core.files.strict_table import FileTable, Table, load_strict
from dsse_core.files.wording import suggest
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.grid.physical_ranges import find_base_problems, find_range_problems
from dsse_core.limits import LONGEST_NAME
from scenarios.files.shipped_files import find_shipped
from scenarios.files.zero_impedances import find_zero_impedance_problems

BRANCH_ID = re.compile(rf"[a-z0-9_-]{{1,{LONGEST_NAME}}}")  # the id of a meter holds it, and has its limit on the wire
NOTHING = (None,) * 4


class BusTable(Table):
    """One ``[[bus]]``."""

    id: int = Field(description="the number of the bus, its own in the network")
    base_kv: Positive = Field(description="nominal voltage in kV")
    name: str = ""
    p_load_mw: float = 0.0
    q_load_mvar: float = 0.0
    g_shunt_mw: float = Field(default=0.0, description="MW that the shunt consumes at 1 p.u. voltage")
    b_shunt_mvar: float = Field(default=0.0, description="Mvar that the shunt produces at 1 p.u. voltage")


class BranchTable(Table):
    """One ``[[branch]]``: a line or a transformer, its tap at the from side."""

    from_: int = Field(alias="from", description="id of the bus at the tap side")
    to: int = Field(description="id of the bus at the other end")
    id: str | None = Field(
        default=None,
        pattern=f"^{BRANCH_ID.pattern}$",
        description=f"at most {LONGEST_NAME} lower-case letters, digits, _ and -",
    )
    r_ohm: float | None = None
    x_ohm: float | None = None
    b_us: float | None = Field(default=None, description="total charging in microsiemens")
    g_us: float | None = Field(default=None, description="total leakage or iron losses in microsiemens")
    r_pu: float | None = None
    x_pu: float | None = None
    b_pu: float | None = Field(default=None, description="total charging in p.u.")
    g_pu: float | None = Field(default=None, description="total leakage or iron losses in p.u.")
    tap_ratio: Positive = Field(default=1.0, description="divides the from-side voltage; 1.0 for a line")
    shift_deg: float = 0.0
    in_service: bool = True

    @property
    def is_in_ohm(self) -> bool:
        return self.r_ohm is not None

    @model_validator(mode="after")
    def _has_one_complete_impedance(self) -> Self:
        ohm = (self.r_ohm, self.x_ohm, self.b_us, self.g_us)
        pu = (self.r_pu, self.x_pu, self.b_pu, self.g_pu)
        if ohm != NOTHING and pu != NOTHING:
            raise ValueError(
                "mixes ohm and microsiemens with r_pu/x_pu/b_pu/g_pu; give all of them in one of the two units"
            )
        if None in ohm[:2] and None in pu[:2]:
            raise ValueError("has no complete impedance; give r_ohm and x_ohm, or r_pu and x_pu")
        return self


class SourceTable(Table):
    """One ``[[source]]``: the substation or a generator."""

    bus: int = Field(description="id of the bus that the source feeds")
    kind: Literal["slack", "voltage", "power"] = Field(description="slack: the substation; voltage: holds P and vm")
    p_mw: float = 0.0
    q_mvar: float = 0.0
    vm_pu: Positive | None = None
    va_deg: float | None = None

    @model_validator(mode="after")
    def _has_the_set_points_of_its_kind(self) -> Self:
        if self.kind == "power" and self.vm_pu is not None:
            raise ValueError("vm_pu has no meaning for kind 'power'; remove it or use kind 'voltage'")
        if self.kind != "power" and self.vm_pu is None:
            raise ValueError(f"vm_pu is missing; a source of kind {self.kind!r} needs its voltage set-point in p.u.")
        if self.kind != "slack" and self.va_deg is not None:
            raise ValueError(f"va_deg has no meaning for kind {self.kind!r}; only the slack holds an angle")
        return self


class NetworkFile(FileTable):
    """A whole network file."""

    kind: ClassVar[FileKind] = NETWORK_FILE

    name: str = Field(min_length=1, description="the name of the network")
    data_source: str = Field(min_length=1, description="where the data come from")
    base_mva: Positive = Field(description="base of the per-unit system in MVA")
    bus: list[BusTable] = Field(min_length=1, description="one [[bus]] for each bus")
    branch: list[BranchTable] = Field(min_length=1, description="one [[branch]] for each line and transformer")
    source: list[SourceTable] = Field(min_length=1, description="one [[source]] for the substation and each generator")


def load_case(name: str) -> Network:
    """The shipped network called ``name``.

    Raises:
        InvalidInputError: no such network; lists those that are shipped.
    """
    cases = find_shipped("cases")
    if name not in cases:
        problem = f"no shipped network has this name; shipped: {', '.join(cases)}{suggest(name, cases)}"
        raise InvalidInputError(f"network {name!r}", [problem])
    return load_network(cases[name])


def load_network(path: Path) -> Network:
    """Read a network file; its quantities in p.u. on ``base_mva`` and rad.

    Raises:
        InvalidInputError: listing every problem of the file, with key paths.
    """
    file = load_strict(path, NetworkFile)
    what = file.called(path)
    if problems := list(find_base_problems(file.base_mva, _base_kv_by_bus(file))):
        raise InvalidInputError(what, problems)
    problems = list(_find_unit_problems(file))
    try:
        network = _to_per_unit(file)
    except InvalidInputError as error:
        raise InvalidInputError(what, [*problems, *error.problems]) from None
    if problems := [*problems, *find_range_problems(network), *find_zero_impedance_problems(network)]:
        raise InvalidInputError(what, problems)
    return network


def _base_kv_by_bus(file: NetworkFile) -> dict[int, float]:
    """Bus -> nominal voltage; of a bus that is defined twice, which Network reports, the first counts."""
    return {bus.id: bus.base_kv for bus in reversed(file.bus)}


def _find_unit_problems(file: NetworkFile) -> Iterable[str]:
    base_kv = _base_kv_by_bus(file)
    for i, branch in enumerate(file.branch, 1):
        if not branch.is_in_ohm:
            continue
        from_kv, to_kv = base_kv.get(branch.from_), base_kv.get(branch.to)
        if None not in (from_kv, to_kv) and from_kv != to_kv:
            yield (
                f"branch[{i}].r_ohm: the branch joins bus {branch.from_} of {from_kv} kV and bus {branch.to} of "
                f"{to_kv} kV, so an impedance in ohm is ambiguous; give r_pu and x_pu"
            )


def _to_per_unit(file: NetworkFile) -> Network:
    base = file.base_mva
    buses = tuple(
        Bus(
            id=b.id,
            base_kv=b.base_kv,
            name=b.name,
            p_load=b.p_load_mw / base,
            q_load=b.q_load_mvar / base,
            g_shunt=b.g_shunt_mw / base,
            b_shunt=b.b_shunt_mvar / base,
        )
        for b in file.bus
    )
    generators = tuple(
        Generator(
            bus=s.bus,
            control=Control(s.kind),
            p=s.p_mw / base,
            q=s.q_mvar / base,
            vm=1.0 if s.vm_pu is None else s.vm_pu,
            va=math.radians(s.va_deg or 0.0),
        )
        for s in file.source
    )
    return Network(file.name, base, buses, tuple(_build_branches(file)), generators)


def _build_branches(file: NetworkFile) -> Iterable[Branch]:
    base_kv = _base_kv_by_bus(file)
    taken = {branch.id for branch in file.branch}
    for branch in file.branch:
        branch_id = branch.id or default_branch_id(branch.from_, branch.to, taken)
        taken.add(branch_id)
        if branch.is_in_ohm:
            # An ohm is 1 / z_base p.u.; the base of an unknown bus does not matter, Network reports the bus.
            kv = base_kv.get(branch.from_, 1.0)
            z_base = kv * kv / file.base_mva
            r, x = (branch.r_ohm or 0.0) / z_base, (branch.x_ohm or 0.0) / z_base
            b, g = (branch.b_us or 0.0) * 1e-6 * z_base, (branch.g_us or 0.0) * 1e-6 * z_base
        else:
            r, x, b, g = branch.r_pu or 0.0, branch.x_pu or 0.0, branch.b_pu or 0.0, branch.g_pu or 0.0
        yield Branch(
            id=branch_id,
            from_bus=branch.from_,
            to_bus=branch.to,
            r=r,
            x=x,
            b=b,
            g=g,
            tap=branch.tap_ratio,
            shift=math.radians(branch.shift_deg),
            in_service=branch.in_service,
        )


def default_branch_id(from_bus: int, to_bus: int, taken: Collection[str | None]) -> str:
    """``from-to``; parallel branches get ``#2``, ``#3``, ... behind it. ``taken``: the ids of others."""
    plain = f"{from_bus}-{to_bus}"
    if plain not in taken:
        return plain
    return next(branch_id for number in count(2) if (branch_id := f"{plain}#{number}") not in taken)


def save_network(path: Path, network: Network, data_source: str) -> None:
    """Write a network file that ``load_network`` reads back, TOML or JSON; impedances in p.u., numbers to 15 digits.

    Raises:
        InvalidInputError: listing every branch whose id a network file cannot hold.
    """
    if problems := list(_find_id_problems(network)):
        raise InvalidInputError(NETWORK_FILE.called(path), problems)
    head = {"name": network.name, "data_source": data_source, "base_mva": float(network.base_mva)}
    base = network.base_mva
    rows = {
        "bus": [_bus_row(bus, base) for bus in network.buses],
        "branch": [_branch_row(branch) for branch in network.branches],
        "source": [_source_row(generator, base) for generator in network.generators],
    }
    if path.suffix == ".json":
        path.write_text(json.dumps(head | rows), encoding="utf-8")
        return
    lines = [f"{key} = {format_toml(value)}" for key, value in head.items()]
    for table, items in rows.items():
        lines += ["", f"{table} = [", *(f"    {_inline(item)}," for item in items), "]"]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _find_id_problems(network: Network) -> Iterable[str]:
    """Ids that are neither written nor what ``load_network`` would call the branch."""
    taken: set[str | None] = {branch.id for branch in network.branches if _written_id(branch)}
    for branch in network.branches:
        if not _written_id(branch):
            expected = default_branch_id(branch.from_bus, branch.to_bus, taken)
            taken.add(expected)
            if branch.id != expected:
                yield (
                    f"branch {branch.id!r}: a network file has ids of at most {LONGEST_NAME} lower-case letters, "
                    f"digits, _ and -, or calls this branch {expected!r}; rename it"
                )


def _written_id(branch: Branch) -> str | None:
    """The id where the file must give it."""
    is_default = branch.id.partition("#")[0] == f"{branch.from_bus}-{branch.to_bus}"
    return None if is_default or not BRANCH_ID.fullmatch(branch.id) else branch.id


def _bus_row(bus: Bus, base: float) -> dict[str, object]:
    row: dict[str, object] = {"id": bus.id, "base_kv": bus.base_kv}
    if bus.name:
        row["name"] = bus.name
    for key in ("p_load", "q_load", "g_shunt", "b_shunt"):
        if power := getattr(bus, key):
            row[f"{key}_{'mw' if key in ('p_load', 'g_shunt') else 'mvar'}"] = power * base
    return row


def _branch_row(branch: Branch) -> dict[str, object]:
    row: dict[str, object] = {"from": branch.from_bus, "to": branch.to_bus}
    if (branch_id := _written_id(branch)) is not None:
        row["id"] = branch_id
    row |= {"r_pu": branch.r, "x_pu": branch.x}
    optional = {
        "b_pu": (branch.b, 0.0),
        "g_pu": (branch.g, 0.0),
        "tap_ratio": (branch.tap, 1.0),
        "shift_deg": (math.degrees(branch.shift), 0.0),
        "in_service": (branch.in_service, True),
    }
    return row | {key: value for key, (value, default) in optional.items() if value != default}


def _source_row(generator: Generator, base: float) -> dict[str, object]:
    row: dict[str, object] = {"bus": generator.bus, "kind": str(generator.control)}
    row |= {k: p * base for k, p in (("p_mw", generator.p), ("q_mvar", generator.q)) if p}
    if generator.control is not Control.POWER:
        row["vm_pu"] = generator.vm
    if generator.control is Control.SLACK:
        row["va_deg"] = math.degrees(generator.va)
    return row


def _inline(row: Mapping[str, object]) -> str:
    return "{ " + ", ".join(f"{key} = {format_toml(value)}" for key, value in row.items()) + " }"


def format_toml(value: object) -> str:
    """``value`` as TOML; texts are JSON's, which are TOML's but for the delete character."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(float(value)) if isinstance(value, float) else str(value)  # exact
