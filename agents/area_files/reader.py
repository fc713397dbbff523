"""Reads and checks an area file, TOML or JSON. Agents need it; who writes the files does not."""

from __future__ import annotations

import dataclasses
import functools
import typing
from collections import Counter
from collections.abc import Iterator
from itertools import repeat
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model, model_validator
from pydantic_core import PydanticCustomError

from agents.area_files.area_file import AreaFile, keys_of
from agents.messages.keys import NAME
from dsse_core.errors import InvalidInputError
from dsse_core.estimation.state_limits import DEFAULT_LIMITS, StateLimits
from dsse_core.files.bounded_file import LARGEST_JSON, LARGEST_TOML, read_text
from dsse_core.files.bounded_parsing import parse_json, parse_toml
from dsse_core.grid.measurement import Meter, find_meter_problems
from dsse_core.grid.network import Branch, Bus, Generator, Network
from dsse_core.grid.partition import Area, Neighbour
from dsse_core.limits import LONGEST_S, SHORTEST_SCAN_S
from dsse_core.link_faults import LinkFaults

T = TypeVar("T")
OF_ONE_LENGTH = "of_one_length"  # our type of a schema's error


def load_area_file(path: Path) -> AreaFile:
    """Read and check an area file.

    Raises:
        InvalidInputError: naming the file and every unknown, missing or impossible key.
    """
    what = f"area file {path}"
    t = _read_tables(what, path)
    network = _network_of(what, t)
    meters = _items_of(Meter, t.meter)
    if problems := [*find_meter_problems(network, meters), *_find_place_problems(t, network)]:
        raise InvalidInputError(what, problems)
    reference = (t.reference.bus, t.reference.va) if t.reference else None
    neighbours = tuple(Neighbour(n.area, n.bus, n.is_parent) for n in t.neighbour)
    area = Area(
        name=t.area,
        network=network,
        neighbours=neighbours,
        slack_bus=t.local_slack.bus,
        slack_vm=t.local_slack.vm,
        reference=reference,
        towards_hub=t.exchange.towards_hub,
        n_areas=t.exchange.areas,
        entry_voltage=(t.exchange.entry_vm, t.exchange.entry_va),
    )
    return AreaFile(
        run=t.run,
        area=area,
        meters=meters,
        strategy=t.strategy,
        endpoints=tuple(t.endpoints),
        listen=tuple(t.listen),
        beat_s=t.beat_s,
        scan_s=t.scan_s,
        tolerance=t.tolerance,
        generation=t.load_messages.generation,
        load_error=complex(t.load_messages.p_error, t.load_messages.q_error),
        links={n.area: LinkFaults(**vars(n.faults)) for n in t.neighbour},
        seed=t.seed,
        penalty=t.admm.penalty,
        limits=StateLimits(**vars(t.quality)),
    )


def _read_tables(what: str, path: Path) -> Any:
    """The file as ``_file_like`` describes it: every key is known, there and of its type."""
    is_json = path.suffix == ".json"
    text = read_text(path, largest=LARGEST_JSON if is_json else LARGEST_TOML, what=what)
    try:
        table = parse_json(text) if is_json else parse_toml(text)
    except ValueError as error:
        raise InvalidInputError(what, [f"is not {'JSON' if is_json else 'TOML'}: {error}"]) from None
    if isinstance(table, dict) and not {"area", "local_slack"} & table.keys():
        raise InvalidInputError(what, ["is no area file; `dsse split SCENARIO --out DIR` writes one for each area"])
    try:
        return _file_like(_columns_like if is_json else _rows_like).model_validate(table)
    except ValidationError as error:
        raise InvalidInputError(what, [describe_schema_error(e) for e in error.errors()]) from None


