"""A grid by name or path, for commands that need neither areas nor meters: from a scenario or a network file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from dsse_core.files.kinds import NETWORK_FILE
from dsse_core.files.strict_table import OtherKindError
from dsse_core.grid.network import Network
from scenarios.files.network_file import load_network
from scenarios.scenario import Scenario, load_scenario


def load_grid(
    name_or_path: str | Path, *, changes: Mapping[str, object] | None = None, whole: bool = False
) -> Scenario | Network:
    """A shipped scenario by its name, a scenario file or a network file by its path.

    ``changes``, ``whole``: see ``load_scenario``; a network file has no keys of scenarios to change.

    Raises:
        InvalidInputError: as ``load_scenario``, or every problem of the network file.
    """
    try:
        return load_scenario(name_or_path, changes=changes, whole=whole)
    except OtherKindError as error:
        if error.found is not NETWORK_FILE or changes:
            raise
        return load_network(Path(name_or_path))
