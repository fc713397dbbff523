"""What an import writes is a scenario that loads, and what it says is short."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter
from dsse_core.grid.network import Branch, Bus, Control, Generator, Network
from scenarios.check import check_scenario
from scenarios.importers import Imported, import_grid
from scenarios.importers.imported import Remark, combine_readings, open_end_shunt
from scenarios.importers.imported_files import write_imported
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry

STRATEGIES = ("information",)
KIND = MeasurementKind


def chain() -> Network:
    """Four buses in a row, load at the last two."""
    return Network(
        name="chain",
        base_mva=10.0,
        buses=(Bus(1, 20.0), Bus(2, 20.0), Bus(3, 20.0, p_load=0.1, q_load=0.02), Bus(4, 20.0, p_load=0.05)),
        branches=tuple(Branch(f"{i}-{i + 1}", i, i + 1, r=0.01, x=0.02, b=0.001, g=0.0001) for i in (1, 2, 3)),
        generators=(Generator(1, Control.SLACK, vm=1.01),),
    )


def test_a_source_without_measurements_becomes_a_scenario_with_made_up_meters(tmp_path: Path) -> None:
    path, summary = write_imported(tmp_path / "new", Imported(chain(), "a test", {"buses": 4}), 2)
    scenario = load_scenario(path, strategies=STRATEGIES)
    check_scenario(scenario)
    assert scenario.network.branch("2-3").g == pytest.approx(0.0001)
    assert len(scenario.partition.areas) == 2
    assert {m.kind for m in scenario.meters if m.bus == 1} >= {KIND.VM, KIND.P_FLOW, KIND.Q_INJECTION}
    assert summary.splitlines() == ["source     a test", "converted  4 buses"]
    assert (tmp_path / "new" / "import.txt").read_text(encoding="utf-8") == summary + "\n"


def test_a_network_is_cut_at_branches_by_id_or_name(tmp_path: Path) -> None:
    first, second, third = chain().branches
    named = replace(chain(), branches=(first, replace(second, name="line.tie"), third))
    path, _ = write_imported(tmp_path / "named", Imported(named, "a test", {}), ["Line.Tie", "3-4"])
    assert [*load_scenario(path, strategies=STRATEGIES).partition.listed.values()] == [(1, 2), (2, 3), (3, 4)]
    with pytest.raises(InvalidInputError, match="there is no branch"):
        write_imported(tmp_path / "none", Imported(named, "a test", {}), ["line.x"])


def test_measurements_of_the_source_become_the_readings_of_the_scenario(tmp_path: Path) -> None:
    readings = [Measurement(Meter(KIND.VM, 1), 1.01, 0.001)]
    for branch, p, q in (("1-2", 0.151, 0.021), ("2-3", 0.15, 0.02), ("3-4", 0.05, 0.0)):
        bus = int(branch[0])
        readings += [Measurement(Meter(KIND.P_FLOW, bus, branch), p, 0.01)]
        readings += [Measurement(Meter(KIND.Q_FLOW, bus, branch), q, 0.01)]
    readings += [Measurement(Meter(KIND.VA, 4), -0.01, 0.001), Measurement(Meter(KIND.CURRENT, 2, "1-2"), 0.15, 0.002)]
    imported = Imported(chain(), "a test", {}, readings=tuple(readings), zero_injection=(2,))
    path, _ = write_imported(tmp_path, imported, 1)
    scenario = load_scenario(path, strategies=STRATEGIES)
    check_scenario(scenario)
    telemetry = make_telemetry(scenario)
    assert telemetry.truth is None
    read = {m.meter.id: (m.value, m.sigma) for m in telemetry.union}
    for m in readings:
        assert read[m.meter.id] == pytest.approx((m.value, m.sigma), rel=1e-12)
    assert read["p_injection@2"] == (0.0, 0.0)
    assert len(read) == len(readings) + 2


def test_of_a_long_kind_of_remark_only_the_first_are_printed_and_all_are_written(tmp_path: Path) -> None:
    remarks = tuple(Remark("fused", f"bus {i}") for i in range(100))
    _, summary = write_imported(tmp_path, Imported(chain(), 'a "test"\n', {}, remarks), 1)
    assert len(summary.splitlines()) < 15
    assert summary.splitlines()[-1] == "fused      ... 92 more in import.txt"
    assert (tmp_path / "import.txt").read_text(encoding="utf-8").count("fused") == 100
    load_scenario(tmp_path / "scenario.toml", strategies=STRATEGIES)


def test_two_readings_of_one_quantity_weigh_in_by_their_variances() -> None:
    meter = Meter(KIND.VM, 1)
    readings = [Measurement(meter, 1.0, 0.01), Measurement(meter, 1.03, 0.02)]
    (combined,), (remark,) = combine_readings(readings)
    assert combined.value == pytest.approx((1.0 / 1 + 1.03 / 4) / (1 + 1 / 4))
    assert combined.sigma == pytest.approx(0.01 / (1 + 1 / 4) ** 0.5)
    assert "2 readings of vm@1" in remark.text


def test_an_open_end_draws_what_the_branch_draws_with_nothing_behind_it() -> None:
    branch = Branch("1-2", 1, 2, r=0.1, x=0.3, b=0.2, g=0.01, tap=0.95, shift=0.3)
    ys, half = 1 / (0.1 + 0.3j), (0.01 + 0.2j) / 2
    behind = half + 1 / (1 / ys + 1 / half)  # the near half of the shunt, and the far one through the series impedance
    assert open_end_shunt(branch, 2) == pytest.approx(behind)
    assert open_end_shunt(branch, 1) == pytest.approx(behind / 0.95**2)
    assert np.isclose(open_end_shunt(Branch("1-2", 1, 2, r=0.1, x=0.3), 1), 0)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("grid.xlsx", "", "the ending '.xlsx' is not known; .m, .dss and .json are"),
        ("grid.json", "{", "not JSON"),
        ("grid.json", '{"some": "thing"}', "neither a pandapower network"),
        ("grid.json", "[1, 2]", "neither a pandapower network"),
        ("grid.json", '{"is_batch": true, "type": "update", "data": []}', "type 'update', batch True; give input data"),
        ("grid.m", "", "mpc.bus, mpc.branch and mpc.gen are all missing"),
    ],
)
def test_a_file_of_no_known_format_is_rejected(tmp_path: Path, name: str, content: str, words: str) -> None:
    path = tmp_path / name
    path.write_text(content, encoding="utf-8")
    with pytest.raises(InvalidInputError, match="problem") as caught:
        import_grid(path)
    assert words in "\n".join(caught.value.problems)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"nowhere.m.*\n.*cannot be read"):
        import_grid(tmp_path / "nowhere.m")
