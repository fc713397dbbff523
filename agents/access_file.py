"""The access file: who is whose neighbour, as TOML. A router reads it beside its keys; `dsse keys create` writes it."""

from __future__ import annotations

from pathlib import Path

import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from agents.access import Access
from agents.area_reader import describe_schema_error
from agents.keys import NAME
from dsse_core.bounded_file import LARGEST_TOML, read_text
from dsse_core.bounded_parsing import parse_toml
from dsse_core.errors import InvalidInputError
from dsse_core.limits import LONGEST_NAME

ACCESS_FILE = "access.toml"


def save_access(path: Path, access: Access) -> None:
    """Write ``access`` as TOML."""
    table = {"run": access.run, "neighbours": {area: list(names) for area, names in access.neighbours.items()}}
    path.write_text("# Who may speak with whom: routers let through nothing else.\n" + tomli_w.dumps(table))


def load_access(path: Path) -> Access:
    """Read and check what ``save_access`` wrote.

    Raises:
        InvalidInputError: naming the file and every unknown, missing or impossible key.
    """
    what = f"access file {path}, which `dsse keys create SCENARIO` writes"
    try:
        table = _FileTable.model_validate(parse_toml(read_text(path, largest=LARGEST_TOML, what=what)))
    except ValidationError as error:
        raise InvalidInputError(what, [describe_schema_error(e) for e in error.errors()]) from None
    except ValueError as error:
        raise InvalidInputError(what, [f"is not TOML: {error}"]) from None
    problems = []
    for area, neighbours in table.neighbours.items():
        if not NAME.fullmatch(area):
            problems.append(f"neighbours: area {area!r} may only contain a-z, 0-9, _ and -, {LONGEST_NAME} at most")
        for n in neighbours:
            if area not in table.neighbours.get(n, ()):
                problems.append(f"neighbours.{area}: {n!r} does not name {area!r} as its neighbour; add it there")
    if problems:
        raise InvalidInputError(what, problems)
    return Access(table.run, {area: tuple(names) for area, names in table.neighbours.items()})


class _FileTable(BaseModel):
    model_config = ConfigDict(extra="forbid")
    run: str = Field(pattern=f"^{NAME.pattern}$")
    neighbours: dict[str, list[str]] = Field(min_length=1)
