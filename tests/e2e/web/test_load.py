"""The page under load: very many buses, hours of updates, strangers without number."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from agents.messages.keys import live_key
from agents.messages.packing import Incarnation
from coordinator.lab.evaluation.evaluation import choose_scenario
from coordinator.show.web import app, sources
from coordinator.show.web.sources import LiveSource
from coordinator.watch.observe.grid_tables import GridTables
from coordinator.watch.observe.watcher import Watcher
from tests.support.browser import browsing, find_chromium
from tests.support.served import played, serving
from tests.support.shown_states import published_by
from tests.support.waiting import DEADLINE_S, wait_until

pytestmark = pytest.mark.slow
ME = Incarnation(1, 1)
# Bytes: what a browser compiles and caches meanwhile; a kept moment is 40 kB, 1000 of them 40 MB.
MOST_GROWTH = 4_000_000


@pytest.fixture(autouse=True)
def _needs_a_browser() -> None:
    find_chromium()


class Feeder:
    """``areas`` in a row, each with ``buses``; every look is a new scan.

    ``coming``: tokens that the next look finds; nobody but the thread that looks may change the watcher.
    """

    def __init__(self, areas: int, buses: int) -> None:
        self.watcher = Watcher("run")
        self._names = [f"area{k + 1}" for k in range(areas)]
        self.coming: deque[str] = deque()
        self.scan = 0
        self._buses = {
            name: tuple(range(k * (buses - 1), k * (buses - 1) + buses)) for k, name in enumerate(self._names)
        }
        for name in self._names:
            self.watcher.take_presence(live_key("run", "area", name, ME), True)

    def __call__(self, duration_s: float) -> Watcher:
        time.sleep(duration_s)
        while self.coming:
            self.watcher.take_presence(self.coming.popleft(), True)
        self.scan += 1
        for k, (name, own) in enumerate(self._buses.items()):
            n = len(own)
            state = published_by(
                name,
                Incarnation(1, self.scan),
                buses=own,
                vm=tuple(0.9 + 0.2 * ((b + self.scan) % n) / n for b in range(n)),
                va=(0.0,) * n,
                sigma_vm=(0.001,) * n,
                sigma_va=(0.001,) * n,
                sent={other: (1, 1) for other in self._names[max(0, k - 1) : k + 2] if other != name},
                quality="degraded" if (self.scan + k) % 7 == 0 else "good",
                notes=(f"scan {self.scan}",),
            )
            self.watcher.take_state(state, time.monotonic())
        return self.watcher


@contextmanager
def shown(feeder: Feeder, known: GridTables | None = None) -> Iterator[tuple[LiveSource, Any, str]]:
    source = LiveSource(feeder, known, "run")
    source.start()
    try:
        with serving(source) as url, browsing() as page:
            yield source, page, url
    finally:
        source.close()


def find_bus(page: Any, url: str, areas: int, bus: int, fact: str) -> None:
    """Open the page, wait for its ``areas``, ask for ``bus``, and wait until ``fact`` and its past are shown."""
    page.goto(url)
    wait_until(lambda: page.locator("#areas tbody tr").count() == areas)
    page.fill("#what", str(bus))
    page.keyboard.press("Enter")
    page.wait_for_selector(f"#facts >> text={fact}", timeout=DEADLINE_S * 1000)
    page.wait_for_selector("#past canvas", timeout=DEADLINE_S * 1000)


def test_a_thousand_buses_of_a_scenario_are_drawn_and_one_of_them_is_found(dsse: Any, tmp_path: Path):
    assert dsse("generate", "--buses", "1000", "--areas", "50", "--out", "feeder").returncode == 0
    known = GridTables(choose_scenario(str(tmp_path / "feeder" / "scenario.toml")))
    feeder = Feeder(50, 1)
    feeder._buses = {area.name: tuple(area.network.row) for area in known.partition.areas}
    with shown(feeder, known) as (source, page, url):
        find_bus(page, url, 50, 777, "active power")
        before = source.newest.number
        wait_until(lambda: source.newest.number > before + 5)


@pytest.mark.long
def test_ten_thousand_buses_are_shown_and_one_of_them_is_found():
    with shown(Feeder(100, 101)) as (source, page, url):
        find_bus(page, url, 100, 7777, "voltage")
        assert len(source.newest.payload) < 1_000_000


@pytest.mark.long
def test_hours_of_updates_leave_the_memory_of_the_page_as_it_was(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sources, "UPDATE_S", 0.02)
    monkeypatch.setattr(sources, "BUSY_SHARE", 0.0)
    with shown(Feeder(5, 20)) as (source, page, url):
        find_bus(page, url, 5, 7, "voltage")
        session = page.context.new_cdp_session(page)

        def heap_after(moments: int) -> int:
            wanted = source.newest.number + moments
            wait_until(lambda: source.newest.number >= wanted, 10 * DEADLINE_S)
            session.send("HeapProfiler.collectGarbage")
            return int(session.send("Runtime.getHeapUsage")["usedSize"])

        first, last = heap_after(400), heap_after(1200)
        print(f"heap of the page after 400 and 1600 moments: {first / 1e6:.1f} and {last / 1e6:.1f} MB")
        assert last - first < MOST_GROWTH
        assert page.locator("#events li").count() <= 60


@pytest.mark.long
def test_a_hundred_thousand_strangers_leave_the_page_usable_and_its_areas_in_sight():
    feeder = Feeder(2, 5)
    with shown(feeder) as (_, page, url):
        page.goto(url)
        page.wait_for_selector("#areas .good", timeout=DEADLINE_S * 1000)
        feeder.coming.extend(live_key("run", "area", f"x{k}", ME) for k in range(100_000))
        page.wait_for_selector("#status >> text=announced as areas are not shown", timeout=DEADLINE_S * 1000)
        page.locator("#areas button", has_text="area2").focus()
        page.keyboard.press("Enter")
        page.wait_for_selector("#facts >> text=degrees of freedom", timeout=DEADLINE_S * 1000)


def test_a_server_that_makes_no_new_moment_is_heard_all_the_same(monkeypatch: pytest.MonkeyPatch):
    """The page takes one that it does not hear for gone; moments of a large grid on a slow machine are far apart."""
    monkeypatch.setattr(app, "PULSE_S", 0.2)
    with serving(played()) as url, browsing() as page:
        page.goto(url)
        said = (
            "new Promise((heard) => new EventSource('/api/stream').addEventListener('pulse', () => heard('a pulse')))"
        )
        assert page.evaluate(said) == "a pulse"


def test_who_reads_the_events_keeps_the_focus_while_new_ones_come():
    with shown(Feeder(2, 5)) as (source, page, url):
        page.goto(url)
        page.wait_for_selector("#events li", timeout=DEADLINE_S * 1000)
        page.evaluate("document.querySelector('#events').parentElement.focus()")
        before = source.newest.number
        wait_until(lambda: source.newest.number > before + 10)
        assert page.evaluate("document.activeElement.contains(document.querySelector('#events'))")
        assert page.evaluate("document.activeElement.getAttribute('role')") == "group"
