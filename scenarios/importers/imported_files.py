"""Files that ``dsse import`` writes: a network, a scenario on it, the readings if there are any, and a summary."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path

from dsse_core.errors import InvalidInputError
from dsse_core.limits import LONGEST_NAME
from dsse_core.printable import listed, printable
from scenarios.files.readings.file import save_readings
from scenarios.files.saved_network import format_toml, name_network_file, save_network
from scenarios.generate.cutting import cut_at, cut_into
from scenarios.importers.imported import Imported

FILES = ("network.toml", "network.json", "scenario.toml", "readings.csv", "import.txt")
LONGEST_KIND = 8
FLOOR = 1.0  # kVA by MVA of a phase: smallest standard deviation of made-up meters
DEFAULT_METERS = """
# The source has no measurements. These meters are made up: change them to those that there are.
[measurements]
zero_injection = "virtual"               # buses without load and source inject exactly nothing
voltage = {{ buses = [{substation}], sigma_percent = 0.2 }}
flow = {{ branches = "all", sigma_percent = 1.0 }}        # P and Q at the from end
injection = {{ buses = "all", sigma_percent = 10.0 }}     # P and Q

[telemetry]
source = "network"                       # readings of the power flow, with noise
"""
METERS_OF_PHASES = """
# These meters are made up: at the head, at regulators and at some ends; loads are forecasts. Change them to yours.
{names}[measurements]
floor_kva = {floor_kva:g}                # no percentage below means less, in a phase
zero_injection = "virtual"               # nodes without load and source inject exactly nothing
voltage = {{ buses = {buses}, sigma_percent = 0.5 }}
flow = {{ branches = {branches}, sigma_percent = 1.0 }}   # P and Q of each phase
injection = {{ buses = "all", sigma_percent = 30.0 }}     # P and Q of each phase, or leg

[telemetry]
source = "network"                       # readings of the power flow, with noise
"""
REAL_METERS = """
[measurements]
zero_injection = {zero_injection}

[telemetry]
source = "file"                          # the measurements of the source
file = "readings.csv"
"""


def write_imported(
    folder: Path,
    imported: Imported,
    cut: int | Sequence[str] = 1,
    check: Callable[[Path], None] = lambda _: None,
) -> tuple[Path, str]:
    """Write the files into ``folder``; the scenario's path, and a summary of the conversion.

    ``cut``: how many areas, or the branches to cut at, by id or name. ``check``: raises where the scenario at a path is
    not sound. Then, as after any other error, neither the files nor the folders made for them stay.

    Raises:
        InvalidInputError: one of the files is there already, or the network cannot be cut so.
        OSError: ``folder`` cannot be made or written.
    """
    files = (*FILES, *imported.files)
    if present := [name for name in files if (folder / name).exists()]:
        problems = [f"{name} is there already; choose another folder" for name in present]
        raise InvalidInputError(f"folder {folder}", problems)
    network = imported.network
    if not isinstance(cut, int):
        cut = [network.id_of(name) for name in cut]
    _ = cut_into(network, cut) if isinstance(cut, int) else cut_at(network, cut)
    made = [parent for parent in (folder, *folder.parents) if not parent.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path = _write_files(folder, imported, cut)
        check(path)
    except BaseException as error:
        for name in files:
            with contextlib.suppress(OSError):  # never made, where the folder cannot be
                (folder / name).unlink(missing_ok=True)
        for parent in made:
            with contextlib.suppress(OSError):  # never made, or something else stands in it by now
                parent.rmdir()
        if isinstance(error, OSError):  # of a full disk it does not say where
            raise OSError(error.errno, error.strerror, str(folder)) from None
        raise
    return path, summarise(imported, full=False)


def _write_files(folder: Path, imported: Imported, cut: int | Sequence[str]) -> Path:
    network = imported.network
    save_network(folder / name_network_file(network.n_nodes), network, imported.data_source)
    if imported.readings:
        save_readings(folder / "readings.csv", network, imported.readings)
        zero = imported.zero_injection
        meters = REAL_METERS.format(zero_injection=list(zero) if isinstance(zero, tuple) else f'"{zero}"')
    elif places := imported.places:
        branches = format_toml(list(places.branches))
        floor, buses = network.node_mva * FLOOR, list(places.buses)
        named = [f"{bus} is {name}" for bus in buses if (name := network.bus(bus).name)]
        others = f"; {name_network_file(network.n_nodes)} names the others"
        names = f"# Bus {printable(listed(named))}{others}.\n" if named else ""
        meters = METERS_OF_PHASES.format(buses=buses, branches=branches, floor_kva=floor, names=names)
    else:
        slack = network.slack.bus if network.slack else network.buses[0].id
        meters = DEFAULT_METERS.format(substation=slack if imported.substation is None else imported.substation)
    for name, text in imported.files.items():
        (folder / name).write_text(text, encoding="utf-8")
    path = folder / "scenario.toml"
    path.write_text(_head(imported, cut) + meters, encoding="utf-8")
    (folder / "import.txt").write_text(summarise(imported, full=True) + "\n", encoding="utf-8")
    return path


def _head(imported: Imported, cut: int | Sequence[str]) -> str:
    network, kind = imported.network, "measurements" if imported.readings else "power flow"
    areas = f"count = {cut}" if isinstance(cut, int) else f"switches = {format_toml(list(cut))}"
    if isinstance(cut, int) and cut > 1 and (open_ones := [k for k, closed in network.switches.items() if not closed]):
        areas += f", ties = {format_toml(open_ones)}"
    text = f"{imported.data_source}, its {kind}".replace("\\", "/").replace('"', "'")
    return (
        "# Written by dsse import; import.txt says what was converted, and docs/how-to/import.md how.\n\n"
        f"version = 1\nname = {format_toml(network.name[:LONGEST_NAME])}\n"
        f'description = "{" ".join(text.split())}"\n'
        f'network = "{name_network_file(network.n_nodes)}"\nstrategy = "information"\n'
        f"areas = {{ {areas} }}\n"
    )


def summarise(imported: Imported, *, full: bool) -> str:
    """A line for the elements, one for the readings, and one for each remark; of a long kind only the first ones."""
    counts = ", ".join(f"{count} {name}" for name, count in imported.converted.items() if count)
    lines = [("source", imported.data_source), ("converted", counts)]
    if imported.readings:
        lines.append(("readings", f"{len(imported.readings)} meters"))
    for what in ("changed", "fused", "left out", "note"):
        texts = [remark.text for remark in imported.remarks if remark.what == what]
        shown = texts if full else texts[:LONGEST_KIND]
        lines += [(what, text) for text in shown]
        if len(shown) < len(texts):
            lines.append((what, f"... {len(texts) - len(shown)} more in import.txt"))
    return "\n".join(f"{what:9}  {text}" for what, text in lines)
