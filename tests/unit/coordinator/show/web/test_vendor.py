"""The libraries of the page are those that are named, unchanged, with their licences, and go into the wheel."""

from __future__ import annotations

import re
import subprocess
import tomllib
from pathlib import Path

import pytest

from coordinator.show.web.vendor import FOLDER, LIBRARIES, README, Library, describe

ROOT = Path(__file__).parents[5]
STATIC = FOLDER.parent


def test_every_file_has_the_hash_that_is_written_down():
    assert (FOLDER / README).read_text() == describe(FOLDER)


def test_nothing_lies_there_that_is_not_named_and_each_library_has_its_licence():
    named = {name for library in LIBRARIES for name in library.files.values()}
    assert {path.name for path in FOLDER.iterdir()} == named | {README}
    for library in LIBRARIES:
        licences = [name for name in library.files.values() if name.endswith(".LICENSE")]
        assert len(licences) == 1
        assert "copyright" in (FOLDER / licences[0]).read_text().lower()


@pytest.mark.parametrize("library", LIBRARIES, ids=lambda library: library.name)
def test_the_files_say_the_same_version(library: Library):
    (script,) = (name for name in library.files.values() if name.endswith(".js"))
    assert library.version in (FOLDER / script).read_text()[:200]


def test_the_page_asks_for_no_file_that_is_not_there():
    asked = re.findall(r'(?:href|src)="/static/([^"]+)"', (STATIC / "index.html").read_text())
    imported = [
        f"{name}.js" for path in STATIC.glob("*.js") for name in re.findall(r'from "\./(\w+)\.js"', path.read_text())
    ]
    assert [name for name in (*asked, *imported) if not (STATIC / name).is_file()] == []


def test_the_files_of_the_page_are_in_the_packages_of_the_wheel():
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert "coordinator" in wheel["packages"]
    ignored = subprocess.run(["git", "check-ignore", *STATIC.rglob("*")], cwd=ROOT, capture_output=True, text=True)
    assert ignored.stdout == ""  # hatch leaves out what git ignores
