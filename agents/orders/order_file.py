"""File of the operator's commands that an area has followed. It outlives the process, and is written whole or not."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import Field

from agents.messages.checks import LARGEST_COUNT, LONGEST_NAME
from agents.messages.packing import NO_INCARNATION, Incarnation
from dsse_core.errors import InvalidInputError
from dsse_core.files.drafts import whole_file
from dsse_core.files.kinds import OPERATOR_FILE, FileKind
from dsse_core.files.strict_table import FileTable, load_strict
from dsse_core.grid.switches import Status, name_statuses, read_statuses

Count = Annotated[int, Field(ge=0, lt=LARGEST_COUNT)]
MeterId = Annotated[str, Field(max_length=LONGEST_NAME)]


@dataclass(frozen=True, slots=True)
class Followed:
    """``incarnation``, ``sequence``: of the last command that was followed; ``meters_off``: off after all commands;
    ``switches``: switch that a command has set -> True where closed.
    """

    incarnation: Incarnation = NO_INCARNATION
    sequence: int = 0
    meters_off: tuple[str, ...] = ()
    switches: Mapping[str, bool] = field(default_factory=dict)

    @property
    def order(self) -> tuple[Incarnation, int]:
        """Order of the last command, as of a message: a newer command has a higher one."""
        return self.incarnation, self.sequence


class OperatorTable(FileTable):
    """A whole operator file."""

    kind: ClassVar[FileKind] = OPERATOR_FILE

    followed: Annotated[list[Count], Field(min_length=3, max_length=3)] = Field(
        description="start in ms, random number and sequence number of the last command that was followed"
    )
    meters_off: list[MeterId] = Field(description="ids of the meters that are switched off")
    switches: dict[MeterId, Status] = Field(default_factory=dict, description="switch and its status, open or closed")


class OrderFile:
    """The file at ``path``; where there is none, no command has been followed."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def of(cls, area_file: Path, run: str, area: str) -> OrderFile:
        """The file of ``area`` in ``run``: in the state directory given by systemd, else beside ``area_file``."""
        folder = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
        return cls((Path(folder) if folder else area_file.parent) / f"{run}.{area}.operator.json")

    def load(self) -> Followed:
        """The commands that were saved last; without a file, none.

        Raises:
            InvalidInputError: the file cannot be read, or is no file as ``save`` writes it.
        """
        try:
            if not self.path.exists():
                return Followed()
        except OSError as error:  # of a folder without access, or a name that is too long
            raise InvalidInputError(OPERATOR_FILE.called(self.path), [f"cannot be read: {error.strerror}"]) from None
        try:
            table = load_strict(self.path, OperatorTable)
        except InvalidInputError as error:
            cure = (
                "remove it: then no meter is off, switches are as in the area file, and commands of the last minute "
                "may be followed a second time"
            )
            raise InvalidInputError(OPERATOR_FILE.called(self.path), [*error.problems, cure]) from None
        start_ms, random, sequence = table.followed
        return Followed(Incarnation(start_ms, random), sequence, tuple(table.meters_off), read_statuses(table.switches))

    def save(self, followed: Followed) -> None:
        """Write ``followed`` through to the disk.

        Raises:
            OSError: naming the file, which then stays as before.
        """
        start = followed.incarnation
        table = {
            "followed": [start.start_ms, start.random, followed.sequence],
            "meters_off": list(followed.meters_off),
            "switches": name_statuses(followed.switches),
        }
        with whole_file(self.path) as draft, draft.open("w", encoding="utf-8") as file:
            json.dump(table, file)
            file.flush()
            os.fsync(file.fileno())
