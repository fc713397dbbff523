"""Networks and readings of other projects: MATPOWER, OpenDSS, pandapower, power-grid-model (docs/how-to/import.md)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_file import read_text
from dsse_core.files.bounded_parsing import parse_json
from dsse_core.grid.physical_ranges import find_range_problems
from dsse_core.printable import printable
from scenarios.importers.imported import Imported

__all__ = ["Imported", "import_grid"]


def import_grid(
    path: Path, *, name: str | None = None, frequency_hz: float = 50.0, within: Path | None = None
) -> Imported:
    """Read a file of another project, which its ending and content tell.

    ``name``: of the network, that of the file if None; it is made printable, since a file name may hold any character.
    ``frequency_hz`` is for power-grid-model alone, whose files do not hold it. ``within`` is for OpenDSS alone: the
    folder of all files that ``path`` may name, by default its own.

    Raises:
        InvalidInputError: unknown format, missing optional package, everything that the network model cannot hold, and
            every number that no grid has.
    """
    try:
        imported = _read(path, frequency_hz, within)
    except ArithmeticError as error:  # of numbers that stand for no grid, before there is a network to look at
        problem = f"it has numbers that cannot be computed with ({type(error).__name__}); look for zeros and huge ones"
        raise InvalidInputError(str(path), [problem]) from None
    if problems := list(find_range_problems(imported.network)):
        raise InvalidInputError(str(path), problems)
    network = replace(imported.network, name=printable(imported.network.name if name is None else name))
    return replace(imported, network=network, data_source=printable(imported.data_source))


def _read(path: Path, frequency_hz: float, within: Path | None) -> Imported:
    if path.suffix == ".m":
        from scenarios.importers.matpower.reader import read_matpower

        return read_matpower(path)
    if path.suffix.lower() == ".dss":
        from scenarios.importers.opendss.reader import read_opendss

        return read_opendss(path, within)
    if path.suffix != ".json":
        hint = "; a network in TOML needs no import, a scenario file names it" if path.suffix == ".toml" else ""
        raise InvalidInputError(str(path), [f"the ending {path.suffix!r} is not known; .m, .dss and .json are{hint}"])
    text = read_text(path)
    try:
        content = parse_json(text)
    except ValueError as error:
        raise InvalidInputError(str(path), [f"not JSON: {error}"]) from None
    if isinstance(content, dict) and content.get("_class") == "pandapowerNet":
        from scenarios.importers.pandapower.reader import read_pandapower

        return read_pandapower(path, content)
    if isinstance(content, dict) and "is_batch" in content and "data" in content:
        if content["is_batch"] or content.get("type") != "input":
            problem = (
                f"power-grid-model data of type {content.get('type')!r}, batch {content['is_batch']}; give input data"
            )
            raise InvalidInputError(str(path), [problem])
        from scenarios.importers.power_grid_model.reader import read_power_grid_model

        return read_power_grid_model(path, content, frequency_hz)
    raise InvalidInputError(
        str(path), ["neither a pandapower network (to_json) nor power-grid-model input (json_serialize_to_file)"]
    )
