"""``dsse compile``: compiles the solvers ahead of the first run, for an image or by an administrator. A command on a
large network that ran without compiled code compiles it for the next command."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass

from dsse_core import compiling
from dsse_core.errors import InvalidInputError
from dsse_core.files.installation import install_command


@dataclass(frozen=True, slots=True)
class CompiledAhead:
    """``folder``: of the code compiled now; None: nothing to compile. ``found_in``: folders searched for code."""

    folder: str | None
    found_in: tuple[str, ...]


def compile_for_next_time() -> None:
    """Compiles the solvers that this process lacked on a large network, in this process, and keeps the code."""
    from agents.runtime.warm_up import warm_up_estimate, warm_up_sparse

    missed = compiling.take_done_without()
    if "estimate" in missed:  # in a radial network, and then nothing else is needed
        warm_up_estimate()
    elif "sparse" in missed:
        warm_up_sparse()


def compile_ahead() -> CompiledAhead:
    """Compiles all solvers that are not kept yet.

    Raises:
        InvalidInputError: numba is not installed, or there is no safe folder to keep the code in.
        OSError: the code could not be written to its folder.
    """
    if importlib.util.find_spec("numba") is None:
        problem = f"numba is not installed, and nothing is compiled without it; {install_command('fast')}"
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
