"""Figures that commands measure: complete tables below docs/figures/DATE, and the page docs/reference/figures.md.

The page has sections between ``<!-- figures NAME -->`` and ``<!-- end -->``. A marker may select what is shown:
``<!-- figures NAME; columns A | B; rows C | D -->`` shows two columns, and the rows that have a cell C and a cell D;
``rows first`` and ``rows last`` show one. The section ``lines`` has one line for each further name:
chosen facts, or ``in the file``.
"""

from __future__ import annotations

import csv
import json
import re
import shlex
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import click

FIGURES = Path(__file__).parents[2] / "docs" / "reference" / "figures.md"
LINES = "lines"  # section of names that have one line each
IN_THE_FILE = "in the file"  # facts of a line that shows none
_LEFT_OUT = {"load before", "system", "consensus-dsse", "memory"}  # of the machine: figures do not depend on them
_SECTION = re.compile(r"<!-- figures (?P<name>[\w-]+)(?P<shown>[^>]*) -->\n(?P<body>.*?)<!-- end -->", re.DOTALL)
_LINE = re.compile(r"^\| \[(?P<name>[\w-]+)\]\(\S+\) \| (?P<facts>.*?) \| .*\|$", re.MULTILINE)
_TABLE = re.compile(r"(?:^\|.*\n)+", re.MULTILINE)

Rows = list[list[str]]  # header first


def figures_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """The option ``--figures SECTION`` of a command, checked before anything is measured."""
    return click.option(
        "--figures",
        metavar="SECTION",
        callback=_check_section,
        help=f"Write the table below docs/figures and into this section of {FIGURES.relative_to(FIGURES.parents[2])}.",
    )(function)


def read_sections(page: Path = FIGURES) -> Iterator[tuple[str, str]]:
    """Name and text of each section of the page."""
    for found in _SECTION.finditer(page.read_text(encoding="utf-8")):
        yield found["name"], found["body"]


def list_names(page: Path = FIGURES) -> list[str]:
    """Names that ``write_section`` knows: sections, and lines of the section ``lines``."""
    sections = dict(read_sections(page))
    lines = _LINE.finditer(sections.pop(LINES, ""))
    return [*sections, *(line["name"] for line in lines)]


def write_section(name: str, machine: Mapping[str, str], table: str, page: Path = FIGURES) -> None:
    """Save the Markdown tables of ``table`` as CSV below docs/figures/DATE, and replace section or line ``name``.

    Raises:
        KeyError: the page has no such section and no such line.
    """
    if name not in list_names(page):
        raise KeyError(name)
    command = _command()
    tables = [_read_table(text) for text in _TABLE.findall(f"{table.strip()}\n")]
    folder = page.parents[1] / "figures" / machine["date"][:10]
    folder.mkdir(parents=True, exist_ok=True)
    for number, rows in enumerate(tables, start=1):
        _save(folder / _file_name(name, number), describe(machine), command, rows)
    link = f"../figures/{folder.name}/{_file_name(name, 1)}"

    def replace(found: re.Match[str]) -> str:
        if found["name"] == name:
            shown = _format_table(_select(tables[0], found["shown"]))
            further = "".join(f", [{n}]({link.removesuffix('.csv')}-{n}.csv)" for n in range(2, len(tables) + 1))
            head = f"{folder.name}, {machine['processor']} ([whole table]({link}){further}):\n`{command}`"
            body = f"\n{head}\n\n{shown}\n\n"
        elif found["name"] == LINES:
            body = _LINE.sub(replace_line, found["body"])
        else:
            return found[0]
        return f"<!-- figures {found['name']}{found['shown']} -->\n{body}<!-- end -->"

    def replace_line(found: re.Match[str]) -> str:
        if found["name"] != name:
            return found[0]
        facts = {row[0]: ", ".join(row[1:]) for row in tables[0][1:]}
        named = [fact.partition(" = ")[0] for fact in found["facts"].split("; ")]
        kept = [f"{what} = {facts[what]}" for what in named if what in facts]
        shown = "; ".join(kept or [f"{what} = {figure}" for what, figure in facts.items()])
        if found["facts"] == IN_THE_FILE:
            shown = IN_THE_FILE
        return f"| [{name}]({link}) | {shown} | {folder.name} | `{command}` |"

    page.write_text(_SECTION.sub(replace, page.read_text(encoding="utf-8")), encoding="utf-8")


