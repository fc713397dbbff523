"""The operator of a running system: meters off and on, a scan, the end; by its key only, and no command twice."""

from __future__ import annotations

import json
import math
import queue
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from agents.messages.keys import all_commands, command_key
from agents.orders.order_book import STOPPED_CODE
from agents.security.credentials import load_keys
from agents.transport.zenoh_bus import Session
from dsse_core.grid.measurement import Source
from tests.support.keys_by_hand import AREAS, KeysByHand, scenario_of
from tests.support.system_by_hand import SystemByHand, Watcher, agreeing_system
from tests.support.waiting import DEADLINE_S, wait_until

RUN = "industrial13"
Dsse = Callable[..., subprocess.CompletedProcess[str]]


class System:
    """industrial13, whose areas agree; ``order``: run ``dsse`` there with arguments and the keys that there are."""

    def __init__(self, dsse: Dsse, system: SystemByHand, watcher: Watcher, endpoint: str, keys: list[str]) -> None:
        self.dsse, self.processes, self.watcher, self.endpoint, self.keys = dsse, system, watcher, endpoint, keys

    def order(self, *arguments: str, keys: list[str] | None = None) -> subprocess.CompletedProcess[str]:
        patience = () if "--wait" in arguments else ("--wait", str(DEADLINE_S))
        return self.dsse(*arguments, *patience, "--connect", self.endpoint, *(self.keys if keys is None else keys))

    def spared(self, area: str) -> str:
        """A meter of ``area`` without which the estimate changes, and is still one."""
        state = self.watcher.states[area]
        meters = [m.meter for m in self.watcher.telemetry.by_area[area] if m.meter.source is not Source.VIRTUAL]
        return next(m.id for m in meters if m.id not in (*state.critical, *state.removed))

    def wait_for_gap_below(self, limit: float) -> None:
        """Until all areas agree, and with the centralised estimate of all readings but those of meters that are off."""

        def is_near() -> bool:
            if self.watcher.obstacles():
                return False
            gap = self.watcher.gap()
            return gap.vm_pu is not None and max(gap.vm_pu, math.radians(gap.va_deg or 0.0)) <= limit

        self.watcher.wait_until(is_near)


