"""Measured figures stand in sections that a named command writes, with date and processor, and nowhere else."""

from __future__ import annotations

import csv
import re
from importlib.util import find_spec
from pathlib import Path

import pytest

from benchmarks.measuring.figures import FIGURES, IN_THE_FILE, LINES, list_facts, read_sections, write_section
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


def read_csv(link: str) -> tuple[str, str, list[list[str]]]:
    """Machine, command and rows of a complete table that the page links."""
    text = (FIGURES.parent / link).read_text(encoding="utf-8")
    machine, command, table = text.split("\n", 2)
    return machine.removeprefix("# "), command.removeprefix("# "), list(csv.reader(table.splitlines()))


def test_pages_link_every_complete_table_and_no_other():
    linked = {(FIGURES.parent / link).resolve() for link in re.findall(r"\]\((\S+\.csv)\)", FIGURES.read_text())}
    assert linked == set((ROOT / "docs" / "figures").glob("20??-??-??/*.csv"))


@pytest.mark.parametrize("name", [name for name in SECTIONS if name != LINES])
def test_a_section_begins_with_date_processor_and_a_command_that_exists(name: str):
    head, _, shown = SECTIONS[name].strip().partition("\n\n")
    command = re.search(r"`(python -m (benchmarks[.\w]*).*)`", head)
    link = re.search(r"\]\((\S+\.csv)\)", head)
    assert command is not None
    assert link is not None
    assert find_spec(command[2]) is not None
    machine, whole_command, rows = read_csv(link[1])
    assert whole_command == command[1]
    assert re.match(r"20\d\d-\d\d-\d\d, .*\bcores, Python 3\.", machine)
    assert machine.startswith(head.partition(" (")[0].partition(",")[0])
    cells = [set(row) for row in rows]
    for line in shown.splitlines()[2:]:
        assert any({cell.strip() for cell in line.strip("|").split("|")} <= row for row in cells), line


def test_a_line_has_the_facts_of_its_file():
    lines = re.findall(r"^\| \[([\w-]+)\]\((\S+)\) \| (.*?) \| (\S+) \| `(.*)` \|$", SECTIONS[LINES], re.MULTILINE)
    assert len(lines) > 8
    for name, link, facts, date, command in lines:
        machine, whole_command, rows = read_csv(link)
        assert (Path(link).stem, whole_command, machine[:10]) == (name, command, date)
        known = {f"{row[0]} = {', '.join(row[1:])}" for row in rows} | {IN_THE_FILE}
        assert set(facts.split("; ")) <= known


def test_the_page_dates_the_version_of_each_other_tool():
    text = " ".join(FIGURES.read_text().split())
    machine, _, _ = read_csv(re.findall(r"\((\S+/estimates\.csv)\)", text)[0])
    versions = re.findall(r"((?:power-grid-model|pandapower|gridstate) [\d.]+)", machine)
    assert len(versions) == 3
    assert [version for version in versions if not re.search(rf"{re.escape(version)} on 20\d\d-", text)] == []


def test_a_section_is_replaced_and_nothing_else(tmp_path: Path):
    page = tmp_path / "docs" / "reference" / "figures.md"
    page.parent.mkdir(parents=True)
    page.write_text(
        "a\n<!-- figures one; columns x | z; rows b -->\n<!-- end -->\nb\n<!-- figures two -->\nkept\n<!-- end -->\n"
        "<!-- figures lines -->\n| [three](old.csv) | gap = 2 | 2029-01-01 | `old` |\n<!-- end -->\n"
    )
    write_section("one", MACHINE, "| x | y | z |\n|---|---|---|\n| 1 | 2 | a |\n| 3 | 4 | b |\n", page)
    found = dict(read_sections(page))
    assert "2030-01-02, CPU, 2 cores ([whole table](../figures/2030-01-02/one.csv)):" in found["one"]
    assert found["one"].rstrip().endswith("| x | z |\n|---|---|\n| 3 | b |")
    assert found["two"] == "kept\n"
    assert page.read_text().startswith("a\n<!-- figures one; columns x | z; rows b -->")
    saved = (tmp_path / "docs" / "figures" / "2030-01-02" / "one.csv").read_text().splitlines()
    assert saved[0] == "# 2030-01-02, CPU, 2 cores, Python 3.11.0"
    assert saved[2:] == ["x,y,z", "1,2,a", "3,4,b"]
    write_section("three", MACHINE, list_facts({"lost": 0, "gap": 1.5}), page)
    assert "| [three](../figures/2030-01-02/three.csv) | gap = 1.5 | 2030-01-02 | `" in page.read_text()
    with pytest.raises(KeyError):
        write_section("four", MACHINE, "| x |\n|---|\n", page)


def test_facts_and_times_of_recovery_are_tables():
    facts = {"gap": 1.23456e-9, "faults": {"lost": 2, "late": 1.5}, "alive of": [14, 14], "ended": []}
    rows = ["| gap | 1.23e-09 |", "| faults | lost 2, late 1.5 |", "| alive of | 14, 14 |", "| ended | none |"]
    assert list_facts(facts).splitlines()[2:] == rows
    assert make_table(summarise({"killed": [0.25, 0.5]})).splitlines()[2:] == ["| killed | 2 | 375 | 500 |"]


@pytest.mark.parametrize("page", sorted((ROOT / "docs" / "explanation").glob("*.md")), ids=name_of)
def test_explanations_hold_no_table_of_measured_figures(page: Path):
    measured = re.compile(r"^\|.*\b\d\.\d+e[-+]\d+")
    assert [line for line in page.read_text().splitlines() if measured.match(line)] == []
