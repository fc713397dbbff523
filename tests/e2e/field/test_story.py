"""From meters in the field to a recording: what befalls a feeder is told alike by states, metrics and the record."""

from __future__ import annotations

import re
import signal
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from agents.messages.packing import StateMessage
from coordinator.watch.observe.attachment import Attachment, attach
from coordinator.watch.observe.run_address import RunAddress
from coordinator.watch.observe.watcher import AreaView
from coordinator.watch.recording.parquet import read_rows
from tests.support.field.feeder import WAYS, FeederUnderWay, running_feeder
from tests.support.waiting import DEADLINE_S, wait_until

pytestmark = [pytest.mark.slow, pytest.mark.long]
AHEAD_S = 3.0
LACK = "readings of this area are overdue or missing"


@dataclass
class Monitors:
    """A watcher on the bus, and the page of the metrics."""

    feeder: FeederUnderWay
    look: Attachment

    def wait_until(self, what: str, holds: Callable[[], bool], deadline_s: float = 2 * DEADLINE_S) -> None:
        """Until ``holds()``, for which new states arrive meanwhile."""
        deadline = time.monotonic() + deadline_s
        while not holds():
            states = {area: (self.view(area).quality, self.view(area).notes[:3]) for area in WAYS}
            assert time.monotonic() < deadline, f"not within {deadline_s} s: {what}; {states}"
            self.look(0.05)

    def view(self, area: str) -> AreaView:
        found = {view.name: view for view in self.look(0.0).look(time.monotonic()).areas}
        return found.get(area) or AreaView(area, False, None)

    def state(self, area: str) -> StateMessage:
        state = self.look(0.0).state_of(area)
        assert state is not None
        return state

    def notes(self, area: str) -> str:
        return "; ".join(self.view(area).notes)

    def all_good(self) -> bool:
        return all(self.view(area).quality == "good" for area in WAYS)

    def metric(self, name: str, **labels: str) -> float | None:
        """A sample of the metrics of now; None if there is none of these labels."""
        text = self.page("metrics")[1]
        for family in text_string_to_metric_families(text):
            for sample in family.samples:
                if sample.name == name and sample.labels == labels:
                    return float(sample.value)
        return None

    def page(self, name: str) -> tuple[int, str]:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self.feeder.port}/{name}", timeout=DEADLINE_S) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode()
        except OSError:
            return 0, ""


@contextmanager
def monitored_feeder(folder: Path) -> Iterator[Monitors]:
    with running_feeder(folder) as feeder:
        feeder.start("router", "record")
        wait_until(lambda: "recording run" in feeder.system.read_log("record"))  # of each good state the readings, too
        feeder.start(*(name for name in feeder.commands if name not in ("router", "record")))
        with attach(RunAddress([feeder.endpoint], feeder.scenario.name, DEADLINE_S)) as look:
            monitors = Monitors(feeder, look)
            monitors.wait_until("all areas are good", monitors.all_good)
            monitors.wait_until("the metrics are ready", lambda: monitors.page("ready")[0] == 200)
            yield monitors


def test_what_befalls_a_feeder_is_reported_alike_by_states_metrics_and_recording(dsse, tmp_path: Path):
    with monitored_feeder(tmp_path) as seen:
        a_gateway_is_killed(seen)
        wrong = a_meter_has_the_wrong_sign(seen)
        frozen = a_reading_is_frozen(seen)
        a_clock_is_wrong(seen, tmp_path)
        an_area_is_killed(seen)
        seen.wait_until("all areas are good at the end", seen.all_good)
        for name in ("record", "mqtt", "opcua", "modbus", "metrics", *WAYS, "router"):
            assert seen.feeder.system.end(name) == 0, seen.feeder.system.read_log(name)[-2000:]
    the_recording_agrees(tmp_path / "recording", wrong, frozen)
    replayed = dsse("replay", "recording", "--quiet")
    left_out = "left out" in replayed.stdout  # an area that is killed and comes back may take readings of a scan twice
    assert replayed.returncode == (5 if left_out else 0), replayed.stdout + replayed.stderr
    assert "good states compared" in replayed.stdout


def a_gateway_is_killed(seen: Monitors) -> None:
    """Its areas have nothing new: they say so, and what they know ages; the others go on."""
    seen.feeder.system.end("mqtt", signal.SIGKILL)
    seen.wait_until(
        "area1 and area2 are not good", lambda: all(seen.view(a).quality != "good" for a in WAYS if WAYS[a] == "mqtt")
    )
    seen.wait_until("they name the readings", lambda: all(LACK in seen.notes(a) for a in ("area1", "area2")))
    seen.wait_until("a gateway less", lambda: seen.metric("dsse_gateways_alive") == 2.0)
    not_good = {"area": "area1", "quality": "good"}
    seen.wait_until("so say the metrics", lambda: seen.metric("dsse_area_quality", **not_good) == 0.0)
    seen.wait_until("area4 goes on", lambda: LACK not in seen.notes("area4"))
    seen.feeder.start("mqtt")
    seen.wait_until("all areas are good again", seen.all_good)
    seen.wait_until("and three gateways", lambda: seen.metric("dsse_gateways_alive") == 3.0)


