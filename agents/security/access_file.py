"""The access file: the neighbours and gateways of all areas, as TOML beside all keys; `dsse keys create` writes it."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import tomli_w
from pydantic import Field

from agents.security.access import ROUTER, Access, find_name_problems
from agents.security.credential_files import find_mode_problems, write_public
from dsse_core.errors import InvalidInputError
from dsse_core.files.kinds import ACCESS_FILE as KIND
from dsse_core.files.kinds import FileKind
from dsse_core.files.quantities import Name
from dsse_core.files.strict_table import FileTable, load_strict

ACCESS_FILE = "access.toml"
HEAD = """\
# Processes that may exchange messages with each other; no process lets through anything else.
# "gateways": to which areas each gateway may send readings.
# Names in "revoked" are denied everything; after a change, send SIGHUP to every process.
"""


def save_access(path: Path, access: Access) -> None:
    """Write ``access`` as TOML."""
    table = {
        "run": access.run,
        "revoked": list(access.revoked),
        "neighbours": {area: list(names) for area, names in access.neighbours.items()},
        "gateways": {gateway: list(areas) for gateway, areas in access.gateways.items()},
    }
    write_public(path, (HEAD + tomli_w.dumps(table)).encode())


def load_access(path: Path) -> Access:
    """Read and check an access file, as ``save_access`` writes it.

    Raises:
        InvalidInputError: naming the file and every unknown, missing or impossible key, and a file that other users
            may change.
    """
    table = load_strict(path, AccessTable)
    problems = []
    for area, neighbours in table.neighbours.items():
        for n in neighbours:
            if n == area:
                problems.append(f"neighbours.{area}: names {area!r} itself; remove it there")
            elif area not in table.neighbours.get(n, ()):
                problems.append(f"neighbours.{area}: {n!r} does not name {area!r} as its neighbour; add it there")
    access = Access(
        table.run,
        {area: tuple(names) for area, names in table.neighbours.items()},
        tuple(dict.fromkeys(table.revoked)),
        {gateway: tuple(dict.fromkeys(areas)) for gateway, areas in table.gateways.items()},
    )
    problems += find_name_problems(access)
    problems += [problem for name in access.revoked if (problem := _find_problem_of_revoked(access, name))]
    problems += find_mode_problems(path)
    if problems:
        raise InvalidInputError(table.called(path), problems)
    return access


def _find_problem_of_revoked(access: Access, name: str) -> str:
    if name == ROUTER:
        return f"revoked: {name!r} would end all exchange; replace the keys of all by those of a new authority"
    return "" if name in access.names else f"revoked: {name!r} is no name of a certificate: {', '.join(access.names)}"


class AccessTable(FileTable):
    """A whole access file."""

    kind: ClassVar[FileKind] = KIND

    run: Name = Field(description="name of the system of these keys")
    revoked: list[str] = Field(default_factory=list)
    """Names of stolen or retired keys."""
    neighbours: dict[Name, list[str]] = Field(min_length=1, description="area -> the areas that it meets")
    """Each area, and its neighbours."""
    gateways: dict[Name, list[str]] = Field(default_factory=dict)
    """Each gateway, and the areas to which it may send readings."""
