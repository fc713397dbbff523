"""Maps of the 33-bus feeder for tests of the gateway."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from coordinator.field.gateway.maps.map_file import GatewayMap, load_map

VOLTAGE = """
[[reading]]
address = "U1"
meter = "vm@1"
unit = "kV"
sigma = 0.02
"""
POWER = """
[[reading]]
address = "P1"
meter = "p_flow@1:1-2"
unit = "kW"
"""
CSV = '[source]\nkind = "csv"\npath = "readings.csv"\n'


LIVE = (
    'source = "network"                       # readings of one true grid\nnoise = true',
    'source = "live"\n[run]\nscan_s = 0.5',
)


@pytest.fixture
def write_map(tmp_path: Path, edited_scenario: Callable[..., Path]) -> Callable[..., Path]:
    """Write a map of ieee33 with live readings: its ``source`` and more text."""

    def write(
        *parts: str,
        is_edited: bool = False,
        source: str = CSV,
        head: str = 'name = "north"\nscenario = "edited.toml"\n',
    ) -> Path:
        if not is_edited:
            edited_scenario("ieee33", LIVE)
        path = tmp_path / "map.toml"
        path.write_text("\n".join([head, source, *parts]))
        return path

    return write


@pytest.fixture
def two_meters(write_map: Callable[..., Path]) -> GatewayMap:
    """U1, vm@1 in kV, and P1, p_flow@1:1-2 in kW."""
    return load_map(write_map(VOLTAGE, POWER))
