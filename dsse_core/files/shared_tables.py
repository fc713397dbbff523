"""Tables that stand in scenario files and in area files alike."""

from __future__ import annotations

from typing import Literal, TypeVar

from dsse_core.files.strict_table import Table
from dsse_core.limits import Penalty

AnyTable = TypeVar("AnyTable", bound=Table)


class AdmmTable(Table):
    """``[admm]``."""

    penalty: Penalty = 1.0
    """Pull of an area towards its neighbours, in units of what the areas know of their boundary by themselves.
    It changes the duration of the exchange, not its end.
    """


class GenerationTable(Table):
    """``[load_messages]``: the generation that load messages state, metered or by the schedule."""

    generation: Literal["telemetered", "scheduled"] = "telemetered"
    """Production of substation and sources in load messages: telemetered, or `p_mw` and `q_mvar` of the network
    file.
    """


def require_a_band(table: AnyTable, lowest: str, highest: str) -> AnyTable:
    """``table``, whose key ``lowest`` is below its key ``highest``.

    Raises:
        ValueError: ``lowest`` is not below ``highest``.
    """
    low, high = getattr(table, lowest), getattr(table, highest)
    if low >= high:
        raise ValueError(f"{lowest} is {low}; it must be below {highest}, {high}")
    return table
