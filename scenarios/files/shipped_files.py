"""The TOML files inside this package: networks in ``cases/``, scenarios in ``shipped/``."""

from __future__ import annotations

import os
import re
from importlib.resources import files
from pathlib import Path
from typing import Literal

from dsse_core.errors import InvalidInputError
from dsse_core.files.wording import suggest
from scenarios.files.whole_folder import written_whole

ROOT = Path(str(files("scenarios")))
NETWORK_COPY = "network.toml"
NETWORK_LINE = re.compile(r'^network = "([^"]+)"', re.MULTILINE)


def find_shipped(folder: Literal["cases", "shipped"]) -> dict[str, Path]:
    """Name -> file of everything shipped in ``folder``, sorted by name."""
    names = sorted(file.removesuffix(".toml") for file in os.listdir(ROOT / folder) if file.endswith(".toml"))
    return {name: ROOT.joinpath(folder, f"{name}.toml") for name in names}


def find_scenario(name: str) -> Path:
    """The file of the shipped scenario ``name``.

    Raises:
        InvalidInputError: no shipped scenario has this name; lists those that are shipped.
    """
    shipped = find_shipped("shipped")
    if name not in shipped:
        there = f"; the file or folder {name!r} is not looked at" if Path(name).exists() else ""
        raise InvalidInputError(
            f"scenario {name!r}",
            [
                f"no shipped scenario has this name; shipped: {', '.join(shipped)}{suggest(name.lower(), shipped)} "
                f"(a scenario file of your own is given by its path, which ends in .toml{there})"
            ],
        )
    return shipped[name]


def copy_scenario(name: str, folder: Path) -> Path:
    """Copy a shipped scenario and its network into ``folder``, made if missing; the path of the scenario.

    Raises:
        InvalidInputError: no shipped scenario has this name, or one of the two files is there already.
    """
    text = find_scenario(name).read_text(encoding="utf-8")
    network = NETWORK_LINE.search(text)
    assert network is not None  # every shipped scenario names a shipped network
    case = find_shipped("cases")[network[1]].read_text(encoding="utf-8")
    target = folder / f"{name}.toml"
    there = [str(path) for path in (target, folder / NETWORK_COPY) if path.exists()]
    if there:
        raise InvalidInputError("copy", [f"{path} is there already; choose another folder" for path in there])
    with written_whole(folder) as new:
        (new / NETWORK_COPY).write_text(case, encoding="utf-8")
        (new / target.name).write_text(NETWORK_LINE.sub(f'network = "{NETWORK_COPY}"', text, count=1), encoding="utf-8")
    return target
