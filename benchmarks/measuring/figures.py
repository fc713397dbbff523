"""Sections of docs/reference/figures.md, each written by a command, with date and machine, and never by hand."""

from __future__ import annotations

import json
import re
import shlex
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import click

FIGURES = Path(__file__).parents[2] / "docs" / "reference" / "figures.md"
_LEFT_OUT = {"load before", "system", "consensus-dsse", "memory"}  # of the machine: figures do not depend on them
_SECTION = re.compile(r"<!-- figures (?P<name>\S+) -->\n(?P<body>.*?)<!-- end -->", re.DOTALL)


def figures_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """The option ``--figures SECTION`` of a command, checked before anything is measured."""
    return click.option(
        "--figures",
        metavar="SECTION",
        callback=_check_section,
        help=f"Write the table into this section of {FIGURES.relative_to(FIGURES.parents[2])}, too.",
    )(function)


def read_sections(page: Path = FIGURES) -> Iterator[tuple[str, str]]:
    """Name and text of each section of the page."""
    for found in _SECTION.finditer(page.read_text(encoding="utf-8")):
        yield found["name"], found["body"]


def write_section(name: str, machine: Mapping[str, str], table: str, page: Path = FIGURES) -> None:
    """Replace section ``name``: the command, date and machine, then ``table``, Markdown.

    Raises:
        KeyError: the page has no such section.
    """
    if name not in dict(read_sections(page)):
        raise KeyError(name)
    body = f"\n{describe(machine, _command())}\n\n{table.strip()}\n\n"

    def replace(found: re.Match[str]) -> str:
        return f"<!-- figures {name} -->\n{body}<!-- end -->" if found["name"] == name else found[0]

    page.write_text(_SECTION.sub(replace, page.read_text(encoding="utf-8")), encoding="utf-8")


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


def describe(machine: Mapping[str, str], command: str) -> str:
    """The first lines of a section: date, processor and packages of ``describe_machine``, and the command."""
    packages = [f"{name} {text}" for name, text in machine.items() if name not in {"date", "processor", *_LEFT_OUT}]
    return f"{machine['date'][:10]}, {machine['processor']}, {', '.join(packages)}:\n`{command}`"


def _command() -> str:
    main = sys.modules["__main__"].__spec__
    module = (main.name if main else "benchmarks").removesuffix(".__main__")
    return shlex.join(["python", "-m", module, *sys.argv[1:]])


def _check_section(_context: click.Context, _option: click.Parameter, name: str | None) -> str | None:
    known = [section for section, _ in read_sections()] if name else []
    if name and name not in known:
        raise click.BadParameter(f"there is no section {name!r}; choose from {', '.join(known)}")
    return name
