"""Fetches the libraries of the page from npm, with their licences: ``python -m coordinator.show.web.vendor``."""

from __future__ import annotations

import hashlib
import subprocess
import sys
import tarfile
import tempfile
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).parent / "static" / "vendor"
README = "README.md"
MOST_BYTES = 1_000_000  # of one file


@dataclass(frozen=True)
class Library:
    """A library of the page. ``files``: path in the package -> name in ``FOLDER``."""

    name: str
    version: str
    licence: str
    files: dict[str, str]


LIBRARIES = (
    Library("d3", "7.9.2", "ISC", {"dist/d3.min.js": "d3.min.js", "LICENSE": "d3.LICENSE"}),
    Library(
        "uplot",
        "1.6.32",
        "MIT",
        {
            "dist/uPlot.iife.min.js": "uPlot.iife.min.js",
            "dist/uPlot.min.css": "uPlot.min.css",
            "LICENSE": "uPlot.LICENSE",
        },
    ),
)


def fetch(library: Library, folder: Path) -> None:
    """Puts the files of ``library`` into ``folder``. npm checks that the package is the published one.

    Raises:
        subprocess.CalledProcessError: npm cannot fetch it.
        KeyError: a file is not in the package.
    """
    with tempfile.TemporaryDirectory() as place:
        command = ["npm", "pack", "--silent", "--pack-destination", place, f"{library.name}@{library.version}"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        (archive,) = Path(place).glob("*.tgz")
        with tarfile.open(archive) as package:
            for source, target in library.files.items():
                content = package.extractfile(f"package/{source}")
                assert content is not None
                (folder / target).write_bytes(content.read(MOST_BYTES))


def describe(folder: Path) -> str:
    """README of the libraries in ``folder``: name, version, licence and the sha256 of each file."""
    lines = [
        "# Libraries of the page",
        "",
        "Unchanged files of npm packages, fetched by `make vendor`.",
        "",
        "| file | of | licence | sha256 |",
        "|---|---|---|---|",
    ]
    for library in LIBRARIES:
        for name in library.files.values():
            digest = hashlib.sha256((folder / name).read_bytes()).hexdigest()
            lines.append(f"| {name} | {library.name} {library.version} | {library.licence} | {digest} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    for library in LIBRARIES:
        fetch(library, FOLDER)
    (FOLDER / README).write_text(describe(FOLDER), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
