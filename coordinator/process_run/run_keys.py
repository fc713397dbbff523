"""The keys made for one secured run: for nobody else's eyes, and gone with the run, however its processes end."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from coordinator.process_run.stop_run import MARK, find_marked
from dsse_core.files.drafts import draft_folder, remove_leftovers

PREFIX = "dsse-keys-"
NAME = re.compile(rf"{PREFIX}({MARK.pattern})-")


@contextmanager
def folder_of_keys(mark: str) -> Iterator[Path]:
    """A folder for the keys of the run of ``mark``, removed at the end of the block; before, what killed runs left."""
    remove_keys_of_dead_runs()
    with draft_folder(Path(tempfile.gettempdir()).absolute(), f"{PREFIX}{mark}-") as folder:
        yield folder


def remove_keys_of_dead_runs() -> None:
    """Remove the keys that killed runs of this user have left, if all of their processes have ended."""
    remove_leftovers(Path(tempfile.gettempdir()), NAME.pattern, _is_used)


def _is_used(folder: Path) -> bool:
    found = NAME.match(folder.name)
    return found is not None and any(find_marked(found[1]))
