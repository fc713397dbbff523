"""The tables of states that the thesis prints, with its misprints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files

from dsse_core.files.bounded_parsing import parse_json

CASES = ("industrial13", "ieee33")


@dataclass(frozen=True, slots=True)
class Misprint:
    """A printed number that must be wrong, in ``column`` (vm_pu or va_deg) of printed ``bus``.

    ``meant``: the intended number; None if not known.
    """

    table: str
    bus: int
    column: str
    printed: float
    meant: float | None
    why: str


@dataclass(frozen=True, slots=True)
class PrintedTable:
    """A printed table of states: ``buses`` as printed, ``vm_pu``, ``va_deg``, and its ``misprints``."""

    number: str
    case: str
    title: str
    buses: Sequence[int]
    vm_pu: Sequence[float]
    va_deg: Sequence[float]
    misprints: Sequence[Misprint]


@dataclass(frozen=True, slots=True)
class PrintedCase:
    """The printed tables of a case, by number.

    ``local_order``: area -> its buses in the order in which the thesis numbers them from 1.
    """

    tables: Mapping[str, PrintedTable]
    local_order: Mapping[str, Sequence[int]]


def load_case(case: str) -> PrintedCase:
    """The tables of ``case``, one of CASES, by their number."""
    path = files("coordinator.lab.thesis") / "tables" / f"{case}.json"
    content = parse_json(path.read_text(encoding="utf-8"))
    misprints = [Misprint(**entry) for entry in content["misprints"]]
    tables = {}
    for number, table in content["tables"].items():
        buses, vm, va_deg = list(zip(*table["rows"], strict=True))[:3]
        of_table = [m for m in misprints if m.table == number]
        tables[number] = PrintedTable(number, case, table["title"].strip(" ."), buses, vm, va_deg, of_table)
    return PrintedCase(tables, content["local_order"])
