"""Empty tables of pandapower made once: it makes a hundred for each network, in half a second of a processor."""

from __future__ import annotations

import copy
import importlib
from collections.abc import Callable
from functools import cache, wraps
from importlib.util import find_spec
from typing import Any

import pytest

ONE_WORKER = pytest.mark.xdist_group("pandapower")  # which alone loads it, in five seconds of a processor


class LoadedLate:
    """Module of pandapower that is loaded by its first use, so not where its tests are collected only."""

    def __init__(self, name: str) -> None:
        if find_spec("pandapower") is None:
            pytest.skip("could not import 'pandapower'", allow_module_level=True)
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        if attribute.startswith(("_", "pytest")):  # for which pytest asks all that stands in a module
            raise AttributeError(attribute)
        make_tables_once()
        return getattr(importlib.import_module(self._name), attribute)


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


def made_once(make: Callable[[], Any]) -> Callable[[], Any]:
    """``make``, which returns copies of one network of its: a copy takes 15 ms of a processor, and a network 600."""
    keep = cache(make)
    return wraps(make)(lambda: copy.deepcopy(keep()))
