"""Measured figures stand in sections that a named command writes, with date and processor, and nowhere else."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path

import pytest

from benchmarks.measuring.figures import FIGURES, list_facts, read_sections, write_section
from benchmarks.recovery import make_table, summarise
from tests.support.pages import ROOT, name_of

MACHINE = {"date": "2030-01-02 03:04 UTC", "processor": "CPU, 2 cores", "memory": "8 GiB", "Python": "3.11.0"}
SECTIONS = dict(read_sections())


def test_every_table_of_figures_is_in_a_section():
    outside = FIGURES.read_text()
    for body in SECTIONS.values():
        outside = outside.replace(body, "")
    assert len(SECTIONS) > 8
    assert [line for line in outside.splitlines() if line.startswith("|")] == []


@pytest.mark.parametrize("name", SECTIONS)
def test_a_section_begins_with_date_processor_and_a_command_that_exists(name: str):
    head, _, table = SECTIONS[name].strip().partition("\n\n")
    assert re.match(r"20\d\d-\d\d-\d\d, .*\bcores, .*Python 3\.", head)
    command = re.search(r"`python -m (benchmarks[.\w]*)", head)
    assert command is not None
    assert find_spec(command[1]) is not None
    assert any(line.startswith("|") for line in table.splitlines())


def test_a_section_is_replaced_and_nothing_else(tmp_path: Path):
    page = tmp_path / "figures.md"
    page.write_text("a\n<!-- figures one -->\nformer\n<!-- end -->\nb\n<!-- figures two -->\nkept\n<!-- end -->\n")
    write_section("one", MACHINE, "| x |\n|---|\n| 1 |\n", page)
    found = dict(read_sections(page))
    assert "2030-01-02, CPU, 2 cores, Python 3.11.0:" in found["one"]
    assert "| 1 |" in found["one"]
    assert "former" not in found["one"]
    assert found["two"] == "kept\n"
    assert page.read_text().startswith("a\n<!-- figures one -->")
    with pytest.raises(KeyError):
        write_section("three", MACHINE, "", page)


def test_facts_and_times_of_recovery_are_tables():
    facts = {"gap": 1.23456e-9, "faults": {"lost": 2, "late": 1.5}, "alive of": [14, 14], "ended": []}
    rows = ["| gap | 1.23e-09 |", "| faults | lost 2, late 1.5 |", "| alive of | 14, 14 |", "| ended | none |"]
    assert list_facts(facts).splitlines()[2:] == rows
    assert make_table(summarise({"killed": [0.25, 0.5]})).splitlines()[2:] == ["| killed | 2 | 375 | 500 |"]


@pytest.mark.parametrize("page", sorted((ROOT / "docs" / "explanation").glob("*.md")), ids=name_of)
def test_explanations_hold_no_table_of_measured_figures(page: Path):
    measured = re.compile(r"^\|.*\b\d\.\d+e[-+]\d+")
    assert [line for line in page.read_text().splitlines() if measured.match(line)] == []
