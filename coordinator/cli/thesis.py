"""``dsse thesis``: the tables of the thesis beside ours."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import click

from coordinator.cli.terminal import show
from coordinator.watch.interrupts import end_orderly_on_signals
from dsse_core.printable import printable

FILE = "thesis.csv"


@click.command(short_help="Print the tables of the thesis beside ours.")
@click.option("--table", "tables", multiple=True, metavar="NUMBER", help="Only this table, e.g. 5.9; repeatable.")
@click.option("--summary", is_flag=True, help="Print the last table only: one line per table of the thesis.")
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help=f"Write all rows to DIR/{FILE}.")
def thesis(tables: tuple[str, ...], summary: bool, out: Path | None) -> None:
    """Run the scenarios of the thesis and print its tables of states beside ours, with the differences.

    The runs are on the simulator. Misprints are marked and left out of the largest differences. What each table of ours
    is stands above it; `dsse run ieee33-thesis` makes the same estimate with real processes.

    \b
    Examples:  dsse thesis --summary
               dsse thesis --table 5.9 --table 5.12 --out thesis
    """
    from coordinator.lab.thesis.comparison import as_one_table, compare_tables, format_compared, format_summary
    from coordinator.watch.run_folder import result_folder
    from coordinator.watch.tables.table_files import write_csv
    from dsse_core.files.drafts import whole_file

    end_orderly_on_signals()
    with nullcontext() if out is None else result_folder(out) as folder:
        compared = compare_tables(tables)
        for table in () if summary else compared:
            show(format_compared(table) + "\n")
        show(format_summary(compared))
        if folder is not None:
            with whole_file(folder / FILE) as draft, draft.open("w", encoding="utf-8", newline="") as file:
                write_csv(file, as_one_table(compared))
            show(f"\nfiles: {printable(folder)}")
