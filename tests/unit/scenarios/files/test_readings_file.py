"""Readings files: engineering units become per unit; every mistake is rejected with its line; the truth is unknown."""

from __future__ import annotations

import csv
import io
import math
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pytest

from coordinator.lab.evaluation.scan_estimates import estimate_whole_grid, load_scans_of, with_one_scan
from coordinator.watch.tables import write_tables
from dsse_core.errors import InvalidInputError
from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.columns import Records
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.grid.measurement_model import build_measurement_model
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from dsse_core.results.results import results_of_estimate
from scenarios.check import check_scenario
from scenarios.files.network_file import load_case
from scenarios.files.readings.columns import read_sound_columns
from scenarios.files.readings.file import load_readings, read_scans, save_readings
from scenarios.files.readings.rows import ReadingRows
from scenarios.scenario import Scenario, load_scenario
from scenarios.telemetry import make_telemetry, read_meters

KIND = MeasurementKind
NETWORK = load_case("ieee33")
UNITS = ("pu", "kv", "deg", "mw", "mvar", "a")
HEADER = ",".join(["meter", *(f"{column}_{unit}" for unit in UNITS for column in ("value", "sigma"))])
SCENARIO = """
version = 1
description = "real readings"
network = "ieee33"
strategy = "information"
areas = { count = 2 }

[telemetry]
source = "file"
file = "readings.csv"
"""


def load(tmp_path: Path, text: str) -> Sequence[Measurement]:
    path = tmp_path / "readings.csv"
    path.write_text(text, encoding="utf-8")
    return load_readings(path, NETWORK)


def problems_of(tmp_path: Path, text: str) -> tuple[str, ...]:
    with pytest.raises(InvalidInputError) as caught:
        load(tmp_path, text)
    assert "readings.csv" in caught.value.what
    return caught.value.problems


def all_readings() -> tuple[Measurement, ...]:
    """What the meters of the shipped scenario read."""
    return tuple(m for m in make_telemetry(load_scenario("ieee33")).union if m.meter.source is not Source.VIRTUAL)


def scenario_with(tmp_path: Path, readings: tuple[Measurement, ...], more: str = "") -> Scenario:
    save_readings(tmp_path / "readings.csv", NETWORK, readings)
    (tmp_path / "real.toml").write_text(SCENARIO + more, encoding="utf-8")
    return load_scenario(tmp_path / "real.toml", strategies=("information",))


EVERY_UNIT = f"""{HEADER}
vm@1,1.01,0.002,,,,,,,,,,
vm@2,,,12.8,0.01,,,,,,,,
va@3,,,,,-0.5,0.1,,,,,,
p_flow@3:3-4,,,,,,,2.2,0.02,,,,
q_flow@4:3-4,,,,,,,,,-0.3,0.02,,
q_injection@5,0.01,0.002,,,,,,,,,,
current@3:3-4,,,,,,,,,,,120,1
"""


QUOTED = "\n".join(",".join(f'"{cell}"' if cell else "" for cell in row.split(",")) for row in EVERY_UNIT.splitlines())


@pytest.mark.parametrize(
    "text",
    [
        EVERY_UNIT,
        EVERY_UNIT.removesuffix("\n"),
        EVERY_UNIT.replace("\n", "\r\n"),
        EVERY_UNIT.replace("\n", "\r"),
        EVERY_UNIT + "\n\n",
        EVERY_UNIT.replace(",120,1", ", +1.2e2,1."),
        QUOTED,
    ],
)
def test_columns_are_read_as_rows_are(text: str) -> None:
    rows = csv.reader(io.StringIO(text, newline=""), strict=True)
    table = ReadingRows(NETWORK)
    table.take_header(next(rows))
    for row in rows:
        table.take(row, rows.line_num)
    assert not table.problems
    sound = read_sound_columns(text, NETWORK)
    assert sound is not None
    assert sound.readings == tuple(table.readings)


