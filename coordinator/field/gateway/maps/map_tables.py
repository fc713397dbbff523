"""The tables of a gateway's map file as they are written."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from agents.messages.keys import NAME
from dsse_core.files.kinds import GATEWAY_MAP, FileKind
from dsse_core.files.strict_table import FileTable, Table

Positive = Annotated[float, Field(gt=0)]
Interval = Annotated[float, Field(ge=0.001, le=10.0)]
Percent = Annotated[float, Field(gt=0, le=100)]
Unit = Literal["pu", "kV", "V", "MW", "kW", "W", "Mvar", "kvar", "var", "kA", "A", "deg", "rad", "status"]


class ReadingTable(Table):
    """One ``[[reading]]``: the meter reads ``sign (factor raw + offset)`` in ``unit``."""

    address: Annotated[str, Field(min_length=1, max_length=1000)] = Field(description="where the source has it")
    meter: str = Field(description="id of the meter, e.g. p_flow@3:3-4, or status@18-33 of a switch")
    unit: Unit
    sign: Literal[1, -1] = 1
    factor: float = 1.0
    offset: float = 0.0
    sigma: Positive | None = Field(default=None, description="standard deviation, in the unit")
    sigma_percent: Percent | None = Field(default=None, description="of the reading, at least sigma")
    lowest: float | None = Field(default=None, description="in the unit; below, a reading is out of range")
    highest: float | None = Field(default=None, description="in the unit; above, a reading is out of range")

    def find_problems(self, wrong: frozenset[str]) -> Iterator[str]:
        """Problems of values and of their combinations; the values of ``wrong`` keys are not known."""
        if self.factor == 0.0:
            yield "factor is 0; every reading would be the offset"
        if self.sigma_percent is not None and self.sigma is None and "sigma" not in wrong:
            yield "sigma_percent needs sigma as well, the least standard deviation: a reading may be 0"
        if self.lowest is not None and self.highest is not None and self.lowest >= self.highest:
            yield f"lowest is {self.lowest:g} and highest {self.highest:g}; lowest must be smaller"


class MapFile(FileTable):
    """The content of a map file.

    The classes of ``source`` and ``results`` check these tables, and each ``reading`` is checked by itself. So a
    problem of one part does not hide those of another.
    """

    kind: ClassVar[FileKind] = GATEWAY_MAP

    name: str = Field(description="of the gateway, a part of its keys, e.g. substation-north")
    scenario: str = Field(description="a shipped name, or the path of a scenario file from the folder of this file")
    run: str | None = None
    connect: list[str] = Field(default_factory=list)
    least_interval_s: Interval = 0.05
    source: dict[str, Any] | None = None
    reading: list[dict[str, Any]] = Field(default_factory=list)
    results: list[dict[str, Any]] = Field(default_factory=list)

    def find_problems(self, wrong: frozenset[str]) -> Iterator[str]:
        """Problems of values and of their combinations; the values of ``wrong`` keys are not known."""
        if "name" not in wrong and not NAME.fullmatch(self.name):
            yield f"name {self.name!r:.80}: a name is of a-z, 0-9, _ and -, 64 at most; choose another"
        if not wrong & {"source", "reading"} and (self.source is None) != (not self.reading):
            yield "[source] and [[reading]] belong together; give both, or neither"
        elif not wrong & {"source", "reading", "results"} and self.source is None and not self.results:
            yield "there is neither a [source] nor [[results]]; give one of them"
