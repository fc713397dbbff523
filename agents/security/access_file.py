"""The access file: who is whose neighbour, as TOML, beside the keys of everybody; `dsse keys create` writes it."""

from __future__ import annotations

from pathlib import Path

import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from agents.area_files.reader import describe_schema_error
from agents.messages.keys import NAME
from agents.security.access import COORDINATOR, PLANT, ROUTER, Access
from agents.security.credential_files import find_mode_problems, write_public
from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_file import LARGEST_TOML, read_text
from dsse_core.files.bounded_parsing import parse_toml
from dsse_core.limits import LONGEST_NAME

ACCESS_FILE = "access.toml"
HEAD = """\
# Who may speak with whom: nobody lets through anything else.
# Names in "revoked" are denied everything; after a change, send SIGHUP to every process.
"""


def save_access(path: Path, access: Access) -> None:
    """Write ``access`` as TOML."""
    table = {
        "run": access.run,
        "revoked": list(access.revoked),
        "neighbours": {area: list(names) for area, names in access.neighbours.items()},
    }
    write_public(path, (HEAD + tomli_w.dumps(table)).encode())


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
        if area in (ROUTER, PLANT, COORDINATOR):
            problems.append(f"neighbours: no area can be called {area!r}, as another process is")
        for n in neighbours:
            if area not in table.neighbours.get(n, ()):
                problems.append(f"neighbours.{area}: {n!r} does not name {area!r} as its neighbour; add it there")
    access = Access(
        table.run, {area: tuple(names) for area, names in table.neighbours.items()}, tuple(dict.fromkeys(table.revoked))
    )
    problems += [problem for name in access.revoked if (problem := _find_problem_of_revoked(access, name))]
    problems += find_mode_problems(path)
    if problems:
        raise InvalidInputError(what, problems)
    return access


def _find_problem_of_revoked(access: Access, name: str) -> str:
    if name == ROUTER:
        return f"revoked: {name!r} would end all exchange; replace the keys of all by those of a new authority"
    return "" if name in access.names else f"revoked: {name!r} is no name of a certificate: {', '.join(access.names)}"


class _FileTable(BaseModel):
    model_config = ConfigDict(extra="forbid")
    run: str = Field(pattern=f"^{NAME.pattern}$")
    revoked: list[str] = []
    neighbours: dict[str, list[str]] = Field(min_length=1)
