"""Waiting for what a watcher receives."""

from coordinator.watch.observe.attachment import wait_until_whole
from coordinator.watch.observe.watcher import Watcher


def test_who_has_no_time_to_wait_gets_what_is_known() -> None:
    watcher = Watcher("run")
    assert wait_until_whole(lambda _: watcher, 0.0) is watcher