def _network_of(what: str, t: Any) -> Network:
    try:
        return Network(
            name=t.area,
            base_mva=t.network.base_mva,
            buses=_items_of(Bus, t.network.bus),
            branches=_items_of(Branch, t.network.branch),
            generators=_items_of(Generator, t.network.generator),
        )
    except InvalidInputError as error:
        raise InvalidInputError(what, [f"network: {problem}" for problem in error.problems]) from None


def _items_of(cls: type[T], table: Any) -> tuple[T, ...]:
    """The dataclasses of a table of ``_rows_like`` or of ``_columns_like``."""
    if isinstance(table, list):
        return tuple(cls(**vars(row)) for row in table)
    columns = [getattr(table, key) for key, _ in keys_of(cls)]
    defaults = [default for _, default in keys_of(cls)]
    given = [repeat(default) if c is None else c for c, default in zip(columns, defaults, strict=True)]
    return tuple(map(cls, *given))  # as long as the shortest, and without a default they must be given


def _find_place_problems(t: Any, network: Network) -> Iterator[str]:
    """What does not fit the network, and where nobody could be met."""
    for n in t.neighbour:
        if n.bus not in network.row:
            yield f"neighbour {n.area}: bus {n.bus} is not in the network"
        if n.area == t.area:
            yield f"neighbour {n.area}: is the area itself"
    for name, count in Counter(n.area for n in t.neighbour).items():
        if count > 1:
            yield f"neighbour {name}: is given twice; keep one of them"
    if t.local_slack.bus not in network.row:
        yield f"local_slack.bus: bus {t.local_slack.bus} is not in the network"
    if t.reference and t.reference.bus not in network.row:
        yield f"reference.bus: bus {t.reference.bus} is not in the network"
    elif t.reference and not (network.slack and network.slack.bus == t.reference.bus):
        yield (
            f"reference.bus: bus {t.reference.bus} is not the substation, from which all angles count; "
            "leave [reference] out"
        )
    if t.exchange.towards_hub is not None and t.exchange.towards_hub not in {n.area for n in t.neighbour}:
        yield f"exchange.towards_hub: {t.exchange.towards_hub} is no neighbour"
    if t.exchange.areas <= len(t.neighbour):
        yield f"exchange.areas: is {t.exchange.areas}; this area and its neighbours alone are {len(t.neighbour) + 1}"
    if sum(n.is_parent for n in t.neighbour) != (0 if network.slack else 1):
        yield "neighbour: exactly one must be the parent, or none where the network holds the substation"
    if t.quality.lowest_vm >= t.quality.highest_vm:
        yield f"quality.lowest_vm: is {t.quality.lowest_vm:g}; it must be below highest_vm, {t.quality.highest_vm:g}"
    if not (t.endpoints or t.listen):
        yield "endpoints: is empty; name a router, or give listen, where neighbours link with this area"


def describe_schema_error(error: Any) -> str:
    """One line for one error of pydantic: the key's path, what is wrong, what was found."""
    path = "".join(f"[{part + 1}]" if isinstance(part, int) else f".{part}" for part in error["loc"]).lstrip(".")
    if error["type"] == "extra_forbidden":
        return f"{path}: unknown key"
    if error["type"] == "missing":
        return f"{path}: missing key"
    if error["type"] == OF_ONE_LENGTH:
        return f"{path}: {error['msg']}"
    message = "must be one table, of keys and their values" if error["type"] == "model_type" else error["msg"]
    return f"{path}: {message}, found {error['input']!r:.80}"


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class _Slack(_Strict):
    bus: int
    vm: float | None = Field(None, gt=0)


class _Reference(_Strict):
    bus: int
    va: float = 0.0


class _Exchange(_Strict):
    towards_hub: str | None = None
    areas: int = Field(ge=1)
    entry_vm: float = Field(gt=0)
    entry_va: float


class _LoadMessages(_Strict):
    generation: Literal["telemetered", "scheduled"] = "telemetered"
    p_error: float = 0.0
    q_error: float = 0.0


class _Admm(_Strict):
    penalty: float = Field(default=1.0, gt=0)


