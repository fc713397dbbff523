"""What ``dsse record`` says, and when."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from coordinator.cli.main import run_command
from coordinator.watch.observe import attachment as session
from coordinator.watch.recording.folder import begin_writing


@contextmanager
def _join(*_: object) -> Iterator[tuple[None, str]]:
    yield None, "industrial13"


def test_a_recorder_that_is_refused_does_not_say_that_it_records(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(session, "join_run", _join)
    with begin_writing(tmp_path, "industrial13"):
        assert run_command(["record", "--out", str(tmp_path)]) == 2
    output = capsys.readouterr().err
    assert "another recorder writes here" in output
    assert "recording run" not in output
