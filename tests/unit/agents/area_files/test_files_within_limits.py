"""Files for agents and routers are read within limits, and another one is rejected with file, size and limit."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from agents.area_files.reader import load_area_file
from agents.security.access_file import load_access
from agents.security.credentials import load_keys
from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_file import LARGEST_PEM, LARGEST_TOML

READERS: list[tuple[str, Callable[[Path], object], int]] = [
    ("area1.toml", load_area_file, LARGEST_TOML),
    ("access.toml", load_access, LARGEST_TOML),
    ("area1.crt", lambda path: load_keys(path.parent, "area1"), LARGEST_PEM),
    ("area1.key", lambda path: load_keys(path.parent, "area1"), LARGEST_PEM),
]


@pytest.mark.parametrize(("name", "read", "largest"), READERS)
def test_a_file_over_its_limit_is_rejected_with_name_size_and_limit(tmp_path: Path, name: str, read, largest: int):
    path = tmp_path / name
    path.touch(mode=0o600)
    os.truncate(path, 5 * largest)  # takes no room on the disk
    with pytest.raises(InvalidInputError) as caught:
        read(path)
    assert str(path) in str(caught.value)
    assert f"has {5 * largest:,} bytes, the limit is {largest:,}; give a smaller file" in str(caught.value)


@pytest.mark.parametrize(("name", "read", "largest"), READERS)
def test_a_pipe_that_nobody_writes_into_is_rejected_and_not_waited_for(tmp_path: Path, name: str, read, largest: int):
    os.mkfifo(tmp_path / name, mode=0o600)
    with pytest.raises(InvalidInputError, match="cannot be read: is a pipe or a device; give a regular file"):
        read(tmp_path / name)