def test_no_object_is_made_of_a_sound_reading_before_the_estimate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_readings(tmp_path / "readings.csv", NETWORK, all_readings())
    scenario = load_scenario("ieee33", whole=True)

    def refuse(records: Records[object]) -> tuple[object, ...]:
        assert not len(records), "objects are made of columns"
        return ()

    with monkeypatch.context() as patch:
        patch.setattr(Records, "objects", property(refuse))
        scans = load_scans_of(scenario, tmp_path / "readings.csv")
        with_readings = with_one_scan(scenario, scans)
        meters = with_readings.meters
        build_measurement_model(with_readings.network, build_admittance(with_readings.network), meters)
        values, sigmas = (getattr(read_meters(with_readings), name) for name in ("values", "sigmas"))
    read = {m.meter: (m.value, m.sigma) for m in all_readings()}
    virtual = {m for m in meters if m.source is Source.VIRTUAL}
    found = {m: pair for m, *pair in zip(meters, values.tolist(), sigmas.tolist(), strict=True)}
    assert found.keys() == read.keys() | virtual
    for meter, pair in found.items():
        assert tuple(pair) == pytest.approx(read.get(meter, (0.0, 0.0)), rel=1e-12), meter.id


def test_no_call_is_made_for_a_row_of_a_sound_file(tmp_path: Path) -> None:
    def count_calls(n: int) -> int:
        save_readings(tmp_path / "readings.csv", NETWORK, all_readings()[:n])
        text, calls = (tmp_path / "readings.csv").read_text(), Counter[str]()
        read_sound_columns(text, NETWORK)  # what is found once of a network
        sys.setprofile(lambda _frame, event, _argument: calls.update([event]))
        try:
            sound = read_sound_columns(text, NETWORK)
        finally:
            sys.setprofile(None)
        assert sound is not None
        assert len(sound.values) == n
        return calls["call"]

    assert count_calls(len(all_readings())) < count_calls(20) + 20


def test_a_branch_is_found_by_a_name_with_separators_of_ids_and_letters_of_any_alphabet() -> None:
    odd = Branch("übergabe @3: a b", 1, 2, 0.1, 0.1)
    network = Network("odd", 1.0, (Bus(1, 1.0), Bus(2, 1.0)), (odd,), (Generator(1, Control.SLACK),))
    text = f"meter,value_pu,sigma_pu\np_flow@2:{odd.id},0.5,0.01\n"
    sound = read_sound_columns(text, network)
    assert sound is not None
    assert sound.readings == (Measurement(Meter(KIND.P_FLOW, 2, odd.id), 0.5, 0.01),)


def test_a_cell_with_a_comma_in_quotes_is_one_cell() -> None:
    text = 'meter,value_pu,sigma_pu\n"vm@1,1",0.01\n'
    assert read_sound_columns(text, NETWORK) is None


def test_another_spelling_of_a_meter_in_another_scan_is_the_same_meter() -> None:
    text = "meter,scan,value_pu,sigma_pu\nvm@2,a,1,0.01\nvm@1,a,1,0.01\nvm@02,b,1.1,0.01\n"
    sound = read_sound_columns(text, NETWORK, takes_scans=True)
    assert sound is not None
    assert [meter.id for meter in sound.meters] == ["vm@2", "vm@1"]
    assert (sound.column.tolist(), sound.scans) == ([0, 1, 0], ["a", "a", "b"])
    assert read_sound_columns(text.replace(",b,", ",a,"), NETWORK, takes_scans=True) is None


@pytest.mark.parametrize("name", ["vm@01", "vm@1:", "vm@\u0661"])
def test_another_spelling_of_a_meter_is_no_second_meter(tmp_path: Path, name: str) -> None:
    text = "meter,value_pu,sigma_pu\nvm@1,1,0.01\n"
    problems = problems_of(tmp_path, f"{text}{name},1,0.01\n")
    assert problems == ("line 3: meter vm@1 has a reading in line 2 already; keep one",)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("vm@2,,,12.8,", "vm@1,,,12.8,"),
        ("1.01,0.002", "1.01,"),
        ("1.01,0.002", ",0.002"),
        ("-0.5,0.1", "nan,0.1"),
        ("-0.5,0.1", "-0.5,0"),
        ("12.8,0.01", "-12.8,0.01"),
        ("2.2,0.02", "2.2e300,0.02"),
        ("0.01,0.002,,,,,,,,,,", ",,,,,,0.1,0.1,,,,"),
        ("0.01,0.002,,,,,,,,,,", "0.01,0.002,,,,,,,,,"),
        ("current@3:3-4", "current@9:3-4"),
        ("120,1", "12O,1"),
        ("meter,", "metre,"),
    ],
)
def test_a_mistake_is_not_read_as_columns(old: str, new: str) -> None:
    assert old in EVERY_UNIT
    assert read_sound_columns(EVERY_UNIT.replace(old, new, 1), NETWORK) is None


