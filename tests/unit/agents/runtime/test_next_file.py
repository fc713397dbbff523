"""The file of the next split is read when it lies there whole, and takes the place of the one before."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from agents.area_files.area_file import save_area_file
from agents.area_files.reader import load_area_file
from agents.protocol.configuration import Configuration
from agents.protocol.events import Offered
from agents.runtime.inbox import Inbox
from agents.runtime.next_file import LOOK_S, NextFile
from coordinator.lab.deployment.split import area_files
from dsse_core.grid.boundary import boundary_at
from scenarios.scenario import load_scenario
from tests.support.waiting import wait_until

DEADLINE_S = 180.0
CONTENT, OTHER = area_files(load_scenario("industrial13"), "run", ["tcp/127.0.0.1:7447"], time=0.0)
HERE, THERE = "tcp/127.0.0.1:7450", "tcp/127.0.0.1:7451"


def with_ring(content: Configuration) -> Configuration:
    """``content`` where the area meets its neighbour at two buses, under a strategy that cannot take that."""
    (neighbour,) = content.area.neighbours
    second = next(bus.id for bus in content.area.network.buses if bus.id not in (neighbour.bus, content.area.slack_bus))
    child = content.area.name if neighbour.is_parent else neighbour.area
    met = replace(neighbour, variables=boundary_at((neighbour.bus, second), child).names)
    return replace(content, strategy="admm", area=replace(content.area, neighbours=(met,)))


class Folder:
    """With the file of an area, and the looks of its agent."""

    def __init__(self, folder: Path, content: Configuration = CONTENT) -> None:
        self.path, self.next = folder / "area1.toml", folder / "area1.next.toml"
        save_area_file(self.path, content)
        self.inbox = Inbox()
        self.file = NextFile(self.path, content, self.inbox, load_area_file)
        self.now = 0.0

    def look(self) -> None:
        self.file.look(self.now)
        self.now += LOOK_S

    def offered(self) -> Configuration | None:
        (found,) = self.inbox.take(DEADLINE_S)
        assert isinstance(found, Offered)
        return found.configuration


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    return Folder(tmp_path)


def test_it_is_read_at_the_second_look_that_finds_it_and_once(folder: Folder):
    folder.look()
    save_area_file(folder.next, replace(CONTENT, tolerance=1e-7))
    folder.look()
    assert folder.inbox.take(0.0) == []
    folder.look()
    found = folder.offered()
    assert found is not None
    assert found.tolerance == 1e-7
    folder.look()
    assert folder.inbox.take(0.0) == []


def test_one_that_lies_there_at_the_start_is_read_at_once_and_one_that_goes_counts_no_longer(folder: Folder):
    save_area_file(folder.next, CONTENT)
    assert folder.file.read_at_once() == folder.offered() == CONTENT
    folder.next.unlink()
    folder.look()
    folder.look()
    assert folder.offered() is None


def test_one_that_is_replaced_is_read_again(folder: Folder):
    save_area_file(folder.next, CONTENT)
    folder.file.read_at_once()
    folder.inbox.take(0.0)
    save_area_file(folder.next, replace(CONTENT, tolerance=1e-8))
    folder.look()
    folder.look()
    found = folder.offered()
    assert found is not None
    assert found.tolerance == 1e-8


def test_one_that_is_replaced_while_it_is_read_is_offered_last(folder: Folder):
    reads, may_go_on = [], threading.Event()

    def load_slowly(path: Path) -> Configuration:
        found = load_area_file(path)
        reads.append(found.tolerance)
        assert may_go_on.wait(DEADLINE_S)
        return found

    folder.file = NextFile(folder.path, CONTENT, folder.inbox, load_slowly)
    for tolerance in (1e-7, 1e-8):
        save_area_file(folder.next, replace(CONTENT, tolerance=tolerance))
        folder.look()
        folder.look()
        wait_until(lambda: bool(reads))
    assert [thread.name for thread in threading.enumerate()].count("next file") == 1
    may_go_on.set()
    wait_until(lambda: folder.look() or len(reads) == 2)
    while (found := folder.offered()) is None or found.tolerance != 1e-8:
        assert reads == [1e-7, 1e-8]


@pytest.mark.parametrize(
    ("write", "why"),
    [
        (lambda path: path.write_text("area = 'area1'"), "meter: missing"),
        (lambda path: save_area_file(path, OTHER), "area: is area2; the file in use is of area1"),
        (lambda path: save_area_file(path, replace(CONTENT, run="night")), "run: is night; the file in use is of run"),
        (lambda path: save_area_file(path, with_ring(CONTENT)), "a ring, which strategy 'admm' cannot take"),
        (lambda path: save_area_file(path, replace(CONTENT, listen=(HERE,))), f"listen: is {HERE}; the agent listens"),
    ],
)
def test_one_that_cannot_be_used_is_none_and_the_log_names_it(
    folder: Folder, write: Callable[[Path], object], why: str, caplog: pytest.LogCaptureFixture
):
    write(folder.next)
    assert folder.file.read_at_once() is None
    assert folder.offered() is None
    assert why in caplog.text
    assert "area1.next.toml" in caplog.text


def test_links_with_neighbours_that_only_a_start_opens_are_needed_as_they_are(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    """A new parent of an area without a router would never be reached."""
    own = replace(CONTENT, listen=(HERE,), endpoints=(THERE,))
    folder = Folder(tmp_path, own)
    save_area_file(folder.next, replace(own, endpoints=(HERE,)))
    assert folder.file.read_at_once() is None
    assert f"endpoints: the agent has no link with {HERE}" in caplog.text
    save_area_file(folder.next, replace(own, endpoints=(), tolerance=1e-7))
    assert folder.file.read_at_once() is not None


def test_endpoints_of_routers_may_change(folder: Folder):
    save_area_file(folder.next, replace(CONTENT, endpoints=(THERE,)))
    assert folder.file.read_at_once() is not None


def test_it_takes_the_place_of_the_one_in_use(folder: Folder):
    save_area_file(folder.next, replace(CONTENT, tolerance=1e-7))
    found = folder.file.read_at_once()
    assert found is not None
    folder.file.take_place(found)
    assert load_area_file(folder.path).tolerance == 1e-7
    assert not folder.next.exists()


@pytest.mark.parametrize("is_read", [False, True])
def test_the_file_of_a_later_split_that_has_come_meanwhile_stays_and_is_read(folder: Folder, *, is_read: bool):
    """The area goes over to the one that was read before."""
    save_area_file(folder.next, replace(CONTENT, tolerance=1e-7))
    found = folder.file.read_at_once()
    assert found is not None
    folder.offered()
    save_area_file(folder.next, replace(CONTENT, tolerance=1.5e-8))
    if is_read:
        folder.look()
        folder.look()
        folder.offered()
    folder.file.take_place(found)
    assert load_area_file(folder.path).tolerance == CONTENT.tolerance
    folder.look()
    folder.look()
    later = folder.offered()
    assert later is not None
    assert later.tolerance == 1.5e-8


def test_where_it_cannot_be_moved_the_log_says_so(
    folder: Folder, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    shutil.copy(folder.path, folder.next)
    found = folder.file.read_at_once()
    assert found is not None

    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "replace", refuse)
    folder.file.take_place(found)
    assert "move it to area1.toml by hand" in caplog.text