def _file_name(name: str, number: int) -> str:
    return f"{name}.csv" if number == 1 else f"{name}-{number}.csv"


def _read_table(text: str) -> Rows:
    """Cells of a Markdown table, without the line below its header."""
    lines = [re.split(r"(?<!\\)\|", line.strip().strip("|")) for line in text.strip().splitlines()]
    return [[cell.strip() for cell in line] for number, line in enumerate(lines) if number != 1]


def _format_table(rows: Rows) -> str:
    header, *others = rows
    lines = ["| " + " | ".join(row) + " |" for row in (header, *others)]
    return "\n".join([lines[0], "|" + "---|" * len(header), *lines[1:]])


def _save(path: Path, machine: str, command: str, rows: Rows) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(f"# {machine}\n# {command}\n")
        csv.writer(file, lineterminator="\n").writerows([cell.replace(r"\|", "|") for cell in row] for row in rows)


def _select(rows: Rows, shown: str) -> Rows:
    """The columns and rows that a marker asks for; all where it names none of them."""
    wanted = {kind: names for kind, _, names in (part.strip().partition(" ") for part in shown.split(";") if part)}
    header, *others = rows
    columns = [name.strip() for name in wanted.get("columns", "").split("|")]
    picked = [header.index(name) for name in columns if name in header] or range(len(header))
    match wanted.get("rows", ""):
        case "first":
            others = others[:1]
        case "last":
            others = others[-1:]
        case names:
            cells = {name.strip() for name in names.split("|")} - {""}
            others = [row for row in others if cells <= set(row)] or others
    return [[row[place] for place in picked] for row in (header, *others)]


def list_facts(facts: Mapping[str, object]) -> str:
    """A Markdown table of two columns; mappings and lists become words."""
    rows = [f"| {what} | {_write(figure)} |" for what, figure in facts.items()]
    return "\n".join(["| what | figure |", "|---|---|", *rows])


def conclude(
    machine: Mapping[str, str],
    seen: Mapping[str, object],
    failures: Sequence[str],
    figures: str | None,
    left_out: Collection[str] = (),
) -> NoReturn:
    """Print the figures ``seen``, write section ``figures`` if given, and exit: 1 with ``failures``, else 0.

    ``left_out``: keys of ``seen`` that the section does without.
    """
    print(json.dumps({**machine, **seen}, indent=2))
    if figures:
        facts = {what: figure for what, figure in seen.items() if what not in left_out}
        write_section(figures, machine, list_facts(facts | {"failures": "; ".join(failures) or "none"}))
    for failure in failures:
        print(f"error: {failure}", file=sys.stderr)
    sys.exit(1 if failures else 0)


def _write(figure: object) -> str:
    if isinstance(figure, Mapping):
        return ", ".join(f"{name} {_write(value)}" for name, value in figure.items()) or "none"
    if isinstance(figure, list):
        return ", ".join(map(_write, figure)) or "none"
    return f"{figure:.3g}" if isinstance(figure, float) else str(figure)


def describe(machine: Mapping[str, str]) -> str:
    """Date, processor and packages of ``describe_machine``."""
    packages = [f"{name} {text}" for name, text in machine.items() if name not in {"date", "processor", *_LEFT_OUT}]
    return f"{machine['date'][:10]}, {machine['processor']}, {', '.join(packages)}"


def _command() -> str:
    main = sys.modules["__main__"].__spec__
    module = (main.name if main else "benchmarks").removesuffix(".__main__")
    return shlex.join(["python", "-m", module, *sys.argv[1:]])


def _check_section(_context: click.Context, _option: click.Parameter, name: str | None) -> str | None:
    known = list_names() if name else []
    if name and name not in known:
        raise click.BadParameter(f"there is no section {name!r}; choose from {', '.join(known)}")
    return name
