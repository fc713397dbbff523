"""Compiling of functions with numba, and numba's cache of their code, in the places of ``code_places`` only."""

from __future__ import annotations

import contextlib
import pickle
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from numba import njit
from numba.core import config, event, types
from numba.core.caching import CompileResultCacheImpl, FunctionCache

from dsse_core import compiling
from dsse_core.code_places import (
    Whole,
    find_folder_to_keep_in,
    find_places,
    for_owner_to_write,
    has_whole,
    hash_of_sources,
    name_of_folder,
    name_of_note,
)

not_kept: list[OSError] = []
"""Errors of writing compiled code; the process goes on with code that is not kept."""


def note_whole(what: Whole) -> None:
    """Writes a note beside the compiled code that all of ``what`` is kept; the caller has run all of it before.

    No note is written where no folder can keep code, where some code could not be written, where compiling is off, or
    where there is a note already.
    """
    folder = find_folder_to_keep_in()
    if folder is None or not_kept or getattr(config, "DISABLE_JIT", False) or has_whole(what):
        return
    with contextlib.suppress(OSError), for_owner_to_write():
        (folder / name_of_note(what)).touch()


class KeptCode:
    """The cache of one compiled function, in place of numba's own: that uses any folder that can be written."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._caches: dict[Path, FunctionCache] = {}
        for folder in (place.folder for place in find_places() if place.fault is None):
            with contextlib.suppress(RuntimeError):  # where NUMBA_CACHE_LOCATOR_CLASSES names other locators
                kept = _cache_in(folder)(function)
                if isinstance(kept._impl.locator, _Locator):
                    self._caches[folder] = kept

    @property
    def cache_path(self) -> str | None:
        return name_of_folder()

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        for kept in self._caches.values():
            with contextlib.suppress(OSError, EOFError, pickle.UnpicklingError):  # unreadable or broken: compile again
                if (code := kept.load_overload(sig, target_context)) is not None:
                    return code
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        folder = find_folder_to_keep_in()
        if folder is not None and folder in self._caches:
            try:
                with for_owner_to_write():
                    self._caches[folder].save_overload(sig, data)
            except OSError as error:  # a full disk: the next process compiles again
                not_kept.append(error)

    def enable(self) -> None: ...

    def disable(self) -> None: ...

    def flush(self) -> None: ...


def compiled(function: Callable[..., Any]) -> Any:
    """``function`` compiled once for all processes; once in each process where no safe folder can keep the code.

    The compiled function lets other threads go on while it runs: a process that takes in no messages from the bus loses
    its links. Numba counts references for each view of an array, and for each array given to a function. The loops over
    all buses have neither, as these counts would take as long as the work. Constants among the arguments are variables
    in it: numba would compile it once more for each constant of a call.
    """
    no_callback: dict[str, Any] = {"no_cfunc_wrapper": True}  # a way in from C, which would be compiled for nothing
    dispatcher: Any = njit(error_model="numpy", fastmath={"contract"}, nogil=True, **no_callback)(function)
    if hasattr(dispatcher, "_cache"):  # not where NUMBA_DISABLE_JIT is set
        dispatcher._cache = KeptCode(function)  # as ``enable_caching`` does with a cache of numba's own
        dispatcher.get_call_template = _without_literals(dispatcher.get_call_template)
    return dispatcher


def _without_literals(find: Callable[..., Any]) -> Callable[..., Any]:
    """``get_call_template`` of a dispatcher, for arguments that are constants as for others."""

    def find_template(args: Any, kws: Any) -> Any:
        return find(tuple(map(types.unliteral, args)), {name: types.unliteral(of) for name, of in dict(kws).items()})

    return find_template


class _Locator:
    """Locator of a function's code for numba: the place of the code, and the stamp of the sources of the code."""

    def __init__(self, line: int, file: str) -> None:
        self._py_file, self._line = file, line

    def ensure_cache_path(self) -> None: ...

    def get_source_stamp(self) -> str:
        return hash_of_sources()

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> _Locator:
        return cls(function.__code__.co_firstlineno, file)


@cache
def _cache_in(folder: Path) -> type[FunctionCache]:
    class Locator(_Locator):
        def get_cache_path(self) -> str:
            return str(folder)

    class Implementation(CompileResultCacheImpl):
        _locator_classes = [Locator]  # noqa: RUF012

    class Cache(FunctionCache):
        _impl_class = Implementation

    return Cache


class _Listener(event.Listener):
    """Listener of numba that reports to ``compiling`` when functions of this package are compiled.

    Compiling a function compiles those that it calls; only the beginning and the end of the outermost are reported.
    """

    depth = 0

    def on_start(self, begun: Any) -> None:
        if _is_ours(begun):
            self.depth += 1
            if self.depth == 1:
                compiling.note(True, name_of_folder())

    def on_end(self, ended: Any) -> None:
        if _is_ours(ended):
            self.depth -= 1
            if self.depth == 0:
                compiling.note(False, None)


def _is_ours(of: Any) -> bool:
    return bool(of.data["dispatcher"].py_func.__module__.startswith(f"{__package__}."))


event.register("numba:compile", _Listener())
