"""An agent does not take the place of one with a newer file, but that of a dead one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest

from agents.area_files.area_file import stamp_split
from agents.messages.keys import live_key, split_of
from agents.messages.packing import Incarnation
from agents.protocol.configuration import Configuration
from agents.runtime.duplicate_guard import OVERLAP_S, ReplacedError, take_place
from coordinator.lab.deployment.split import area_files
from dsse_core.split_identity import NO_SPLIT
from scenarios.scenario import load_scenario

AT = 1.7e9


def file_of(time: float, tolerance: float = 1e-6) -> Configuration:
    files = area_files(load_scenario("industrial13"), "run", ["tcp/127.0.0.1:7447"])
    return stamp_split([replace(content, tolerance=tolerance) for content in files], time=time)[0]


OLD, NEW = file_of(AT), file_of(AT + 3600, 1e-5)
EDITED = replace(NEW, tolerance=1e-7)
OF_ONE_TIME = (file_of(AT, 1e-5), file_of(AT, 1e-7)), (EDITED, replace(NEW, tolerance=1e-8))


class Bus:
    """On which a process of the area with ``file`` is seen until ``until``, s."""

    def __init__(self, file: Configuration | None, until: float) -> None:
        self.now, self._until = 0.0, until
        split = file.identity if file else NO_SPLIT
        self._token = live_key("run", "area", "area1", Incarnation(5, 7), split)

    def find_presence(self, key_expression: str, timeout_s: float) -> Sequence[str]:
        assert key_expression == "dsse/v3/run/live/area/area1/*"
        return [self._token, "dsse/v3/run/live/area/area1/no-incarnation"] if self.now < self._until else []

    def wait(self, seconds: float) -> None:
        self.now += seconds


def take(
    content: Configuration, running: Configuration | None, until: float = 1e9, following: Configuration | None = None
) -> float:
    """When ``content`` takes the place, s."""
    bus: Any = Bus(running, until)
    take_place(content, bus, following, lambda: bus.now, bus.wait)
    return float(bus.now)


@pytest.mark.parametrize(("given", "running"), [(OLD, NEW), (EDITED, NEW), (replace(OLD, split=None), OLD)])
def test_a_process_with_a_newer_file_keeps_its_place_and_both_files_are_named(
    given: Configuration, running: Configuration
):
    with pytest.raises(ReplacedError) as caught:
        take(given, running)
    assert all(str(content.identity) in str(caught.value) for content in (given, running))
    assert "--older-file" in str(caught.value)


@pytest.mark.parametrize(
    ("given", "running"),
    [(NEW, OLD), (OLD, OLD), (NEW, EDITED), (EDITED, OLD), (OLD, None), (OLD, replace(OLD, split=None))],
)
def test_the_place_of_one_with_the_same_or_an_older_file_is_taken_at_once(
    given: Configuration, running: Configuration | None
):
    assert take(given, running) == 0.0


@pytest.mark.parametrize("files", OF_ONE_TIME)
def test_of_two_splits_of_one_time_and_of_two_edited_files_none_is_newer(files: tuple[Configuration, Configuration]):
    one, other = files
    assert take(one, other) == take(other, one) == 0.0


def test_a_process_that_had_gone_over_to_the_next_file_is_not_waited_for():
    assert take(OLD, NEW, following=NEW) == 0.0


def test_the_token_of_a_process_that_was_killed_is_waited_for():
    assert 0.9 * OVERLAP_S <= take(OLD, NEW, until=0.9 * OVERLAP_S) <= OVERLAP_S


@pytest.mark.parametrize("content", [OLD, NEW, EDITED])
def test_a_token_states_the_split(content: Configuration):
    split = content.identity
    found = split_of(live_key("run", "area", "area1", Incarnation(5, 7), split))
    assert str(found) == str(split)
    assert (found.digest, found.time) == (split.digest, split.time)


def test_a_token_without_a_split_states_none():
    assert split_of(live_key("run", "area", "area1", Incarnation(5, 7))) == NO_SPLIT
    assert split_of("dsse/v3/run/live/area/area1/no-incarnation") == NO_SPLIT