@pytest.fixture(params=[False, True], ids=["without keys", "with keys"])
def system(dsse: Dsse, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[System]:
    with agreeing_system(dsse, tmp_path, secured=request.param) as parts:
        processes, watcher, endpoint, keys = parts
        yield System(dsse, processes, watcher, endpoint, keys)


def test_a_meter_that_is_off_is_left_out_until_it_is_on_again_also_by_a_restarted_area(system: System):
    watcher, meter = system.watcher, system.spared("area2")
    done = system.order("meter", "off", meter)
    assert (done.returncode, done.stdout) == (0, f"area2: {meter} is off\n"), done.stderr
    assert ("without --keys any process on this bus can do the same" in done.stderr) == (not system.keys)
    watcher.wait_until(lambda: watcher.states["area2"].meters_off == (meter,))
    watcher.leave_out(meter)
    system.wait_for_gap_below(1e-8)
    assert f"switched off by the operator: {meter}" in watcher.states["area2"].notes
    assert f"the operator has switched off: {meter}" in system.processes.read_log("area2")

    def is_shown() -> bool:
        shown = json.loads(system.order("watch", "--once", "--json").stdout)
        return shown["areas"].get("area2", {}).get("meters_off") == [meter]

    wait_until(is_shown)

    assert system.processes.end("area2") == 0
    before = watcher.states["area2"].header.incarnation
    system.processes.start("area2", "agent", "areas/area2.toml", *system.keys)
    watcher.wait_until(lambda: watcher.states["area2"].header.incarnation > before)
    system.wait_for_gap_below(1e-8)
    assert watcher.states["area2"].meters_off == (meter,)

    done = system.order("meter", "on", meter, "--json")
    assert (done.returncode, done.stderr if system.keys else "") == (0, ""), done.stderr
    assert json.loads(done.stdout) == {"meters": {meter: {"area": "area2", "is": "on"}}}
    watcher.leave_out()
    system.wait_for_gap_below(1e-8)
    assert watcher.states["area2"].meters_off == ()


def test_a_command_that_somebody_has_received_and_repeats_is_rejected_also_after_a_restart(system: System):
    watcher, meter = system.watcher, system.spared("area2")
    received: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    operators = system.processes.folder / "keys" if system.keys else None
    with (
        Session.connect([system.endpoint], DEADLINE_S, load_keys(operators, "watcher")) as ear,
        Session.connect([system.endpoint], DEADLINE_S, load_keys(operators, "operator")) as mouth,  # a stolen key
    ):
        ear.subscribe(all_commands(RUN), lambda key, payload: received.put(payload) if key.endswith("area2") else None)
        assert system.order("meter", "off", meter).returncode == 0
        payload = received.get(timeout=DEADLINE_S)
        assert system.order("meter", "on", meter).returncode == 0
        watcher.wait_until(lambda: watcher.states["area2"].meters_off == ())
        system.processes.end("area2")
        before = watcher.states["area2"].header.incarnation
        system.processes.start("area2", "agent", "areas/area2.toml", *system.keys)
        watcher.wait_until(lambda: watcher.states["area2"].header.incarnation > before)
        put = mouth.publisher(command_key(RUN, "area2"))

        def is_rejected() -> bool:
            put(payload)
            return "command of the past" in watcher.states["area2"].rejected

        watcher.wait_until(is_rejected)
        assert watcher.states["area2"].meters_off == ()
        assert "rejects command number 1 for this reason, command of the past" in system.processes.read_log("area2")


def test_mistakes_of_the_operator_are_one_clear_error_each(system: System):
    done = system.order("meter", "off", "vm@1", "no such meter")
    assert done.returncode == 2
    assert "'no such meter' is no meter id; one looks like vm@1" in done.stderr
    assert system.watcher.states["area1"].command == (0, 0, 0), "an order was given beside a wrong id"
    done = system.order("meter", "off", "vm@99")
    assert done.returncode == 2
    near = "(no area shows bus 99; near are "
    assert f"no area has a meter 'vm@99' {near}" in done.stderr
    assert "; ids are in the area files of areas area1, area2" in done.stderr
    done = system.order("meter", "on", "vm@1")
    assert done.returncode == 2
    assert "meter 'vm@1' is not off; none is" in done.stderr
    done = system.order("meter", "off", "vm@1", "vm@99")
    assert done.returncode == 2, "one of two meters is unknown"
    done = system.order("meter", "on", "vm@1")
    assert "meter 'vm@1' is not off; none is" in done.stderr, "a rejected command has switched a meter off"
    done = system.order("switch", "open", "1-2", "--json")
    assert done.returncode == 2
    assert "no area holds a switch '1-2'; there is no switch" in done.stderr
    assert "Traceback" not in done.stderr
    done = system.order("stop", "folder")
    assert done.returncode == 2
    assert "give either RUN_FOLDER, or with --connect where the system is" in done.stderr


def test_an_area_that_is_away_is_named_and_the_others_follow(system: System):
    meter = system.spared("area2")
    system.processes.end("area1")
    system.watcher.wait_until(lambda: "area1" not in system.watcher.present)
    done = system.order("meter", "off", meter)
    assert (done.returncode, done.stdout) == (0, f"area2: {meter} is off\n"), done.stderr
    assert "not on the bus, and not reached: area1" in done.stderr


def test_an_area_that_cannot_record_a_command_rejects_it_and_the_operator_learns_why(system: System):
    meter = system.spared("area2")
    (system.processes.folder / "areas" / f"{RUN}.area2.operator.json").mkdir()  # no file can take its place
    done = system.order("meter", "off", meter, "--wait", "8")
    assert (done.returncode, done.stdout) == (2, "")
    assert "area2 has not followed the command within 8 s: it rejects: command that cannot be recorded" in done.stderr
    assert "area2.operator.json: Is a directory" in system.processes.read_log("area2")
    assert system.watcher.states["area2"].meters_off == ()


def test_a_scan_that_is_asked_for_is_made_by_the_plant(system: System):
    before = system.watcher.states["area1"].header.scan
    done = system.order("scan")
    assert (done.returncode, done.stdout) == (0, f"area1, area2: scan {before + 1}\n"), done.stderr
    system.wait_for_gap_below(1e-8)


def test_where_no_plant_is_a_scan_has_the_areas_take_the_newest_readings(system: System):
    system.processes.end("plant")
    system.watcher.wait_until(lambda: "plant" not in system.watcher.present)
    done = system.order("scan")
    assert (done.returncode, done.stdout) == (0, "area1, area2: the newest readings are taken\n"), done.stderr
    assert "the operator has asked for a scan" in system.processes.read_log("area1")


def test_a_system_ends_when_the_operator_stops_it(system: System):
    done = system.order("stop", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {"run": RUN, "stopped": ["area1", "area2", "plant"]}
    for name in ("area1", "area2", "plant"):
        process = system.processes.processes[name]
        wait_until(lambda process=process: process.poll() is not None)
        assert process.poll() == STOPPED_CODE
    assert "area area1 ends: stopped by the operator" in system.processes.read_log("area1")


def test_where_areas_link_directly_the_operator_links_with_each(
    dsse: Dsse, edited_scenario: Callable[..., Path], tmp_path: Path
):
    with KeysByHand(tmp_path, scenario_of(edited_scenario, "neighbours")) as system:
        system.start_others()
        patience = "--wait", str(DEADLINE_S)
        wait_until(
            lambda: all("scan 1" in system.read_log(area) or "estimates" in system.read_log(area) for area in AREAS)
        )
        done = dsse("meter", "off", "vm@30", "--direct", *patience, *system.connect())
        assert (done.returncode, done.stdout) == (0, "area3: vm@30 is off\n"), done.stderr
        assert "the operator has switched off: vm@30" in system.read_log("area3")
        done = dsse("scan", "--direct", *patience, *system.connect())
        assert done.stdout == "area1, area2, area3: the newest readings are taken\n", done.stderr
        done = dsse("stop", "--direct", *patience, *system.connect())
        assert done.stdout == f"run {system.access.run}: area1, area2, area3 stopped\n", done.stderr