def test_every_unit_becomes_per_unit_and_radians(tmp_path: Path) -> None:
    read = {m.meter.id: (m.value, m.sigma) for m in load(tmp_path, EVERY_UNIT)}
    base = NETWORK.base_mva
    ampere = math.sqrt(3) * 12.66 / base / 1000
    expected = {
        "vm@1": (1.01, 0.002),
        "vm@2": (12.8 / 12.66, 0.01 / 12.66),
        "va@3": (math.radians(-0.5), math.radians(0.1)),
        "p_flow@3:3-4": (2.2 / base, 0.02 / base),
        "q_flow@4:3-4": (-0.3 / base, 0.02 / base),
        "q_injection@5": (0.01, 0.002),
        "current@3:3-4": (120 * ampere, ampere),
    }
    assert read.keys() == expected.keys()
    for meter, pair in expected.items():
        assert read[meter] == pytest.approx(pair), meter


def test_what_was_written_is_read_back(tmp_path: Path) -> None:
    extra = (Measurement(Meter(KIND.VA, 3), 0.01, 0.001), Measurement(Meter(KIND.CURRENT, 3, "3-4"), 0.2, 0.01))
    readings = all_readings() + extra
    save_readings(tmp_path / "readings.csv", NETWORK, readings)
    back = load_readings(tmp_path / "readings.csv", NETWORK)
    assert [m.meter for m in back] == [m.meter for m in readings]
    for ours, theirs in zip(back, readings, strict=True):
        assert (ours.value, ours.sigma) == pytest.approx((theirs.value, theirs.sigma), rel=1e-12)


@pytest.mark.parametrize(("unit", "other", "times"), [("kw", "mw", 1000), ("kvar", "mvar", 1000), ("v", "kv", 1000)])
def test_small_units_are_read_as_large_ones(tmp_path: Path, unit: str, other: str, times: float) -> None:
    meter = {"kw": "p_flow@3:3-4", "kvar": "q_injection@5", "v": "vm@2"}[unit]
    small = load(tmp_path, f"meter,value_{unit},sigma_{unit}\n{meter},{12.5 * times},{0.1 * times}\n")
    large = load(tmp_path, f"meter,value_{other},sigma_{other}\n{meter},12.5,0.1\n")
    assert (small[0].value, small[0].sigma) == pytest.approx((large[0].value, large[0].sigma), rel=1e-14)


def test_a_table_of_meters_is_read_back_without_virtual_and_silent_meters(tmp_path: Path) -> None:
    scenario = load_scenario("ieee33")
    silent = Meter(KIND.CURRENT, 2, "2-3")
    estimate, _ = estimate_whole_grid(scenario)
    write_tables(tmp_path, results_of_estimate(estimate, meters=[silent, *scenario.meters]))
    back = load_readings(tmp_path / "meters.csv", NETWORK)
    assert [m.meter for m in back] == [m.meter for m in all_readings()]
    for ours, theirs in zip(back, all_readings(), strict=True):
        assert (ours.value, ours.sigma) == pytest.approx((theirs.value, theirs.sigma), rel=1e-12)


def test_a_mistake_in_a_table_of_meters_has_its_line(tmp_path: Path) -> None:
    text = "meter,source,value_pu,sigma_pu\nvm@1,telemetered,,\nvm@99,telemetered,1,0.01\n"
    (problem,) = problems_of(tmp_path, text)
    assert problem.startswith("line 3:")
    assert "vm@99" in problem


def test_a_voltage_is_written_with_all_its_digits(tmp_path: Path) -> None:
    readings = tuple(m for m in all_readings() if m.meter.kind is KIND.VM)
    save_readings(tmp_path / "readings.csv", NETWORK, readings)
    assert load_readings(tmp_path / "readings.csv", NETWORK) == readings


def test_a_spreadsheets_mark_at_the_start_and_empty_lines_do_no_harm(tmp_path: Path) -> None:
    assert len(load(tmp_path, "\ufeffmeter,value_pu,sigma_pu\r\nvm@1,1,0.01\r\n,,\r\n\r\n")) == 1


