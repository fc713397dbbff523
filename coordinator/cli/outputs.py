"""Output of ``dsse estimate`` and ``dsse powerflow``: text, JSON or CSV on standard output, and files."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from coordinator.cli.terminal import json_option, notify, show
from coordinator.watch.run_folder import result_folder

if TYPE_CHECKING:  # the real imports stand in the commands, so that each starts fast
    from coordinator.watch.tables import Tables

TABLES = ("buses", "branches", "meters", "areas")
CHOICES = (*TABLES, "scans")
parquet_option = click.option("--parquet", is_flag=True, help="Write the tables as Parquet, too (pyarrow).")


@dataclass(frozen=True)
class Output:
    """Form of the output: ``folder``, if files are wanted, and on standard output text, JSON or one table as CSV."""

    folder: Path | None
    as_json: bool
    csv: str | None
    parquet: bool

    def check_table(self, names: Sequence[str], where: str) -> None:
        """Check, before the computation, that the table of ``--csv`` is one of ``names``.

        ``where``: owner of these tables, for the error, such as ``of one scan``.

        Raises:
            click.UsageError: it is none of them."""
        if self.csv is not None and self.csv not in names:
            raise click.UsageError(f"--csv {self.csv}: {where} there are the tables {', '.join(names)}; choose one")

    @property
    def is_text(self) -> bool:
        """True where only text is wanted."""
        return self.folder is None and not self.as_json and self.csv is None


def output_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """``--out``, ``--json``, ``--csv``, ``--parquet``; the command gets them as ``output``, its folder made."""

    @click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Write files here, new or empty.")
    @json_option
    @click.option("--csv", type=click.Choice(CHOICES), metavar="TABLE", help=f"Print one as CSV: {', '.join(CHOICES)}.")
    @parquet_option
    @functools.wraps(command)
    def with_output(*, out: Path | None, as_json: bool, csv: str | None, parquet: bool, **others: object) -> Any:
        if as_json and csv:
            raise click.UsageError("--json and --csv both print on standard output; give one of them")
        if parquet and out is None:
            raise click.UsageError("--parquet writes files; say where with --out DIR")
        check_parquet_option(parquet)
        with nullcontext() if out is None else result_folder(out) as folder:
            return command(output=Output(folder, as_json, csv, parquet), **others)

    return with_output


def check_parquet_option(parquet: bool) -> None:
    """Check, before the computation, that ``--parquet`` can be done.

    Raises:
        InvalidInputError: pyarrow is not installed."""
    if parquet:
        from coordinator.watch.tables import check_parquet

        check_parquet()


def hand_over(
    output: Output,
    tables: Tables,
    content: Callable[[], dict[str, Any]],
    text: Callable[[], str],
    notes: Sequence[str] = (),
) -> None:
    """Write the files that are asked for, ``content`` as result.json, and print.

    ``text``: printed unless JSON or CSV is asked for. ``notes``: the remarks in ``text`` on how far the result can be
    trusted; with JSON and CSV, which programs read, they go to standard error.
    """
    if output.folder is not None:
        write_files(output.folder, output.parquet, tables, content())
    if output.as_json:
        from coordinator.watch.tables import tables_as_json

        show(json.dumps(content() | tables_as_json(tables), allow_nan=False))
    elif output.csv:
        show(getattr(tables, output.csv).to_csv().removesuffix("\n"))
    else:
        show(text())
    machine_reads = output.as_json or output.csv is not None
    for note in notes if machine_reads else ():
        notify(f"note: {note}")
    if output.folder is not None:
        (notify if machine_reads else show)(f"files: {output.folder}")


def write_files(folder: Path, parquet: bool, tables: Tables, content: dict[str, Any]) -> None:
    """Write ``content`` as result.json, and the tables, with ``parquet`` also as Parquet."""
    from coordinator.watch.tables import write_json, write_parquet, write_tables

    _ = tables.buses  # made before anything is written: of many scans they may be too large
    write_json(folder / "result.json", content)
    write_tables(folder, tables)
    if parquet:
        write_parquet(folder, tables)
