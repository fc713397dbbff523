"""A feeder on the simulator with one fault or several, and a watcher that sees it as one on the bus does."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import scenarios
from agents.messages.keys import live_key
from agents.messages.packing import Incarnation
from coordinator.lab.deployment.split import area_files
from coordinator.lab.simulator.simulator import STARTED_AT, SimulatedBus
from coordinator.watch.observe.causes import Cause, find_causes
from coordinator.watch.observe.grid_tables import GridTables, find_tables
from coordinator.watch.observe.summary import summarise
from coordinator.watch.observe.watcher import Watcher
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry

ME = Incarnation(1, 1)
FAULT_AT_S = 4.0  # all areas are good by then
SEEN_AT_S = 9.0  # beyond all patience
NO_BUS = ("tcp/127.0.0.1:0",)


class Feeder:
    """The 33-bus feeder in three areas, its plant and a watcher. ``area1`` is the hub.

    ``older``: areas with the files of an older split.
    """

    def __init__(self, changes: Mapping[str, Any], older: tuple[str, ...] = ()) -> None:
        scenario = load_scenario("ieee33", changes={"run.timeout_s": 60.0, **changes})
        self.known = GridTables(scenario)
        files = {file.area.name: file for file in area_files(scenario, "sim", NO_BUS, time=STARTED_AT)}
        before = load_scenario(
            "ieee33", changes={**changes, "run.timeout_s": 60.0, "measurements.flow.sigma_percent": 2}
        )
        old = {file.area.name: file for file in area_files(before, "sim", NO_BUS, time=STARTED_AT - 86_400.0)}
        self.watcher = Watcher("sim")
        self.now = 0.0
        self.bus = SimulatedBus(
            [old[name] if name in older else file for name, file in files.items()],
            make_telemetry(scenario).by_area,
            lambda at, state: self.watcher.take_state(state, at) and None,
            lambda at, area, alive: self.show("area", area, alive, at),
            on_readings=lambda at, readings: self.watcher.take_readings(readings),
        )
        self.show("plant", "plant", True, 0.0)

    def show(self, role: str, name: str, alive: bool, at: float) -> None:
        self.watcher.take_presence(live_key("sim", role, name, ME), alive, at)

    def end_plant(self) -> None:
        self.bus.plant_publishes = False
        self.show("plant", "plant", False, self.bus.now)

    def find_causes(self) -> tuple[Cause, ...]:
        view = self.watcher.look(self.bus.now)
        summary = summarise(find_tables(self.watcher, view, self.known), self.known)
        return find_causes(view, self.bus.now, summary)


@dataclass(frozen=True)
class Fault:
    """A fault that concerns one area beside the hub. ``words``: of the cause that it must be named by.

    ``changes``: of the scenario; ``act``: at FAULT_AT_S; ``is_older``: the area has the file of an older split;
    ``rates``: a branch of it has a rating.
    """

    kind: str
    words: str
    changes: Callable[[str], dict[str, Any]] = lambda area: {}
    act: Callable[[Feeder, str], None] = lambda feeder, area: None
    is_older: bool = False
    rates: bool = False


RATED = {"area2": ("9", "10", 28.5), "area3": ("30", "31", 20.5)}  # branch and rating, A: it carries 112 % of that


def rate(folder: Path, area: str) -> str:
    """Path of the network with a rating of one branch in ``area`` that it exceeds."""
    one, other, rating = RATED[area]
    text = (files(scenarios) / "cases/ieee33.toml").read_text()
    branch = f"from = {one}, to = {other},"
    path = folder / "rated.toml"
    path.write_text(text.replace(branch, f"{branch} rating_a = {rating},"))
    return str(path)


METER = {"area2": "p_injection@10", "area3": "p_injection@28"}
CUT = {"at_s": FAULT_AT_S, "for_s": 50.0}
FAULTS = {
    "area killed": Fault(
        "gone",
        "the agent of {0} is gone since 4.0 s: start `dsse agent {0}.toml` again",
        act=lambda f, area: f.bus.kill(area),
    ),
    "link cut": Fault(
        "link",
        "no message has passed between the agents of area1 and {0} since 3.8 s: look at the network",
        lambda area: {"faults.events": [{**CUT, "cut": ["area1", area]}]},
    ),
    "wrong file": Fault("file", "the area file of {0} is older since 0.", is_older=True),
    "liar": Fault(
        "mismatch",
        "the estimates of area1 and {0} disagree at bus 6 by 0.",
        lambda area: {"faults.link": [{"from": area, "to": "area1", "lie": {"vm_pu": 0.02}}]},
    ),
    "gateway dead": Fault(
        "gateway",
        "the source of the readings (process `plant`) is gone since 4.0 s: start `dsse plant` again",
        act=lambda f, area: f.end_plant(),
    ),
    "clock off": Fault(
        "clock",
        "the clock of {0} is 3 s ahead since 0.",
        lambda area: {"faults.clock_error_s": {area: 3.0}},
    ),
    "bad meter": Fault(
        "bad data",
        "wrong readings of the active power meter at bus {3} ({1}) in {0} are left out since 0.0 s: check",
        lambda area: {"telemetry.gross_error": [{"meter": METER[area], "sigmas": 40.0}]},
    ),
    "overload": Fault("loading", "branch {2} is at 11", rates=True),
    "undervoltage": Fault(
        "low voltage",
        "bus ",
        lambda area: {"quality.operating_lowest_vm_pu": 0.926},  # above buses of area2 and area3 by more than noise
    ),
    "router dead": Fault(
        "router",
        "no message of any area has been received since 3.8 s: start `dsse router` again",
        act=lambda f, area: f.bus.stop_router(),
    ),
}


def run_with(faults: Mapping[str, str], folder: Path) -> Feeder:
    """The feeder after all of ``faults``, name -> the area that it concerns; ``folder``: for files."""
    changes: dict[str, Any] = {"run.scan_s": 1.0}
    for name, area in faults.items():
        if FAULTS[name].rates:
            changes["network"] = rate(folder, area)
        for key, value in FAULTS[name].changes(area).items():
            changes[key] = [*changes[key], *value] if isinstance(value, list) and key in changes else value
    feeder = Feeder(changes, tuple(area for name, area in faults.items() if FAULTS[name].is_older))
    feeder.bus.run(FAULT_AT_S)
    for name, area in faults.items():
        FAULTS[name].act(feeder, area)
    feeder.bus.run(SEEN_AT_S - FAULT_AT_S)
    return feeder


def words_of(fault: str, area: str) -> str:
    return FAULTS[fault].words.format(area, METER[area], "-".join(RATED[area][:2]), METER[area].split("@")[1])
