"""What the plant publishes and what the area files hold."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from agents.area_files.reader import load_area_file
from agents.messages.keys import choose_run_id, default_run_id, live_key
from agents.messages.packing import Incarnation, TelemetryMessage, decode
from agents.orders.order_book import OrderBook
from agents.runtime.duplicate_guard import DuplicateGuard
from agents.runtime.inbox import Inbox
from agents.transport.renewable_bus import RenewableBus
from agents.transport.zenoh_bus import Session
from coordinator.cli.processes import plant
from coordinator.lab.deployment.split import area_files, write_area_files
from coordinator.lab.plant.plant import BURST, NoAreaWarning, PlantLoop, run_plant
from coordinator.lab.plant.scans import MadeScan, OwnScans
from coordinator.lab.plant.telemetry_messages import make_payloads
from dsse_core.errors import DsseError, InvalidInputError
from dsse_core.grid.measurement import Source
from dsse_core.limits import LONGEST_S
from dsse_core.link_faults import LinkFaults
from scenarios.scenario import load_scenario
from scenarios.telemetry import find_lateness, make_telemetry


@contextmanager
def restored_signals() -> Iterator[None]:
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in numbers}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def readings(seed: int) -> dict[str, tuple[object, ...]]:
    payloads = make_payloads(replace(load_scenario("ieee33"), seed=seed), "run", Incarnation(1, 0))
    messages = {area: decode(payload) for area, payload in payloads.items()}
    assert all(isinstance(message, TelemetryMessage) for message in messages.values())
    return {area: (m.meters, m.values, m.sigmas) for area, m in messages.items()}  # type: ignore[union-attr]


def test_the_same_seed_gives_the_same_telemetry_and_another_seed_another():
    assert readings(3) == readings(3)
    assert readings(3) != readings(4)


def test_a_plant_asks_the_bus_for_the_presence_of_its_areas_and_of_nobody_else(monkeypatch: pytest.MonkeyPatch):
    asked: list[str] = []

    class Bus(nullcontext[None]):
        def watch_presence(self, expression: str, callback: object) -> None:
            asked.append(expression)

        def declare_presence(self, key: str) -> None:
            raise DsseError("all is declared before the token is shown")

        def publisher(self, key: str) -> None: ...
        def subscribe(self, key: str, callback: object) -> None: ...
        def __enter__(self) -> Any:
            return self

    monkeypatch.setattr(Session, "join", lambda *_, **__: Bus())
    with restored_signals():
        assert run_plant(OwnScans(load_scenario("ieee33"), many=False), "run", ()) == 2
    areas = ("area/area1", "area/area2", "area/area3")
    assert asked == [f"dsse/v3/run/live/{name}/*" for name in (*areas, "plant/plant")]


@pytest.mark.parametrize("is_made", [False, True])
def test_a_plant_states_the_split_of_its_scenario_which_its_area_files_are_of(is_made: bool):
    scenario = load_scenario("ieee33")
    scans = MadeScan.of(scenario, make_telemetry(scenario)) if is_made else OwnScans(scenario, many=True)
    splits = {decode(payload).split for payload in scans.payloads("run", Incarnation(1, 0), 1).values()}  # type: ignore[union-attr]
    files = area_files(scenario, "another", ["tcp/192.0.2.7:7447"])
    assert splits == {scans.split} == {content.identity for content in files}


def test_virtual_measurements_are_not_sent_because_area_files_hold_them(tmp_path: Path):
    scenario = load_scenario("industrial13")
    files = dict(write_area_files(scenario, "run", ["tcp/127.0.0.1:7447"], tmp_path))
    payloads = make_payloads(scenario, "run", Incarnation(1, 0))
    for area, path in files.items():
        message = decode(payloads[area])
        assert isinstance(message, TelemetryMessage)
        meters = load_area_file(path).meters
        assert set(message.meters) == {meter.id for meter in meters if meter.source is not Source.VIRTUAL}


@pytest.mark.parametrize("suffix", [".toml", ".json"])
def test_an_area_file_holds_the_area_and_nothing_of_the_others(tmp_path: Path, suffix: str):
    scenario = load_scenario("ieee33-lossy")
    files = dict(write_area_files(scenario, "run", ["tcp/127.0.0.1:7447"], tmp_path, suffix=suffix))
    assert list(files) == ["area1", "area2", "area3"]
    for name, path in files.items():
        content = load_area_file(path)
        assert content.area == scenario.partition.area(name)
        assert content.links == {n.area: LinkFaults(loss=0.3) for n in content.area.neighbours}
        assert content.seed == scenario.seed
        assert all(meter.bus in content.area.network.row for meter in content.meters)


def test_the_faults_of_a_directed_link_go_to_the_area_that_sends(tmp_path: Path):
    wild = LinkFaults(
        **{"loss": 0.7, "burst_enter": 0.1, "burst_leave": 0.5, "delay_s": 0.01, "corrupt": 0.2, "load_frozen": True},
        **{"lie_va": 0.1, "until_s": 5.0, "cuts": ((1.0, 2.0), (4.0, 4.5))},
    )
    scenario = load_scenario("ieee33")
    links = scenario.faults.links | {("area1", "area2"): wild}
    scenario = replace(scenario, faults=replace(scenario.faults, links=links))
    files = dict(write_area_files(scenario, "run", ["tcp/127.0.0.1:7447"], tmp_path))
    assert load_area_file(files["area1"]).links == {"area2": wild, "area3": LinkFaults()}
    assert load_area_file(files["area2"]).links == {"area1": LinkFaults()}


def test_the_penalty_of_the_scenario_reaches_every_area(tmp_path: Path):
    scenario = replace(load_scenario("ieee33"), admm_penalty=2.5)
    files = dict(write_area_files(scenario, "run", ["tcp/127.0.0.1:7447"], tmp_path))
    assert [load_area_file(path).penalty for path in files.values()] == [2.5] * 3


def test_the_time_between_scans_reaches_every_area_and_no_other_scenario_has_one(tmp_path: Path):
    scenario = load_scenario("ieee33", changes={"run.scan_s": 4.0})
    for folder, prepared, expected in (("with", scenario, 4.0), ("without", load_scenario("ieee33"), None)):
        (tmp_path / folder).mkdir()
        files = dict(write_area_files(prepared, "run", ["tcp/127.0.0.1:7447"], tmp_path / folder))
        assert [load_area_file(path).scan_s for path in files.values()] == [expected] * 3


@pytest.mark.parametrize("scan_s", [0.0, -1.0, 1e-4, 1e6])
def test_a_time_between_scans_that_cannot_be_is_rejected(scan_s: float):
    with pytest.raises(InvalidInputError, match="scan_s"):
        load_scenario("ieee33", changes={"run.scan_s": scan_s})


def test_a_plant_states_when_every_reading_was_measured_and_that_it_is_valid():
    started = time.time()
    message = decode(make_payloads(load_scenario("ieee33"), "run", Incarnation(1, 1))["area1"])
    assert isinstance(message, TelemetryMessage)
    assert set(message.times) == {message.times[0]}
    assert started <= message.times[0] <= message.header.time
    assert message.valid == (True,) * len(message.meters)


def test_a_run_id_is_made_of_what_a_key_may_contain():
    assert default_run_id("My Grid (2)") == "my-grid-2"
    with pytest.raises(InvalidInputError, match="My/Run"):
        choose_run_id("ieee33", "My/Run")


def no_bus() -> RenewableBus:
    return RenewableBus(lambda *_: nullcontext(), lambda _: None)  # type: ignore[arg-type,return-value]


def test_a_plant_whose_scans_follow_at_once_publishes_each_and_can_be_stopped():
    published: list[bytes] = []
    inbox = Inbox()
    guard = DuplicateGuard("plant", Incarnation(1, 1), 0.0, heartbeat_s=0.2)
    loop = PlantLoop(
        {"area1": published.append}, inbox, heartbeat_s=0.2, guard=guard, bus=no_bus(), orders=OrderBook("plant", "run")
    )
    assert not loop.publish_scan({"area1": b"scan 1"}, {}, duration_s=1e-9)
    inbox.put("stop", None)
    assert loop.publish_scan({"area1": b"scan 2"}, {}, duration_s=1e-9)
    assert published == [b"scan 1", b"scan 2"]


def test_a_plant_sends_much_in_pieces_and_who_waits_when_a_scan_ends_is_first_in_the_next():
    published: list[str] = []
    areas = [f"area{k}" for k in range(1, 4)]
    publishers = {area: lambda payload, area=area: published.append(f"{area} {payload[:1].decode()}") for area in areas}
    guard = DuplicateGuard("plant", Incarnation(1, 1), 0.0, heartbeat_s=LONGEST_S)
    loop = PlantLoop(
        publishers, Inbox(), heartbeat_s=LONGEST_S, guard=guard, bus=no_bus(), orders=OrderBook("plant", "run")
    )
    for scan in (b"1", b"2", b"3"):
        assert not loop.publish_scan({area: scan * BURST for area in areas}, {}, duration_s=1e-9)
    assert published == ["area1 1", "area2 2", "area3 3"]


@pytest.mark.parametrize("given", [(), ("tcp/192.0.2.7:1", "tcp/192.0.2.7:2")])
def test_a_plant_of_neighbours_calls_the_areas_where_they_listen_and_never_a_router(
    monkeypatch, tmp_path: Path, given: tuple[str, ...]
):
    called: list[tuple[str, ...]] = []
    monkeypatch.setattr(
        "coordinator.lab.plant.plant.run_plant", lambda scans, run, endpoints, *_: called.append(endpoints)
    )
    path = scenario_of_neighbours(tmp_path, 'listen = "tcp/127.0.0.1:7501"')
    connect = [part for endpoint in given for part in ("--connect", endpoint)]
    done = CliRunner().invoke(plant, [str(path), *connect], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert called == [given or tuple(f"tcp/127.0.0.1:{port}" for port in (7501, 7502, 7503))]


def test_a_plant_of_neighbours_on_free_ports_says_what_to_do(tmp_path: Path):
    with pytest.raises(InvalidInputError, match="give --connect once for each area"):
        CliRunner().invoke(plant, [str(scenario_of_neighbours(tmp_path))], catch_exceptions=False)


def scenario_of_neighbours(folder: Path, more: str = "") -> Path:
    path = folder / "near.toml"
    shipped = Path(__file__).parents[5] / "scenarios" / "shipped" / "ieee33.toml"
    path.write_text(f'{shipped.read_text()}\n[transport]\nkind = "neighbours"\n{more}\n')
    return path


@pytest.mark.parametrize("is_received", [False, True])
def test_a_plant_that_no_area_receives_says_so_once(caplog, is_received: bool):
    inbox = Inbox()
    guard = DuplicateGuard("plant", Incarnation(1, 1), 0.0, heartbeat_s=0.2)
    loop = PlantLoop(
        {"area1": lambda _: None}, inbox, heartbeat_s=0.2, guard=guard, bus=no_bus(), orders=OrderBook("plant", "run")
    )
    loop.no_area = NoAreaWarning(0.0, "of run near within 1 s", ["tcp/127.0.0.1:7501"])
    if is_received:
        key = live_key("near", "area", "area1", Incarnation(1, 1))
        inbox.put(key, key)
    for _ in range(2):
        loop.publish_scan({"area1": b"scan"}, {}, duration_s=0.01)
    warning = "no area of run near within 1 s has shown itself; looking on at tcp/127.0.0.1:7501"
    assert caplog.messages == ([] if is_received else [warning])


def test_a_scan_that_was_made_elsewhere_is_published_as_the_plant_would_make_it():
    scenario, incarnation = load_scenario("industrial13"), Incarnation(1, 0)
    own, made = OwnScans(scenario, many=False), MadeScan.of(scenario, make_telemetry(scenario))
    for scans in (own, made):
        assert scans.heartbeat_s == scenario.run.beat_s
        assert scans.late_s(1) == find_lateness(scenario, 1)
    contents = [
        {
            area: replace(decode(payload), header=None, times=())
            for area, payload in scans.payloads("run", incarnation, 1).items()
        }  # type: ignore[arg-type, type-var]
        for scans in (own, made)
    ]
    assert contents[0] == contents[1]
