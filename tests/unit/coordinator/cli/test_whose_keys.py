"""Whose certificate a watching command shows."""

from pathlib import Path

import pytest

from agents.security.credential_files import credentials_in
from coordinator.watch.observe.attachment import find_own_name


@pytest.mark.parametrize(
    ("there", "name"),
    [
        (("watcher", "coordinator"), "watcher"),
        (("coordinator",), "coordinator"),  # keys that were made before there were watchers
        (("watcher",), "watcher"),
        ((), "watcher"),
    ],
)
def test_who_watches_shows_the_certificate_with_the_least_rights(tmp_path: Path, there: tuple[str, ...], name: str):
    for owner in there:
        credentials_in(tmp_path, owner).certificate.touch()
    assert find_own_name(tmp_path) == name
