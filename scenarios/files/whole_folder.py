"""Writer of files that belong together: all of them come into a folder at once, or none."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from dsse_core.files.drafts import draft_folder, remove_leftovers


def _make(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)


@contextmanager
def written_whole(folder: Path, make: Callable[[Path], None] = _make) -> Iterator[Path]:
    """A folder to write into; at the end of the block its files replace those of the same name in ``folder``.

    After an error in the block ``folder`` is as before, and the folders that were made for it are removed. ``make``
    makes ``folder`` with its missing parents.

    Raises:
        OSError: naming ``folder``, where it cannot be made or written, or a disk is full.
    """
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        make(folder)
        remove_leftovers(folder)
        with draft_folder(folder) as new:
            yield new
            for file in sorted(new.iterdir()):
                file.replace(folder / file.name)
    except BaseException as error:
        for place in made:
            with contextlib.suppress(OSError):  # never made, or something else stands in it by now
                place.rmdir()
        if isinstance(error, OSError):
            raise OSError(error.errno, error.strerror or str(error), str(folder)) from None
        raise