def test_all_problems_are_named_at_once_with_their_lines(tmp_path: Path) -> None:
    text = """meter,value_pu,sigma_pu,value_mw,sigma_mw
vm@1,1.0,0.01,,
vm@99,1.0,0.01,,
p_flow@9:3-4,,,1,0.1
p_flow@8:21-8,,,1,0.1
volt@1,1.0,0.01,,
vm@2,,,1,0.1
p_injection@5,1,0.1,1,0.1
p_injection@6,,,,
p_injection@7,,,"1,5",0.1
p_injection@8,,,nan,0.1
vm@3,1.0,0,,
vm@1,1.0,0.01,,
vm@4,-1.0,0.01,,
vm@5,1.0
"""
    problems = problems_of(tmp_path, text)
    for line, words in {
        3: "bus 99 is not in network",
        4: "branch 3-4 does not end at bus 9",
        5: "branch 21-8 is out of service",
        6: "'volt@1' is no meter id",
        7: "cannot be in mw; its columns are value_pu,sigma_pu or value_kv,sigma_kv",
        8: "fill exactly one pair of value and sigma, found 2",
        9: "fill exactly one pair of value and sigma, found 0",
        10: "must be finite numbers",
        11: "must be finite numbers",
        12: "sigma is 0 in p.u.",
        13: "has a reading in line 2 already",
        14: "the value is negative",
        15: "2 columns, but the header has 5",
    }.items():
        assert any(problem.startswith(f"line {line}: ") and words in problem for problem in problems), (line, problems)
    assert len(problems) == 13


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the first column must be 'meter', found an empty file"),
        ("meter;value_pu;sigma_pu\n", "separated by ';'"),
        ("meter\tvalue_pu\tsigma_pu\n", r"separated by '\t'"),
        ("\n\nmeter,value\nvm@1,1\n", "line 3: unknown column 'value'"),
        ("meter,value,sigma\nvm@1,1,1\n", "unknown column 'value'"),
        ("meter,value_pu\nvm@1,1\n", "come pairs value_UNIT,sigma_UNIT"),
        ("meter,sigma_pu,value_pu\nvm@1,1,1\n", "come pairs value_UNIT,sigma_UNIT"),
        ("meter,value_pu,sigma_pu,value_pu,sigma_pu\n", "each unit once"),
        ("meter,value_pu,sigma_pu\n", "there is no reading"),
        ('meter,value_pu,sigma_pu\n"vm@1,1,1\n', "not valid CSV"),
    ],
)
def test_a_wrong_header_or_an_empty_file_is_rejected(tmp_path: Path, text: str, words: str) -> None:
    assert words in "\n".join(problems_of(tmp_path, text))


@pytest.mark.parametrize("first", ["", "\n", "\r\n\n", "\n\n\n"])
def test_empty_lines_before_the_header_do_not_hide_what_is_wrong_below(tmp_path: Path, first: str) -> None:
    wrong = f"{first}meter,value_pu,sigma_pu\nvm@1,1,0.1\nvm@99,1,0.1\n"
    line = 3 + first.count("\n")
    assert problems_of(tmp_path, wrong) == (f"line {line}: meter vm@99: bus 99 is not in network 'ieee33'",)


def test_letters_of_another_encoding_are_named_with_their_line(tmp_path: Path) -> None:
    path = tmp_path / "readings.csv"
    path.write_bytes("meter,value_pu,sigma_pu\nvm@1,1,0.1\nvm@ü,1,0.1\n".encode("latin-1"))
    with pytest.raises(InvalidInputError, match=r"line 3: not UTF-8 text .*; save the file as UTF-8"):
        load_readings(path, NETWORK)


def test_a_scenario_takes_its_readings_from_the_file_and_knows_no_truth(tmp_path: Path) -> None:
    readings = all_readings()
    scenario = scenario_with(tmp_path, readings)
    check_scenario(scenario)
    telemetry = make_telemetry(scenario)
    assert telemetry.truth is None
    assert {m.meter.id: m.value for m in telemetry.union if m.meter.source is not Source.VIRTUAL} == pytest.approx(
        {m.meter.id: m.value for m in readings}
    )
    assert sum(len(of_area) for of_area in telemetry.by_area.values()) == len(telemetry.union)


def test_a_gross_error_falsifies_a_real_reading(tmp_path: Path) -> None:
    more = '[[telemetry.gross_error]]\nmeter = "vm@22"\nsigmas = 10\n'
    scenario = scenario_with(tmp_path, all_readings(), more)
    true = {m.meter.id: m for m in all_readings()}["vm@22"]
    read = {m.meter.id: m for m in make_telemetry(scenario).union}["vm@22"]
    assert read.value == pytest.approx(true.value + 10 * true.sigma)


