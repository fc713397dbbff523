"""A run folder is one run's alone."""

from __future__ import annotations

from pathlib import Path

import pytest

from coordinator.watch.run_folder import PARTS, make_run_folder
from dsse_core.errors import InvalidInputError


def test_of_two_runs_that_take_a_folder_at_once_one_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_run_folder(tmp_path / "out", "run", PARTS)
    monkeypatch.setattr(Path, "iterdir", lambda _: iter(()))  # as the other saw it, a moment before
    with pytest.raises(InvalidInputError, match="is not empty; choose a new one"):
        make_run_folder(tmp_path / "out", "run", PARTS)
