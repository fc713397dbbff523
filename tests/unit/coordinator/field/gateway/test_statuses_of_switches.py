"""Statuses of switches pass a gateway as readings of meters do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from coordinator.field.gateway.check import make_report
from coordinator.field.gateway.counts import Counts
from coordinator.field.gateway.intake import Intake
from coordinator.field.gateway.maps.map_file import load_map
from dsse_core.errors import InvalidInputError
from scenarios.files.shipped_files import find_shipped

READING = '[[reading]]\naddress = "{}"\nmeter = "status@{}"\nunit = "{}"\n{}\n'
GATEWAYS = """source = "live"
[gateways.north]
areas = "all"
meters = [{}]
[gateways.south]
areas = "all"
meters = ["*_*", "vm*"]
[run]
scan_s = 1"""


@pytest.fixture
def switched(tmp_path: Path, write_map: Callable[..., Path], edited_scenario: Callable[..., Path]) -> Callable:
    """A map of ``parts`` for ieee33 with the switch 7-8; ``patterns``: meters of the gateway."""

    def write(*parts: str, patterns: str = '"status@*"') -> Path:
        branch = "from = 7, to = 8, "
        network = find_shipped("cases")["ieee33"].read_text().replace(branch, branch + "switch = true, ")
        (tmp_path / "net.toml").write_text(network)
        noise = 'source = "network"                       # readings of one true grid\nnoise = true'
        edited_scenario("ieee33", ('network = "ieee33"', 'network = "./net.toml"'), (noise, GATEWAYS.format(patterns)))
        return write_map(*parts, is_edited=True)

    return write


def test_a_status_is_a_number_a_word_or_yes_and_no_and_belongs_to_the_area_of_its_switch(switched):
    content = load_map(switched(READING.format("S", "7-8", "status", "offset = -1")))
    intake = Intake(content.points, lambda: 2e9)
    for raw, time, value in ((2, 1, 1.0), (1.0, 2, 0.0), (True, 3, 0.0), (3, 4, 2.0)):
        intake("S", raw, 1e9 + time)
        assert intake.newest["area2"]["status@7-8"].value == value
    assert intake.counts.rejected == {}
    plain = Intake(load_map(switched(READING.format("S", "7-8", "status", ""))).points, lambda: 2e9)
    for raw, time, value in (("Closed", 1, 1.0), ("open", 2, 0.0), ("unknown", 3, -1.0), (True, 4, 1.0)):
        plain("S", raw, 1e9 + time)
        assert plain.newest["area2"]["status@7-8"].value == value
    plain("S", "ajar", 1e9 + 5)
    assert sum(found.count for found in plain.counts.rejected.values()) == 1
    report = make_report(content, intake.newest["area2"], {}, Counts(), "")
    assert "status@7-8" in report.text
    assert "status@7-8" not in report.remarks


def test_statuses_of_no_switch_of_other_gateways_or_with_keys_of_meters_are_refused(switched):
    with pytest.raises(InvalidInputError) as raised:
        load_map(switched(READING.format("S", "7-9", "status", ""), READING.format("T", "7-8", "kW", "sigma = 1.0")))
    text = str(raised.value)
    assert "reading[1]: meter status@7-9 is the status of no switch of the scenario; did you mean 'status@7-8'?" in text
    assert "reading[2]: unit is kW; status@7-8 is the status of a switch: give unit = 'status'" in text
    assert "reading[2]: sigma is of no use to status@7-8" in text
    with pytest.raises(InvalidInputError, match="meter status@7-8 of area2 is not that of gateway 'north'"):
        load_map(switched(READING.format("S", "7-8", "status", ""), patterns='"vm@1"'))
