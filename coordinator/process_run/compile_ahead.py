"""``dsse compile``: fills the place of compiled code ahead of the first run, for an image or by an administrator; and
what a command on a large network leaves there for the next one."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass

from dsse_core import compiling
from dsse_core.errors import InvalidInputError


@dataclass(frozen=True, slots=True)
class CompiledAhead:
    """``folder``: where the code was kept; None: nothing had to be compiled. ``found_in``: where it is looked for."""

    folder: str | None
    found_in: tuple[str, ...]


def compile_for_next_time() -> None:
    """Compile what this process has done without on a large network, in this process, and keep it."""
    from agents.runtime.warm_up import warm_up_estimate, warm_up_sparse

    missed = compiling.take_done_without()
    if "estimate" in missed:  # in a radial network, and then nothing else is needed
        warm_up_estimate()
    elif "sparse" in missed:
        warm_up_sparse()


def compile_ahead() -> CompiledAhead:
    """Compile all that can be, unless it is kept already.

    Raises:
        InvalidInputError: numba is not installed, or there is no safe folder to keep the code in.
        OSError: code could not be written there.
    """
    if importlib.util.find_spec("numba") is None:
        problem = "numba is not installed, and nothing is compiled without it; pip install 'consensus-dsse[fast]'"
        raise InvalidInputError("dsse compile", [problem])
    from dsse_core.code_cache import not_kept
    from dsse_core.code_places import find_folder_to_keep_in, find_places

    if find_folder_to_keep_in() is None:
        faults = [f"{place.folder}: {place.fault or 'cannot be written'}" for place in find_places()]
        raise InvalidInputError("no safe folder for compiled code; set NUMBA_CACHE_DIR to one", faults)
    from agents.runtime.warm_up import warm_up, warm_up_batches, warm_up_estimate, warm_up_sparse

    folders: list[str | None] = []
    compiling.listen(lambda begins, folder: folders.append(folder) if begins else None)
    warm_up()
    warm_up_estimate()
    warm_up_batches()
    warm_up_sparse()
    if not_kept:
        raise OSError(not_kept[0].errno, not_kept[0].strerror, folders[0] if folders else None)
    looked_in = tuple(str(place.folder) for place in find_places() if place.fault is None)
    return CompiledAhead(folders[0] if folders else None, looked_in)
