"""The kinds of files with tables: the name of each, its use, and the keys that distinguish it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class FileKind:
    """A kind of file.

    ``reported_by``: keys at the top; no file of another kind has all of them. ``use``: the use of such a file, as the
    words after "which"; ``{name}`` in it stands for the name of the file. ``written_by``: the command that writes it,
    empty where none does.
    """

    article: str
    name: str
    reported_by: frozenset[str]
    use: str
    written_by: str = ""

    def called(self, path: Path) -> str:
        """The name of the file at ``path`` in errors."""
        return f"{self.name} {path}" + (f", which `{self.written_by}` writes" if self.written_by else "")


SCENARIO_FILE = FileKind("a", "scenario file", frozenset({"version", "areas"}), "`dsse run` takes")
NETWORK_FILE = FileKind(
    "a", "network file", frozenset({"bus", "branch"}), 'a scenario file names by network = "{name}"'
)
AREA_FILE = FileKind(
    "an",
    "area file",
    frozenset({"endpoints", "local_slack"}),
    "`dsse agent` takes",
    "dsse split SCENARIO --out DIR",
)
ACCESS_FILE = FileKind(
    "an", "access file", frozenset({"revoked", "neighbours"}), "lies beside certificates", "dsse keys create SCENARIO"
)
GATEWAY_MAP = FileKind("a", "gateway map", frozenset({"scenario", "name"}), "`dsse gateway` takes")
OPERATOR_FILE = FileKind(
    "an", "operator file", frozenset({"followed", "meters_off"}), "`dsse agent` keeps of the operator's commands"
)
FILE_KINDS = (SCENARIO_FILE, NETWORK_FILE, AREA_FILE, ACCESS_FILE, GATEWAY_MAP, OPERATOR_FILE)


def kind_reported_by(keys: Collection[str]) -> FileKind | None:
    """The first kind of file all of whose ``reported_by`` are among ``keys``; None where there is no such kind."""
    return next((kind for kind in FILE_KINDS if kind.reported_by <= set(keys)), None)
