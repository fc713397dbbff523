"""A replay on processes: an area that is ended and started again is none that has died, and nothing is left."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from agents.messages.keys import live_key
from agents.messages.packing import Incarnation
from agents.transport.zenoh_bus import TransportError
from coordinator.lab.process_run.fork_server import Ended
from coordinator.lab.stages.process_stage import PREFIX, ProcessStage
from tests.support.recordings import load_areas_of

AREAS = ["area1", "area2", "area3"]


class Orders:
    """Stands for the launcher: what it is told."""

    def __init__(self) -> None:
        self.told: list[str] = []

    def start(self, name: str, *_: object, **__: object) -> None:
        self.told.append(f"start {name}")

    def signal(self, name: str, number: int) -> None:
        self.told.append(f"end {name}")


def token(area: str, incarnation: int) -> str:
    return live_key("replay", "area", area, Incarnation(incarnation, 1))


@pytest.fixture
def stage(tmp_path: Path) -> ProcessStage:
    """One all of whose areas are there, without any process."""
    stage = ProcessStage(load_areas_of())
    stage._folder = tmp_path
    stage._launcher = Orders()  # type: ignore[assignment]
    for name in AREAS:
        stage._presence.take(token(name, 1), True)
    return stage


def test_the_end_of_an_area_that_is_reported_after_it_was_started_again_is_no_death(stage: ProcessStage) -> None:
    stage._updates.put((token("area2", 1), False))
    stage._have_there(["area1", "area3"])
    for update in ((token("area2", 2), True), Ended("area2", 100, 0)):
        stage._updates.put(update)
    stage._have_there(AREAS)
    stage._take(0.0)
    assert stage._launcher.told == ["end area2", "start area2"]  # type: ignore[attr-defined]
    stage._updates.put(Ended("area2", 101, 1))
    with pytest.raises(TransportError, match="area2 of the replay died with exit code 1"):
        stage._take(0.0)


def test_a_replay_removes_what_a_killed_one_has_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    left = tmp_path / f"{PREFIX}{'0' * 16}"
    left.mkdir()
    (left / "area1.log").write_text("a word")
    (tmp_path / "dsse-replay-of-mine").mkdir()
    with ProcessStage(load_areas_of()):
        assert not left.exists()
    assert [path.name for path in tmp_path.iterdir()] == ["dsse-replay-of-mine"]
