"""What the package says of itself is the same everywhere."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from coordinator.cli.main import run_command

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_command_prints_its_version(capsys: pytest.CaptureFixture[str]):
    assert run_command(["--version"]) == 0
    assert capsys.readouterr().out == f"{PROJECT['name']} {PROJECT['version']}\n"


def test_who_cites_it_cites_this_version():
    cited = dict(re.findall(r"^(\S+): (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE))
    reported = (cited["title"], cited["version"], cited["license"])
    assert reported == (PROJECT["name"], PROJECT["version"], PROJECT["license"])


def test_the_changelog_begins_with_this_version_in_the_form_of_keepachangelog():
    headings = re.findall(r"^(##+ .+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    released = [heading for heading in headings if heading.startswith("## ") and heading != "## [Unreleased]"]
    assert re.fullmatch(rf"## \[{re.escape(PROJECT['version'])}\] - \d{{4}}-\d\d-\d\d", released[0])
    kinds = {heading.removeprefix("### ") for heading in headings if heading.startswith("### ")}
    assert kinds <= {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}


def test_no_dependency_is_without_a_lowest_version_that_can_be_tried():
    needed = [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["test"]]
    assert [line for line in needed if not re.search(r">=\d", line)] == []


def test_an_extra_asks_for_no_lower_version_than_the_tests_try():
    lowest = dict(line.split(">=") for line in PROJECT["optional-dependencies"]["test"])
    for extra in ("fast", "bench", "metrics", "pandapower", "parquet", "power-grid-model"):
        for line in PROJECT["optional-dependencies"][extra]:
            name, version = line.split(">=")
            assert lowest.get(name, version) == version
