"""``dsse gateway --check``: what looks wrong is named, and the exit code says so."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from coordinator.field.gateway import gateway as process
from scenarios.scenario import load_scenario
from scenarios.telemetry import read_meters
from tests.unit.coordinator.field.gateway.conftest import LIVE

READING = '[[reading]]\naddress = "{}"\nmeter = "{}"\nunit = "pu"\nsigma = {}\n'


@pytest.fixture
def scan() -> dict[str, tuple[float, float]]:
    """Meter id of ieee33 -> what it reads, and the standard deviation."""
    scenario = load_scenario("ieee33")
    read = read_meters(scenario)
    found = zip(scenario.meters, read.values.tolist(), read.sigmas.tolist(), strict=True)
    return {meter.id: (value, sigma) for meter, value, sigma in found}


@pytest.fixture
def values(scan: dict[str, tuple[float, float]]) -> dict[str, float]:
    """Meter id -> what it reads."""
    return {meter: value for meter, (value, _) in scan.items()}


@pytest.fixture
def check(write_map, tmp_path: Path, dsse, values, scan) -> Callable[..., tuple[int, str]]:
    """Check a map of all meters, whose file reads ``changed`` values: exit code and what is printed."""

    def run(changed: dict[str, float | str], *more: str, missing: str = "") -> tuple[int, str]:
        path = write_map(*(READING.format(meter, meter, sigma) for meter, (_, sigma) in scan.items()))
        rows = [(meter, value) for meter, value in (values | changed).items() if meter != missing]
        now = time.time()
        lines = ["time,address,value", *(f"{now},{meter},{value}" for meter, value in rows), *more]
        (tmp_path / "readings.csv").write_text("\n".join(lines) + "\n")
        code, out, _ = dsse("gateway", path, "--check", "--seconds", 1)
        return code, out

    return run


def test_right_readings_look_right(check: Callable[..., tuple[int, str]]) -> None:
    code, out = check({})
    assert "nothing looks wrong" in out
    assert code == 0


def test_everything_that_looks_wrong_is_named(check: Callable[..., tuple[int, str]], values: dict[str, float]) -> None:
    changed: dict[str, float | str] = {
        "p_flow@3:3-4": -values["p_flow@3:3-4"],
        "q_flow@7:7-8": 1000 * values["q_flow@7:7-8"],
        "vm@16": values["vm@16"] / 3**0.5,
        "vm@22": "nan",
    }
    code, out = check(changed, "1800000000,nowhere,1", missing="p_injection@5")
    rows = {line.split()[0]: line for line in out.splitlines() if line}
    assert "sign: the powers at bus 3 (P) and bus 4 (P) do not add up" in rows["p_flow@3:3-4"]
    assert "unit, 1000 times too large" in rows["q_flow@7:7-8"]
    assert "line to neutral" in rows["vm@16"]
    assert "nothing is read" in rows["vm@22"]
    assert "nothing is read" in rows["p_injection@5"]
    assert "wrong: not finite, 1 times: vm@22" in out
    assert "wrong: unknown address, 1 times: nowhere" in out
    assert "wrong: 5 of 134 meters" in out
    assert code == 1


def test_a_source_that_is_not_there_is_named(write_map, dsse) -> None:
    code, out, _ = dsse("gateway", write_map(READING.format("U1", "vm@1", 0.001)), "--check", "--seconds", 0.5)
    assert "the source cannot be read" in out
    assert "readings.csv" in out
    assert "not in this map: 133 meters of the scenario" in out
    assert code == 1


def test_a_check_needs_no_bus(write_map, dsse, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "join_bus", None)
    assert dsse("gateway", write_map(READING.format("U1", "vm@1", 0.001)), "--check", "--seconds", 0.1)[0] == 1


def test_readings_of_phases_are_judged_beside_the_schedule(
    write_map, edited_scenario: Callable[..., Path], tmp_path: Path, dsse
) -> None:
    edited_scenario("ieee13", LIVE)
    path = write_map(READING.format("U", "vm@671.b", 0.01), is_edited=True)
    for reading, code, remark in (
        (1.05, 0, ""),
        (1.82, 1, "unit or base voltage: 1.73 times the schedule; line to line"),
    ):
        (tmp_path / "readings.csv").write_text(f"time,address,value\n{time.time()},U,{reading}\n")
        found, out, _ = dsse("gateway", path, "--check", "--seconds", 1)
        assert "vm@671.b" in out
        assert remark in out
        assert found == code
