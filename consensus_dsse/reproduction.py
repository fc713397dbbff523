"""The thesis that this project began with, reproduced."""

from __future__ import annotations

from dsse_core.results.table import Table


def thesis() -> Table:
    """The tables of the thesis beside ours, as ``dsse thesis`` prints them: one row per printed row.

    Columns: ``table`` and ``printed_bus`` as in the thesis, ``bus`` of the grid, ``printed_vm_pu``, ``vm_pu``,
    ``difference_vm_pu``, the same of ``va_deg`` and, of power flows, of ``load_mw``, ``load_mvar``, ``gen_mw`` and
    ``gen_mvar``; ``misprint`` (a text, empty where there is none), ``ours``: what it is. ``against``: the table to
    which ``printed_effect_vm_pu``, ``effect_vm_pu`` and those of ``va_deg`` are differences.

    >>> import consensus_dsse as dsse
    >>> table = dsse.thesis()
    >>> len(table), len(set(table.table))
    (291, 22)
    >>> sound = [text == "" for text in table.misprint]
    >>> bool(abs(table.difference_va_deg[sound]).max() < 0.05)
    True
    """
    from coordinator.lab.thesis.comparison import as_one_table, compare_tables

    return as_one_table(compare_tables())
