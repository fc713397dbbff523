"""Feeders of OpenDSS in areas: their estimate, their way to it, and what they find of meters are the centre's."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.grid.division import build_partition
from dsse_core.grid.measurement import Measurement
from dsse_core.grid.network import Network
from dsse_core.grid.partition import Partition
from tests.support.centre import assert_goes_the_centres_way, assert_is_the_centres
from tests.support.ieee_feeders import load_feeder
from tests.support.ieee_feeders.placing import cut_at, place_meters
from tests.support.levels import further, many_more, some_further
from tests.support.phases import coupled_line, run_rounds

SIGMA = {None: 1e-6, 1.0: 1e-6, 4.0: 2e-5}  # relative, of sigmas over decades
LEAST = 1e-9  # p.u. and rad, of sigmas: those beside a stiff source are as small as 4e-7
SOME_123 = (13, 18, 60, 67, 97, 36, 54)
MANY_123 = (*SOME_123, 23, 25, 44, 47, 57, 72, 76, 81, 87, 105, 108)
BELOW_THE_SUBSTATION = (1000, 633, 680, 611, 684)  # the head has the source and the line to the bank's delta winding


@dataclass(frozen=True)
class Case:
    """A feeder, the buses below which areas begin, and its meters."""

    name: str
    buses: tuple[int, ...]
    is_rich: bool
    decades: float | None

    def __str__(self) -> str:
        cut = self.buses[0] if len(self.buses) == 1 else f"{len(self.buses) + 1} areas"
        return f"{self.name} {cut} {'rich' if self.is_rich else 'sparse'} {self.decades}"

    def divide(self) -> tuple[Network, Partition]:
        network = load_feeder(self.name)
        return network, build_partition(network, cut_at(network, self.buses))

    def read(self, network: Network) -> list[Measurement]:
        return place_meters(network, 1, self.decades, is_rich=self.is_rich)


FEW = [
    Case("ieee13", (632, 671, 645, 684, 670, 633), False, None),
    Case("ieee37", (702, 710, 709), True, 1.0),
    Case("4bus-yd", (2,), False, 4.0),
    Case("ieee13", BELOW_THE_SUBSTATION, False, 1.0),
]
CUTS: list[tuple[str, tuple[int, ...]]] = [
    ("ieee13", BELOW_THE_SUBSTATION),
    ("ieee13", (632, 671)), ("ieee13", (632, 671, 645, 684, 670, 633)), ("ieee34", (816, 824, 834, 832)),
    ("ieee37", (702, 710, 709)), ("ieee37", (702, 710, 709, 703, 707, 708, 733, 734, 711, 1799)),
    ("ieee37", (709, 799)), ("ieee123", SOME_123), ("ieee123", MANY_123),
    ("ieee123", (*MANY_123, 1, 8, 21, 28, 35, 40, 78, 101, 61, 15)),
    *((f"4bus-{name}", (bus,)) for name in ("dy", "yd", "grdyd", "yy", "oyod") for bus in (2, 3)),
]  # fmt: skip
METERS = [(is_rich, decades) for is_rich in (True, False) for decades in (None, 1.0, 4.0)]
ALL = [Case(*cut, *meters) for cut in CUTS for meters in METERS]
ALL.remove(Case("ieee34", (816, 824, 834, 832), True, 4.0))  # its current magnitudes lead the centre to no estimate


@pytest.mark.parametrize("case", [*FEW, *some_further([case for case in ALL if case not in FEW], 5)], ids=str)
def test_areas_of_a_feeder_go_the_centres_way_to_its_estimate(case: Case) -> None:
    """Cut in lines, at buses of delta loads and of no ground, and on either side of banks."""
    network, partition = case.divide()
    assert_goes_the_centres_way(partition, case.read(network), SIGMA[case.decades], LEAST)


@pytest.mark.thorough
def test_nineteen_in_twenty_states_on_the_way_are_the_centres_to_1e_9() -> None:
    """Beside delta windings others differ by up to 6e-8 before an estimate that is the same to 1e-9."""
    found = []
    for case in ALL:
        network, partition = case.divide()
        gaps = np.array(assert_goes_the_centres_way(partition, case.read(network), SIGMA[case.decades], LEAST))
        assert case.name in ("ieee37", "4bus-oyod") or (gaps < 1e-9).all()
        found += (gaps < 1e-9).tolist()
    assert np.mean(found) > 0.95


@pytest.mark.parametrize("is_rich", [False, *further(True)])
def test_two_areas_share_two_buses_of_a_closed_ring(is_rich: bool) -> None:
    whole = load_feeder("ieee123")
    network = replace(whole, branches=(*whole.branches, coupled_line("tie", (151, 300), "abc", 0.2)))
    beyond = cut_at(whole, (101,))["at101"]
    rest = {*network.row} - {*beyond} | {101}
    partition = build_partition(network, {"rest": sorted(rest), "ring": [*beyond, 151]})
    assert partition.area("ring").not_owned == (101, 151)
    assert_goes_the_centres_way(partition, place_meters(network, 3, 1.0, is_rich=is_rich))


@pytest.mark.parametrize("seed", [1, *further(*range(2, 7)), *many_more(*range(7, 51))])
@pytest.mark.parametrize("cut", [("ieee13", (632, 671, 645, 684, 670, 633)), *further(("ieee123", SOME_123))])
def test_areas_remove_the_readings_that_the_centre_removes(cut: tuple[str, tuple[int, ...]], seed: int) -> None:
    """Two gross errors, of 25 standard deviations."""
    network, partition = Case(*cut, is_rich=True, decades=None).divide()
    readings, rng = place_meters(network, seed, None, is_rich=seed % 3 > 0), np.random.default_rng(seed)
    real = [k for k, reading in enumerate(readings) if reading.sigma > 0]
    for k in rng.choice(real, 2, replace=False).tolist():
        wrong = readings[k].value + 25 * readings[k].sigma * float(rng.choice([-1.0, 1.0]))
        readings[k] = replace(readings[k], value=wrong)
    report = process_bad_data(network, readings)
    assert_is_the_centres(run_rounds(partition, readings), partition, report, 1e-6, LEAST)
