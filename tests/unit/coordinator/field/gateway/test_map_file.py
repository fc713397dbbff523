"""A map is checked as a whole: every problem at once, with its place and what to do."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from coordinator.field.gateway.maps.map_file import load_map
from coordinator.field.gateway.maps.points import physical_range, size_of
from dsse_core.errors import InvalidInputError
from dsse_core.grid.measurement import Meter, read_meter_id
from dsse_core.grid.physical_ranges import POWER
from scenarios.scenario import load_scenario

READING = '[[reading]]\naddress = "{}"\nmeter = "{}"\nunit = "{}"\n{}\n'


LIVE = ("noise = true", 'ticks = "gateway"\nleader = "n"\n[run]\nscan_s = 1.0')


def find_problems(path: Path) -> str:
    with pytest.raises(InvalidInputError) as raised:
        load_map(path)
    return str(raised.value)


def test_all_problems_of_a_map_are_named_at_once(write_map: Callable[..., Path]) -> None:
    text = find_problems(
        write_map(
            READING.format("a", "vm@1", "kW", ""),
            READING.format("a", "vm@16", "kV", ""),
            READING.format("b", "vm@16", "kV", ""),
            READING.format("c", "vm@17", "kV", ""),
            READING.format("d", "voltage@1", "kV", ""),
            READING.format("e", "vm@22", "kV", "highest = 1e9"),
            READING.format("f", "vm@30", "kV", "sigma = 1e-12"),
            READING.format("g", "vm@99", "kV", ""),
        )
    )
    for expected in (
        "reading[1]: unit is kW; meter vm@1 reads pu or kV or V",
        "reading[2]: address 'a' stands in reading[1] already",
        "reading[3]: meter 'vm@16' stands in reading[2] already",
        "reading[4]: meter vm@17 is none of the scenario's [measurements]",
        "reading[5]: meter: 'voltage@1' is no meter id",
        "reading[6]: highest is 1e+09 kV",
        "reading[7]: the least sigma is 1e-12 kV",
        "reading[8]: meter vm@99: bus 99 is not in network",
    ):
        assert expected in text


def test_a_wrong_key_hides_nothing_else_that_is_wrong(write_map: Callable[..., Path]) -> None:
    text = find_problems(
        write_map(
            READING.format("a", "vm@1", "kW", "sign = 2"),
            READING.format("b", "vm@1", "kV", "sigma = nan\nsigma_percent = 1.0\nfactor = 0.0"),
            '[[reading]]\nmeter = "voltage@1"\nunit = "kV"\ncolour = 3\n',
            '[[results]]\nkind = "nobody"\n',
            source='[source]\nkind = "csv"\n',
            head='name = "North"\nscenario = "edited.toml"\nrun = "A B"\nleast_interval_s = 100.0\nconect = []\n'
            'connect = ["tcp/127.0.0.1:1", "garbage"]\n',
        )
    )
    for expected in (
        "least_interval_s: must be less",
        "conect: unknown key",
        "connect[2]: 'garbage' is no endpoint",
        "name 'North': a name is of a-z",
        "run: 'A B' may only contain",
        "source.path: missing",
        "results[1].kind: unknown kind 'nobody'",
        "reading[1].sign: must be 1 or -1",
        "reading[1]: unit is kW",
        "reading[2].sigma: must be a finite number",
        "reading[2]: factor is 0",
        "reading[2]: meter 'vm@1' stands in reading[1] already",
        "reading[3].address: missing",
        "reading[3].colour: unknown key",
        "reading[3]: meter: 'voltage@1' is no meter id",
    ):
        assert expected in text
    assert "15 problems" in text, text
    assert "sigma_percent needs sigma" not in text


def test_without_a_scenario_everything_else_is_still_checked(write_map: Callable[..., Path]) -> None:
    twice = READING.format("a", "vm@1", "kV", ""), READING.format("a", "vm@16", "kV", "sigma = -1.0")
    text = find_problems(write_map(*twice, head='name = "router"\nscenario = "ieee34"\n'))
    for expected in (
        "'router' belongs to a process",
        "scenario: ",
        "reading[2].sigma",
        "address 'a' stands in reading[1] already",
    ):
        assert expected in text
    assert "4 problems" in text, text


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ("factor = 0.0", "factor is 0"),
        ("sigma_percent = 1.0", "sigma_percent needs sigma"),
        ("lowest = 3.0\nhighest = 1.0", "lowest must be smaller"),
        ("sign = 2", "reading[1].sign"),
        ("factr = 2.0", "did you mean 'factor'?"),
        ("sigma = nan", "finite"),
    ],
)
def test_a_reading_that_makes_no_sense_is_named(write_map: Callable[..., Path], more: str, expected: str) -> None:
    assert expected in find_problems(write_map(READING.format("a", "vm@1", "kV", more)))


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ('[source]\nkind = "iec"\n', "source.kind: unknown kind 'iec'; allowed: csv, jsonl, modbus, mqtt, opcua"),
        ("[source]\npath = 'x'\n", "source.kind: missing"),
        ('[source]\nkind = "csv"\n', "source.path: missing"),
        ('[source]\nkind = "csv"\npath = "x"\npoll = 1\n', "source.poll: unknown key"),
        ('[source]\nkind = "modbus"\nhost = "x"\n', "address 'a': TABLE:REGISTER:TYPE"),
        ('[source]\nkind = "opcua"\nurl = "opc.tcp://x"\n', "address 'a': the id of a node"),
        ('[source]\nkind = "opcua"\nurl = "http://x"\n', "source.url"),
    ],
)
def test_a_source_that_cannot_be_used_is_named(write_map: Callable[..., Path], source: str, expected: str) -> None:
    assert expected in find_problems(write_map(READING.format("a", "vm@1", "kV", ""), source=source))


@pytest.mark.parametrize(
    ("head", "expected"),
    [
        ('name = "North"\nscenario = "ieee33"\n', "choose another"),
        ('name = "router"\nscenario = "ieee33"\n', "belongs to a process of every run"),
        ('name = "north"\nscenario = "ieee34"\n', "scenario: "),
        ('name = "north"\nscenario = "ieee33"\nrun = "A B"\n', "run: "),
    ],
)
def test_a_wrong_name_is_named(write_map: Callable[..., Path], head: str, expected: str) -> None:
    assert expected in find_problems(write_map(READING.format("a", "vm@1", "kV", ""), head=head))


def test_a_map_with_neither_readings_nor_results_does_nothing(write_map: Callable[..., Path]) -> None:
    assert "neither" in find_problems(write_map(source=""))


@pytest.mark.parametrize(
    ("meter", "unit", "raw", "expected"),
    [
        ("vm@1", "V", 12660.0, 1.0),
        ("vm@1", "kV", 12.66, 1.0),
        ("vm@1", "pu", 1.02, 1.02),
        ("p_flow@1:1-2", "MW", 2.0, 0.2),
        ("p_flow@1:1-2", "kW", 2000.0, 0.2),
        ("p_flow@1:1-2", "W", 2e6, 0.2),
        ("q_flow@1:1-2", "kvar", 2000.0, 0.2),
        ("q_injection@5", "var", 2e6, 0.2),
        ("q_injection@5", "Mvar", 2.0, 0.2),
    ],
)
def test_one_quantity_in_any_unit_is_one_reading(
    write_map: Callable[..., Path], meter: str, unit: str, raw: float, expected: float
) -> None:
    point = load_map(write_map(READING.format("a", meter, unit, ""))).points["a"]
    assert point.value_of(raw) == pytest.approx(expected)


def test_sign_factor_and_offset_come_in_this_order(write_map: Callable[..., Path]) -> None:
    more = (
        "sign = -1\nfactor = 2.0\noffset = 100.0\nlowest = -2000.0\nhighest = 500.0\nsigma = 5.0\nsigma_percent = 2.0"
    )
    point = load_map(write_map(READING.format("a", "p_flow@1:1-2", "kW", more))).points["a"]
    value = point.value_of(400.0)
    assert value == pytest.approx(-900.0e-3 / 10)
    assert point.deviation.of(value) == pytest.approx(18.0e-3 / 10)
    assert point.deviation.of(0.0) == pytest.approx(5.0e-3 / 10)
    assert point.is_in_range(value)
    assert not point.is_in_range(point.value_of(1000.0))


def test_current_and_angle_have_their_units(edited_scenario: Callable[..., Path], tmp_path: Path) -> None:
    scenario = edited_scenario(
        "ieee33",
        LIVE,
        (
            'injection = { buses = "all", sigma_percent = 10.0 }     # P and Q\n',
            'injection = { buses = "all", sigma_percent = 10.0 }\n'
            'current = { branches = ["1-2"], sigma_percent = 1.0 }\n'
            "angle = { buses = [1], sigma_deg = 0.1 }\n",
        ),
    )
    path = tmp_path / "map.toml"
    path.write_text(
        f'name = "n"\nscenario = "./{scenario.name}"\n[source]\nkind = "jsonl"\n'
        + READING.format("i", "current@1:1-2", "A", "")
        + READING.format("a", "va@1", "rad", "")
    )
    points = load_map(path).points
    assert points["i"].value_of(100.0) == pytest.approx(100.0 * math.sqrt(3) * 12.66 / 1000 / 10)
    assert points["a"].value_of(0.1) == pytest.approx(0.1)
    path.write_text(path.read_text().replace('"rad"', '"deg"').replace('"A"', '"kA"'))
    points = load_map(path).points
    assert points["a"].value_of(180.0) == pytest.approx(math.pi)
    assert points["i"].value_of(0.1) == pytest.approx(100.0 * math.sqrt(3) * 12.66 / 1000 / 10)


def test_a_meter_of_another_gateway_is_rejected(edited_scenario: Callable[..., Path], write_map) -> None:
    own = '[gateways.north]\nareas = ["area1"]\nmeters = ["vm@*"]\n[gateways.south]\nareas = "all"\n'
    edited_scenario(
        "ieee33", ("noise = true", own), ('source = "network" ', 'source = "live"\nticks = "gateway"\nleader = "south"')
    )
    readings = READING.format("a", "vm@1", "kV", ""), READING.format("b", "p_flow@1:1-2", "kW", "")
    text = find_problems(write_map(*readings, is_edited=True))
    assert "reading[2]: meter p_flow@1:1-2 of area1 is not that of gateway 'north'" in text
    assert "1 problem" in text
    head = 'name = "south"\nscenario = "edited.toml"\n'
    assert "give run.scan_s there" in find_problems(write_map(*readings, head=head, is_edited=True))


@pytest.mark.parametrize("meter_id", ["p_injection@671.a", "p_flow@632:632-670", "p_flow@632:632-670.b"])
def test_a_meter_of_a_phase_or_of_a_total_reads_as_many_mw_as_any_other(meter_id: str) -> None:
    network, meter = load_scenario("ieee13").network, read_meter_id(meter_id)
    assert isinstance(meter, Meter)
    limits = [limit / size_of("MW", meter, network) for limit in physical_range(meter, network)]
    assert limits == pytest.approx([POWER.least, POWER.most])