def scenario_problems(tmp_path: Path, more: str, readings: tuple[Measurement, ...] | None = None) -> str:
    with pytest.raises(InvalidInputError) as caught:
        scenario_with(tmp_path, all_readings() if readings is None else readings, more)
    return "\n".join(caught.value.problems)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("noise = true", "noise has no meaning for source 'file'"),
        (
            '[measurements]\nvoltage = { buses = "all", sigma_pu = 0.1 }',
            "measurements.voltage: with telemetry.source 'file'",
        ),
        ("[measurements]\nzero_injection = [2, 2]", "measurements.zero_injection: bus 2 has a load or a source"),
        ("[measurements]\nzero_injection = [99]", "measurements.zero_injection: bus 99 is not in network"),
        ('[measurements]\nzero_injection = "all"', 'must be "virtual", "measured" or a list of bus numbers'),
    ],
)
def test_what_contradicts_real_readings_is_rejected(tmp_path: Path, more: str, words: str) -> None:
    assert words in scenario_problems(tmp_path, more)


def test_a_file_without_source_and_a_source_without_file_are_rejected(tmp_path: Path) -> None:
    text = SCENARIO.replace('file = "readings.csv"\n', "")
    (tmp_path / "real.toml").write_text(text, encoding="utf-8")
    with pytest.raises(InvalidInputError, match="source 'file' needs the path of the readings"):
        load_scenario(tmp_path / "real.toml", strategies=("information",))
    (tmp_path / "real.toml").write_text(SCENARIO.replace('source = "file"\n', ""), encoding="utf-8")
    with pytest.raises(InvalidInputError, match="file has no meaning for source 'network'"):
        load_scenario(tmp_path / "real.toml", strategies=("information",))


def test_problems_of_the_readings_are_those_of_the_scenario(tmp_path: Path) -> None:
    (tmp_path / "real.toml").write_text(SCENARIO, encoding="utf-8")
    with pytest.raises(InvalidInputError, match=r"telemetry.file: .*readings.csv: cannot be read"):
        load_scenario(tmp_path / "real.toml", strategies=("information",))


def test_a_reading_where_nothing_is_injected_is_rejected_or_the_bus_is_declared_measured(tmp_path: Path) -> None:
    industrial = SCENARIO.replace('"ieee33"', '"industrial13"')
    network = load_case("industrial13")
    save_readings(tmp_path / "readings.csv", network, [Measurement(Meter(KIND.P_INJECTION, 2), 0.0, 0.01)])
    (tmp_path / "real.toml").write_text(industrial, encoding="utf-8")
    with pytest.raises(InvalidInputError, match=r"p_injection@2 has a reading, but .* bus 2 injects exactly nothing"):
        load_scenario(tmp_path / "real.toml", strategies=("information",))
    (tmp_path / "real.toml").write_text(industrial + "[measurements]\nzero_injection = [6, 7]\n", encoding="utf-8")
    meters = load_scenario(tmp_path / "real.toml", strategies=("information",)).meters
    assert {m.bus for m in meters if m.source is Source.VIRTUAL} == {6, 7}


@pytest.mark.parametrize("row", ["vm@1,1e308,0.01", "vm@1,11,0.01", "p_flow@3:3-4,1e308,0.01", "current@3:3-4,1e12,1"])
def test_a_reading_that_no_grid_has_is_rejected_with_its_range(tmp_path: Path, row: str):
    path = tmp_path / "readings.csv"
    path.write_text(f"meter,value_pu,sigma_pu\n{row}\n")
    with pytest.raises(InvalidInputError, match=r"line 2: meter .*: the value is .* it must lie between"):
        load_readings(path, NETWORK)


def test_a_dead_voltmeter_is_no_mistake_of_the_file(tmp_path: Path):
    path = tmp_path / "readings.csv"
    path.write_text("meter,value_pu,sigma_pu\nvm@1,0,0.01\n")
    assert load_readings(path, NETWORK)[0].value == 0.0


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("meter,time,value_pu,sigma_pu", "unknown column 'time'; allowed: meter, scan, value_pu"),
        ("scan,meter,value_pu,sigma_pu", "the first column must be 'meter', found 'scan'"),
        ("meter,value_pu,sigma_pu,scan", "after 'meter' and, of many scans, 'scan' come pairs"),
    ],
)
def test_a_header_of_many_scans_in_another_order_is_one_problem_that_says_where_scan_stands(header: str, words: str):
    with pytest.raises(InvalidInputError, match="1 problem") as caught:
        read_scans(f"{header}\nvm@1,a,1,0.01\n", "readings", NETWORK)
    assert words in str(caught.value)
