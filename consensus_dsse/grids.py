"""Networks and scenarios by name or path."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dsse_core.grid.network import Network
    from scenarios.scenario import Scenario


def load_network(name_or_path: str | Path) -> Network:
    """A shipped network by its name, or a network file (.toml, .json) by its path.

    Powers, impedances and voltages of the network are in p.u. of ``base_mva`` and each bus's ``base_kv``.

    >>> import consensus_dsse as dsse
    >>> network = dsse.load_network("case33bw")
    >>> len(network.buses), network.base_mva
    (33, 10.0)

    Raises:
        InvalidInputError: no shipped network has this name, or every problem of the file.
    """
    from scenarios.files.network_file import load_case
    from scenarios.files.network_file import load_network as load_file

    text = str(name_or_path)
    is_path = isinstance(name_or_path, Path) or text.endswith((".toml", ".json")) or "/" in text
    return load_file(Path(name_or_path)) if is_path else load_case(text)


def load_scenario(name_or_path: str | Path, *, changes: Mapping[str, object] | None = None) -> Scenario:
    """A shipped scenario by its name, or a scenario file by its path.

    Args:
        changes: values that replace the file's, by key path such as ``faults.loss`` or ``faults.link[1].loss``, in the
            units of the file.

    >>> import consensus_dsse as dsse
    >>> dsse.load_scenario("ieee33", changes={"faults.loss": 0.3, "areas": {"count": 4}})
    <Scenario 'ieee33': network 'ieee33', 33 buses in 4 areas, 134 meters, strategy 'information', seed 1>

    Raises:
        InvalidInputError: no shipped scenario has this name, or every problem of the file and of ``changes``.
    """
    from agents.strategies.installed import list_strategies
    from scenarios.scenario import load_scenario as load

    return load(name_or_path, strategies=list_strategies(), changes=changes)
