"""The keys made for one secured run: readable by this user alone, and removed after the run, even if it is killed."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from coordinator.lab.process_run.stop_run import MARK, find_marked
from dsse_core.files.drafts import draft_folder, remove_leftovers

PREFIX = "dsse-keys-"
NAME = re.compile(rf"{PREFIX}({MARK.pattern})-")


@contextmanager
def folder_of_keys(mark: str) -> Iterator[Path]:
    """Makes a folder for the keys of the run of ``mark``, and removes it at the end of the block. Removes the keys of
    killed runs first.
    """
    remove_keys_of_dead_runs()
    with draft_folder(Path(tempfile.gettempdir()).absolute(), f"{PREFIX}{mark}-") as folder:
        yield folder


def remove_keys_of_dead_runs() -> None:
    """Removes the keys that killed runs of this user have left, if all processes of the run have ended."""
    remove_leftovers(Path(tempfile.gettempdir()), NAME.pattern, _is_used)


def _is_used(folder: Path) -> bool:
    found = NAME.match(folder.name)
    return found is not None and any(find_marked(found[1]))
