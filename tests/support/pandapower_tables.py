"""Empty tables of pandapower made once: it makes a hundred for each network, in half a second of a processor."""

from __future__ import annotations

from functools import cache
from typing import Any

import pytest


@cache
def make_tables_once() -> None:
    """Has pandapower, in this process, take copies of the empty tables that it has made for its first network."""
    net: Any = pytest.importorskip("pandapower.auxiliary").pandapowerNet
    make, made = net.create_dataframes, {}

    def copy_tables(data: dict[str, Any]) -> dict[str, Any]:
        columns = {key: tuple(given.items()) for key, given in data.items() if isinstance(given, dict)}
        missing = {key: data[key] for key, given in columns.items() if (key, given) not in made}
        made.update({(key, columns[key]): table for key, table in make(dict(missing)).items()})
        return data | {key: made[key, given].copy() for key, given in columns.items()}

    net.create_dataframes = staticmethod(copy_tables)
