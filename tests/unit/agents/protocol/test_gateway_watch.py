"""Evidence of scans adds up per gateway, and counts once for each measurement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from agents.protocol.gateway_watch import GatewayWatch
from agents.protocol.readings import Ages
from coordinator.lab.deployment.split import area_files
from dsse_core.exchange.gateway_mistakes import MISTAKES, THRESHOLD
from dsse_core.grid.measurement import Measurement
from scenarios.scenario import load_scenario

AREA = area_files(load_scenario("ieee33"), "run", ["tcp/127.0.0.1:7447"])[0]
METERS = [meter for meter in AREA.meters if meter.kind.of_power][:4]


@dataclass
class Read:
    """What ``GatewayWatch`` asks of readings."""

    senders: Mapping[str, Sequence[str]]
    ages: Ages
    measurements: Sequence[Measurement] = field(default_factory=lambda: [Measurement(m, 1.0, 0.1) for m in METERS])


class Evidence:
    """In place of the test: evidence of a wrong sign of gateway ``wrong``, in each scan the same."""

    def __init__(self, wrong: str, ratio: float, of: Mapping[str, Sequence[str]]) -> None:
        self.ratio, self._meters = ratio, set(of[wrong])

    def weigh(self, readings: object, meters: Any, x: object, received: object) -> dict[float, float]:
        return {factor: self.ratio if factor < 0 and self._meters & set(meters) else -5.0 for factor in MISTAKES}


def make_watch(ratio: float) -> tuple[GatewayWatch, Any]:
    senders = {"one": [m.id for m in METERS[:2]], "two": [m.id for m in METERS[2:]]}
    watch = GatewayWatch(AREA.area)
    watch._test = evidence = Evidence("two", ratio, senders)  # type: ignore[assignment]

    def count(scan: int, time: float | None = None, *, is_fed: bool = True) -> Mapping[str, str]:
        at = float(scan) if time is None else time
        read = Read(senders, Ages(at, {m.id: at for m in METERS}))
        watch.weigh(scan, AREA.area, read, None, is_fed=is_fed)  # type: ignore[arg-type]
        return watch.mistaken

    return watch, (count, evidence)


def test_a_gateway_is_named_when_the_evidence_of_scans_is_enough_until_it_speaks_against_it():
    _, (count, evidence) = make_watch(0.3 * THRESHOLD)
    assert [count(scan) for scan in range(1, 5)] == [{}, {}, {}, {"two": "sign"}]
    evidence.ratio = -THRESHOLD
    assert count(5) == {}


def test_a_scan_and_a_reading_count_once():
    _, (count, _) = make_watch(0.6 * THRESHOLD)
    assert [count(1), count(1), count(2, time=1.0), count(3, time=1.0)] == [{}, {}, {}, {}]
    assert count(4) == {"two": "sign"}


def test_the_last_end_of_a_scan_is_its_evidence():
    _, (count, evidence) = make_watch(2 * THRESHOLD)
    assert count(1) == {"two": "sign"}
    evidence.ratio = 0.3 * THRESHOLD  # a neighbour has learnt the status of a switch
    assert [count(1), count(2), count(3)] == [{}, {}, {}]
    assert count(4) == {"two": "sign"}


def test_no_evidence_is_left_in_an_area_without_supply():
    _, (count, _) = make_watch(0.6 * THRESHOLD)
    assert [count(1), count(2), count(3, is_fed=False), count(4)] == [{}, {"two": "sign"}, {}, {}]


def test_a_gateway_that_sends_no_more_is_forgotten():
    watch, (count, _) = make_watch(2 * THRESHOLD)
    assert count(1) == {"two": "sign"}
    watch.weigh(2, AREA.area, Read({"one": [METERS[0].id]}, Ages(2.0, {METERS[0].id: 2.0})), None)  # type: ignore[arg-type]
    assert watch.mistaken == {}
