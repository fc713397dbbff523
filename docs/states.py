"""Pictures of the page in ten states of a feeder, and sound: ``python -m docs.states``, which needs Chromium.

The simulator runs the faults of the tests, a watcher hears it as it hears a bus, and a browser looks at the page.
"""

from __future__ import annotations

import io
import sys
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image, ImageColor

from agents.messages.keys import live_key
from agents.messages.packing import ReadingsMessage, StateMessage
from coordinator.show.web.sources import LiveSource
from coordinator.watch.observe.causes import ALARM, WORDS
from coordinator.watch.observe.grid_tables import GridTables
from coordinator.watch.observe.watcher import Watcher
from scenarios.files.saved_network import save_network
from scenarios.scenario import Scenario, load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.browser import browsing
from tests.support.faulted import FAULT_AT_S, FAULTS, ME, Feeder
from tests.support.served import serving

FIGURES = Path(__file__).parent / "figures" / "states"
AREAS, AREA = ("area1", "area2", "area3"), "area2"  # of the feeder; the one with the fault
LASTS_S = 45  # of the simulation, with a scan each second
SHOWN_AT_S = 12.0  # of the simulation, when the page opens
SETTLED_MS = 6000  # until histories and all parts of the page are there
SIZE = {"width": 1280, "height": 900}
INKS = ["--good", "--degraded", "--bad", "--mark"]  # of the page, also where they are rare
COLOURS = 48  # of a picture, for small files
WHOLE = "before => document.body.dataset.moment !== before"  # all parts of the page are of one moment
RATING_MVA = 4.0  # of the first branch of the overloaded feeder


@dataclass
class Tape:
    """All that a watcher hears of a simulated feeder, with its times."""

    heard: list[tuple[float, Callable[[Watcher, float], object]]] = field(default_factory=list)

    def take_state(self, state: StateMessage, at: float) -> None:
        self.heard.append((at, lambda watcher, then: watcher.take_state(state, then)))

    def take_readings(self, readings: ReadingsMessage) -> None:
        self.heard.append((self.heard[-1][0], lambda watcher, then: watcher.take_readings(readings)))

    def take_presence(self, key: str, alive: bool, at: float) -> None:
        self.heard.append((at, lambda watcher, then: watcher.take_presence(key, alive, then)))


@dataclass
class Player:
    """Plays a tape to a watcher, in real time from SHOWN_AT_S on."""

    tape: Tape
    watcher: Watcher
    began: float = field(default_factory=lambda: time.monotonic() - SHOWN_AT_S)

    def __call__(self, duration_s: float) -> Watcher:
        time.sleep(min(duration_s, 0.05))
        heard, now = self.tape.heard, time.monotonic() - self.began
        while heard and heard[0][0] <= now:
            at, show = heard.pop(0)
            show(self.watcher, self.began + at)
        return self.watcher


def film(fault: str | None) -> Tape:
    """The simulated feeder, with ``fault`` of the tests in one area."""
    made = FAULTS[fault] if fault else None
    tape, changes = Tape(), {"run.scan_s": 1.0, "run.timeout_s": 2.0 * LASTS_S, **(made.changes(AREA) if made else {})}
    scenario = load_scenario("ieee33", changes=changes)
    feeder = Feeder(changes, (AREA,) if made and made.is_older else ())
    feeder.watcher = tape  # type: ignore[assignment]
    for role, name in (("plant", "plant"), *(("area", name) for name in AREAS)):
        tape.take_presence(live_key("sim", role, name, ME), True, 0.0)
    for second in range(1, LASTS_S):
        if second == FAULT_AT_S and made:
            made.act(feeder, AREA)
        feeder.bus.run(1.0)
        if feeder.bus.plant_publishes and feeder.bus.router_runs:
            feeder.bus.next_scan(make_telemetry(scenario, second).by_area)
    return tape


def narrow(folder: Path) -> Scenario:
    """The feeder whose first branch may carry less than it does."""
    network = load_scenario("ieee33").network
    first, *others = network.branches
    rated = replace(network, branches=(replace(first, s_max=RATING_MVA / network.base_mva), *others))
    save_network(folder / "network.toml", rated, "ieee33, its first branch with a rating")
    return load_scenario("ieee33", changes={"network": str(folder / "network.toml")})


def strict(folder: Path) -> Scenario:
    """The feeder with a narrow band of voltages."""
    return load_scenario("ieee33", changes={"quality.operating_lowest_vm_pu": 0.93})


def usual(folder: Path) -> Scenario:
    return load_scenario("ieee33")


STATES: dict[str, tuple[str | None, Callable[[Path], Scenario]]] = {
    "sound": (None, usual),
    **{name.replace(" ", "-"): (name, usual) for name in FAULTS},
    "overload": (None, narrow),
    "undervoltage": (None, strict),
}


def take_picture(page: Any, name: str) -> Path:
    """What ``page`` shows, in its most frequent colours and those of voltages."""
    path = FIGURES / f"{name}.png"
    with Image.open(io.BytesIO(page.screenshot())) as picture:
        shown = np.asarray(picture.convert("RGB")).astype(int)
    found, place, count = np.unique(shown.reshape(-1, 3), axis=0, return_inverse=True, return_counts=True)
    steps = page.eval_on_selector_all("#voltages rect", "steps => steps.map(step => step.getAttribute('fill'))")
    inks = page.evaluate(f"{INKS}.map(ink => getComputedStyle(document.documentElement).getPropertyValue(ink).trim())")
    kept = np.vstack([found[np.argsort(-count)[:COLOURS]], [ImageColor.getrgb(ink) for ink in (*steps, *inks)]])
    nearest = np.array([abs(kept - colour).sum(axis=1).argmin() for colour in found], dtype=np.uint8)
    painted = Image.fromarray(nearest[place].reshape(shown.shape[:2]), "P")
    painted.putpalette(kept.astype(np.uint8).tobytes())
    painted.save(path, optimize=True)
    return path


def main(names: Collection[str]) -> None:
    FIGURES.mkdir(exist_ok=True)
    for name in names:
        fault, make_scenario = STATES[name]
        with TemporaryDirectory() as folder:
            scenario = make_scenario(Path(folder))
        source = LiveSource(Player(film(fault), Watcher("sim", frozenset(AREAS))), GridTables(scenario), "sim")
        source.start()
        try:
            with serving(source) as url, browsing(viewport=SIZE, color_scheme="light") as page:
                page.goto(url)
                page.wait_for_selector("#cause .what")
                page.wait_for_timeout(SETTLED_MS)
                if fault and WORDS[FAULTS[fault].kind].severity == ALARM:
                    page.wait_for_selector("#cause.bad")  # a fault of each scan is known once the scan is at its end
                page.wait_for_function(WHOLE, arg=page.evaluate("document.body.dataset.moment"))
                path = take_picture(page, name)
                print(f"{path} {path.stat().st_size // 1000} kB: {page.locator('#cause .what').text_content()}")
        finally:
            source.close()


if __name__ == "__main__":
    main(sys.argv[1:] or STATES)
