"""Generated feeders: radial, the voltage as asked, the same for the same seed, sound scenarios with every cut."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dsse_core.errors import InvalidInputError
from dsse_core.grid.network import Control
from dsse_core.power_flow.newton_raphson import solve_power_flow
from scenarios.check import check_scenario
from scenarios.files import saved_network
from scenarios.files.network_file import load_network
from scenarios.generate.feeder import BUSES_OF_A_FEEDER, PV_SHARE, VM_TOLERANCE, generate_feeder
from scenarios.generate.generated_files import write_generated
from scenarios.scenario import load_scenario


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 120), st.integers(0, 10**6), st.floats(0.85, 1.0))
def test_a_feeder_is_a_tree_of_the_size_asked_for_with_the_lowest_voltage_asked_for(
    n_bus: int, seed: int, lowest_vm: float
) -> None:
    network, tree = generate_feeder(n_bus, rng(seed), lowest_vm=lowest_vm)
    assert len(network.buses) == n_bus
    assert len(network.branches) == n_bus - 1
    assert network.find_supply_problems() == []
    assert (tree.upstream[1:] < np.arange(1, n_bus)).all()
    assert abs(solve_power_flow(network).vm.min() - lowest_vm) < VM_TOLERANCE


def test_branches_leave_room_and_loads_leave_zero_injections() -> None:
    network, tree = generate_feeder(1000, rng())
    degree = Counter(bus for b in network.branches for bus in (b.from_bus, b.to_bus))
    assert max(degree.values()) == 4
    assert {0, 1, 2} <= set(tree.level.tolist())
    empty = sum(bus.p_load == 0 for bus in network.buses)
    assert 100 < empty < 200
    ratio = [b.r / b.x for b in network.branches]
    assert 0.5 < min(ratio) < 1.0 < 2.0 < max(ratio) < 2.5


def test_many_buses_make_several_feeders_at_one_busbar() -> None:
    network, tree = generate_feeder(BUSES_OF_A_FEEDER + 2, rng())
    assert len(network.branches_at[1]) == 2
    assert Counter(tree.feeder[1:].tolist()) == {0: 1001, 1: 1000}


def test_pv_generators_stand_at_loads_and_produce_their_share_together() -> None:
    network, _ = generate_feeder(100, rng(), n_pv=7)
    pv = [g for g in network.generators if g.control is Control.POWER]
    assert len(pv) == 7
    assert all(network.bus(g.bus).p_load > 0 for g in pv)
    load = sum(bus.p_load for bus in network.buses)
    assert sum(g.p for g in pv) == pytest.approx(PV_SHARE * load, rel=1e-3)


def test_what_cannot_be_generated_is_rejected_with_all_reasons() -> None:
    with pytest.raises(InvalidInputError) as caught:
        generate_feeder(1, rng(), lowest_vm=1.2)
    assert [problem.split(";")[0] for problem in caught.value.problems] == [
        "1 buses make no feeder",
        "a lowest voltage of 1.2 p.u. is out of range",
    ]
    with pytest.raises(InvalidInputError, match="50 PV generators do not fit"):
        generate_feeder(33, rng(), n_pv=50)


def test_a_lowest_voltage_that_is_no_number_is_rejected() -> None:
    with pytest.raises(InvalidInputError, match="out of range"):
        generate_feeder(10, rng(), lowest_vm=float("nan"))


def test_the_same_arguments_write_the_same_files_to_the_byte(tmp_path: Path) -> None:
    for folder in ("one", "two"):
        write_generated(tmp_path / folder, 150, 7, n_area=6, n_pv=3, meters="sparse")
    write_generated(tmp_path / "other", 150, 8, n_area=6, n_pv=3, meters="sparse")
    for name in ("network.toml", "scenario.toml"):
        one, two, other = ((tmp_path / folder / name).read_bytes() for folder in ("one", "two", "other"))
        assert one == two != other


def test_a_large_network_is_written_as_json_and_read_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = load_scenario(write_generated(tmp_path / "small", 60, 7, n_area=3), strategies=["information"])
    monkeypatch.setattr(saved_network, "MOST_BUSES_IN_TOML", 59)
    large = load_scenario(write_generated(tmp_path / "large", 60, 7, n_area=3), strategies=["information"])
    assert not (tmp_path / "large" / "network.toml").exists()
    for one, two in zip(small.network.branches, large.network.branches, strict=True):
        assert (one.id, one.r, one.x) == (two.id, pytest.approx(two.r, rel=1e-14), pytest.approx(two.x, rel=1e-14))
    assert [area.name for area in small.partition.areas] == [area.name for area in large.partition.areas]


def test_broken_json_is_rejected_with_its_place(tmp_path: Path) -> None:
    path = tmp_path / "network.json"
    path.write_text('{"name": "x",}')
    with pytest.raises(InvalidInputError, match=r"not valid JSON: .*line 1 column"):
        load_network(path)


def test_all_areas_together_repeat_themselves_a_hundred_times_a_second_however_many_they_are(tmp_path: Path) -> None:
    write_generated(tmp_path, 1500, 7, n_area=500)
    assert load_scenario(tmp_path / "scenario.toml", strategies=["information"]).run.beat_s == 5.0


def test_meters_do_not_change_the_network(tmp_path: Path) -> None:
    write_generated(tmp_path / "many", 150, 7, n_area=6)
    write_generated(tmp_path / "few", 150, 7, n_area=6, meters="sparse")
    many, few = (load_scenario(tmp_path / f / "scenario.toml", strategies=["information"]) for f in ("many", "few"))
    assert many.network.branches == few.network.branches
    assert many.network.buses == few.network.buses
    assert len(many.meters) > len(few.meters) + 200


def test_more_areas_than_branches_are_rejected_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="5 areas are asked for, but 5 buses have 4 branches"):
        write_generated(tmp_path / "out", 5, 1, n_area=5)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(2, 150), st.integers(0, 10**6), st.sampled_from(["standard", "sparse"]), st.data())
def test_a_generated_scenario_is_sound_whatever_the_number_of_areas(
    tmp_path: Path, n_bus: int, seed: int, meters: str, data: st.DataObject
) -> None:
    n_area = data.draw(st.integers(1, n_bus - 1))
    path = write_generated(tmp_path, n_bus, seed, n_area=n_area, meters=meters)  # type: ignore[arg-type]
    scenario = load_scenario(path, strategies=["information"])
    check_scenario(scenario)
    assert len(scenario.partition.areas) == n_area