def a_meter_has_the_wrong_sign(seen: Monitors) -> str:
    """It is found and left out; when it is right again it is used again."""
    wrong = seen.feeder.meters_of("area3", "p_flow")[0].id
    seen.feeder.field.set_faults(sign=[wrong])
    seen.wait_until(f"{wrong} is removed", lambda: wrong in seen.state("area3").removed)
    seen.wait_until("so say the metrics", lambda: (seen.metric("dsse_area_removed_meters", area="area3") or 0) >= 1)
    seen.feeder.field.set_faults()
    seen.wait_until("it is used again", lambda: not any(seen.state(area).removed for area in WAYS))
    return wrong


def a_reading_is_frozen(seen: Monitors) -> str:
    """It becomes too old, and is named."""
    frozen = seen.feeder.meters_of("area2", "vm")[0].id
    seen.feeder.field.set_faults(frozen=[frozen])
    seen.wait_until(f"{frozen} is named", lambda: frozen in seen.notes("area2"))
    seen.wait_until("and left out", lambda: "too old" in seen.notes("area2"))
    seen.feeder.field.set_faults()
    seen.wait_until("it is used again", lambda: frozen not in seen.notes("area2"))
    return frozen


def a_clock_is_wrong(seen: Monitors, folder: Path) -> None:
    """The clock of area 4 is ahead: it and its neighbour measure by how much, and are not good."""
    path = folder / "areas" / "area4.toml"
    right = path.read_text()
    path.write_text(f"clock_error_s = {AHEAD_S}\n" + right)
    seen.feeder.system.end("area4")
    seen.feeder.start("area4")
    neighbour = next(iter(seen.state("area4").sent))

    def measured(name: str, other: str, sign: int) -> bool:
        skew = seen.state(name).clock_skews.get(other)
        return skew is not None and abs(skew - sign * AHEAD_S) < AHEAD_S / 4

    seen.wait_until("the neighbour measures it", lambda: measured(neighbour, "area4", 1))
    seen.wait_until(
        "both name it",
        lambda: "clock of area4" in seen.notes(neighbour) and f"clock of {neighbour}" in seen.notes("area4"),
    )
    seen.wait_until("the neighbour is not good", lambda: seen.view(neighbour).quality != "good")
    seen.wait_until(
        "the metrics show it",
        lambda: (seen.metric("dsse_area_clock_skew_seconds", area=neighbour, neighbour="area4") or 0) > AHEAD_S / 2,
    )
    path.write_text(right)
    seen.feeder.system.end("area4")
    seen.feeder.start("area4")
    seen.wait_until("all areas are good again", seen.all_good)


def an_area_is_killed(seen: Monitors) -> None:
    """Everybody notices; it comes back as a new incarnation."""
    before = seen.state("area2").header.incarnation
    seen.feeder.system.end("area2", signal.SIGKILL)
    seen.wait_until("area2 is gone", lambda: seen.view("area2").state == "gone")
    seen.wait_until("area1 says so", lambda: "area2 is gone" in seen.notes("area1"))
    seen.wait_until("not ready", lambda: "area2 is gone" in seen.page("ready")[1])
    seen.wait_until("so say the metrics", lambda: seen.metric("dsse_area_present", area="area2") == 0.0)
    seen.feeder.start("area2")
    seen.wait_until("it is back", lambda: seen.state("area2").header.incarnation > before and seen.all_good())
    seen.wait_until("and ready", lambda: seen.page("ready")[0] == 200)


def the_recording_agrees(recording: Path, wrong: str, frozen: str) -> None:
    events = list(rows_of(recording, "events", ("event", "name", "details")))
    notes: dict[str, set[str]] = {area: set() for area in WAYS}
    for area, listed in rows_of(recording, "states", ("area", "notes")):
        notes[area].update(listed)
    assert all(any(LACK in note for note in notes[area]) for area in ("area1", "area2"))
    skews = [re.search(r"clock of area4 is ([0-9.]+) s ahead", note) for listed in notes.values() for note in listed]
    assert any(found and abs(float(found[1]) - AHEAD_S) < AHEAD_S / 4 for found in skews)
    assert "neighbour area2 is gone" in notes["area1"]
    assert ("vanished", "area2") in {(event, name) for event, name, _ in events}
    assert any(event == "removed meters" and wrong in text.split() for event, _, text in events)
    used = list(rows_of(recording, "readings", ("area", "scan", "meter", "value")))
    scans = {area: {scan for its, scan, _, _ in used if its == area} for area in WAYS}
    of_frozen = {scan for _, scan, meter, _ in used if meter == frozen}
    assert scans["area2"] - of_frozen, "the frozen meter is in every scan of area2"
    good = {
        (area, scan)
        for area, scan, quality in rows_of(recording, "states", ("area", "scan", "quality"))
        if quality == "good"
    }
    missing = sorted((area, scan) for area, scan in good if scan not in scans[area])
    assert missing == [], "a good state whose readings are not recorded"


def rows_of(recording: Path, table: str, columns: tuple[str, ...]) -> Iterator[tuple]:
    """Of all hours."""
    files = sorted((recording / table).glob("*.parquet"))
    assert files, f"no table {table} in {sorted(map(str, recording.rglob('*')))}"
    for path in files:
        yield from read_rows(path, columns)