class _Quality(_Strict):
    lowest_vm: float = Field(default=DEFAULT_LIMITS.lowest_vm, ge=0)
    highest_vm: float = Field(default=DEFAULT_LIMITS.highest_vm, gt=0)
    most_removed: float = Field(default=DEFAULT_LIMITS.most_removed, ge=0, le=1)


class _Columns(_Strict):
    @model_validator(mode="after")
    def _are_of_one_length(self) -> Self:
        lengths = {key: len(column) for key, column in vars(self).items() if column is not None}
        if len(set(lengths.values())) > 1:
            found = ", ".join(f"{key} has {length}" for key, length in lengths.items())
            raise PydanticCustomError(OF_ONE_LENGTH, "the lists need as many values each; {found}", {"found": found})
        return self


def _table_like(cls: type[Any], **extra: Any) -> Any:
    """A strict table whose keys are the fields of dataclass ``cls``; ``extra`` replaces or adds some."""
    hints = typing.get_type_hints(cls)
    keys = {key: (hints[key], ... if default is dataclasses.MISSING else default) for key, default in keys_of(cls)}
    return create_model(cls.__name__, __base__=_Strict, **(keys | extra))


def _rows_like(cls: type[Any], **extra: Any) -> Any:
    """A list of such tables."""
    return list[_table_like(cls, **extra)]  # type: ignore[misc]


def _columns_like(cls: type[Any]) -> Any:
    """One strict table with a list of values, all of one length, for each field of dataclass ``cls``."""
    hints: Any = typing.get_type_hints(cls)
    keys: Any = {}
    for key, default in keys_of(cls):
        column: Any = list[hints[key]]
        keys[key] = (column, ...) if default is dataclasses.MISSING else (column | None, None)
    return create_model(cls.__name__, __base__=_Columns, **keys)


_Name = Annotated[str, Field(pattern=f"^{NAME.pattern}$")]
_PROBABILITIES = ("loss", "burst_enter", "burst_leave", "burst_loss", "duplicate", "corrupt")
_TIMES = ("delay_s", "jitter_s")
_FaultsTable: Any = _table_like(
    LinkFaults,
    **{key: (float, Field(getattr(LinkFaults(), key), ge=0, le=1)) for key in _PROBABILITIES},
    **{key: (float, Field(0.0, ge=0, le=LONGEST_S)) for key in _TIMES},
    lie_scale=(float, Field(1.0, gt=0)),
)


@functools.cache
def _file_like(all_like: Any) -> Any:
    """The schema of a whole file; ``all_like``: of the many buses, branches, generators and meters."""
    network = create_model(
        "_NetworkTable",
        __base__=_Strict,
        base_mva=(float, ...),
        bus=(all_like(Bus), ...),
        branch=(all_like(Branch), ...),
        generator=(all_like(Generator), []),
    )
    return create_model(
        "_FileTable",
        __base__=_Strict,
        format=(Literal[1], ...),
        run=(_Name, ...),
        area=(_Name, ...),
        strategy=(str, ...),
        endpoints=(list[str], ...),
        listen=(list[str], []),
        beat_s=(float, Field(0.2, gt=0, le=LONGEST_S)),
        scan_s=(Annotated[float, Field(ge=SHORTEST_SCAN_S, le=LONGEST_S)] | None, None),
        tolerance=(float, Field(1e-6, gt=0)),
        seed=(int, 0),
        local_slack=(_Slack, ...),
        reference=(_Reference | None, None),
        exchange=(_Exchange, ...),
        load_messages=(_LoadMessages, _LoadMessages()),
        admm=(_Admm, _Admm()),
        quality=(_Quality, _Quality()),
        neighbour=(_rows_like(Neighbour, area=(_Name, ...), faults=(_FaultsTable, _FaultsTable())), []),
        network=(network, ...),
        meter=(all_like(Meter), ...),
    )


_file_like(_columns_like)  # once, before agents are forked
