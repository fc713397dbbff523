"""The thesis that this project began with, reproduced."""

from __future__ import annotations

from dsse_core.results.table import Table


def thesis() -> Table:
    """The tables of the thesis beside ours, as ``dsse thesis`` prints them: one row per printed row.

    Columns: ``table`` and ``printed_bus`` as in the thesis, ``bus`` of the grid, ``printed_vm_pu``, ``vm_pu``,
    ``difference_vm_pu``, the same of ``va_deg``, ``misprint`` (a text, empty where there is none),
    ``ours``: what it is.

    >>> import consensus_dsse as dsse
    >>> table = dsse.thesis()
    >>> len(table), len(set(table.table))
    (291, 22)
    >>> sound = [text == "" for text in table.misprint]
    >>> bool(abs(table.difference_va_deg[sound]).max() < 0.15)
    True
    """
    from coordinator.lab.thesis.comparison import as_one_table, compare_tables

    return as_one_table(compare_tables())
