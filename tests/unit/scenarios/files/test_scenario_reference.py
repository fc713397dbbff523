"""docs/reference/scenario-files.md has every key of both file formats, with its default, and no other key."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from pydantic.fields import FieldInfo

from dsse_core.files import shared_tables
from dsse_core.files.strict_table import Table
from scenarios.files import fault_tables, network_tables, scenario_file

REFERENCE = Path(__file__).parents[4] / "docs" / "reference" / "scenario-files.md"

TABLE_OF_HEADING: dict[str, list[type[Table]]] = {
    "Scenario file": [scenario_file.ScenarioFile],
    "`[areas.NAME]`": [scenario_file.AreaTable],
    "`areas = { count = N }`": [scenario_file.CountTable],
    "`areas = { switches = [...] }`": [scenario_file.SwitchesTable],
    "`[measurements]`": [scenario_file.MeasurementsTable],
    "`measurements.voltage` and `measurements.injection`": [
        scenario_file.BusMeterTable,
        scenario_file.SigmaTable,
        scenario_file.IntervalTable,
    ],
    "`measurements.flow` and `measurements.current`": [scenario_file.BranchMeterTable],
    "`measurements.angle`": [scenario_file.AngleMeterTable],
    "`[telemetry]`": [scenario_file.TelemetryTable],
    "`[[telemetry.gross_error]]`": [scenario_file.GrossErrorTable],
    "`[gateways.NAME]`": [scenario_file.GatewayTable],
    "`[load_messages]`": [shared_tables.GenerationTable],
    "`[admm]`": [shared_tables.AdmmTable],
    "`[faults]`": [fault_tables.FaultsTable],
    "`faults.burst`": [fault_tables.BurstTable],
    "`[[faults.link]]`": [fault_tables.LinkTable],
    "`faults.link.load`": [fault_tables.LoadFaultTable],
    "`faults.link.lie`": [fault_tables.LieTable],
    "`[faults.load_error.NAME]`": [fault_tables.LoadErrorTable],
    "`[faults.telemetry]`": [fault_tables.TelemetryFaultsTable],
    "`[[faults.events]]`": [fault_tables.EventTable],
    "`[quality]`": [scenario_file.QualityTable],
    "`[tolerances]`": [scenario_file.TolerancesTable],
    "`[run]`": [scenario_file.RunTable],
    "`[transport]`": [scenario_file.TransportTable],
    "`[record]`": [scenario_file.RecordTable],
    "Network file": [network_tables.NetworkFile],
    "`[[bus]]`": [network_tables.BusTable, network_tables.BusColumns],
    "`[[branch]]`": [network_tables.BranchTable, network_tables.BranchColumns],
    "`[[source]]`": [network_tables.SourceTable],
}


def documented_defaults() -> dict[str, dict[str, str]]:
    """Heading -> key -> text of the default column."""
    defaults: dict[str, dict[str, str]] = {}
    heading = ""
    for line in REFERENCE.read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            heading = line.lstrip("#").strip()
        elif row := re.match(r"\| `(\w+)` \| .+? \| (.+?) \| .+ \|$", line):
            defaults.setdefault(heading, {})[row[1]] = row[2]
    return defaults


def default_text(field: FieldInfo) -> str | None:
    """The default column that a key must have; None for tables, whose text is free."""
    if field.is_required():
        return "required"
    if isinstance(field.default, Table) or field.default_factory is not None:
        return None
    if field.default is None:
        return "none"
    if isinstance(field.default, bool):
        return f"`{str(field.default).lower()}`"
    return f'`"{field.default}"`' if isinstance(field.default, str) else f"`{field.default}`"


def test_every_table_has_its_heading() -> None:
    tables = {
        value
        for module in (scenario_file, shared_tables, fault_tables, network_tables)
        for value in vars(module).values()
        if isinstance(value, type) and issubclass(value, Table) and value.__module__ == module.__name__
    }
    assert tables == {table for found in TABLE_OF_HEADING.values() for table in found}
    assert documented_defaults().keys() == TABLE_OF_HEADING.keys()


@pytest.mark.parametrize("heading", TABLE_OF_HEADING)
def test_every_key_stands_under_its_heading_with_its_default(heading: str) -> None:
    documented = documented_defaults()[heading]
    fields = {field.alias or name: field for name, field in TABLE_OF_HEADING[heading][0].model_fields.items()}
    assert documented.keys() == fields.keys()
    for key, field in fields.items():
        if (expected := default_text(field)) is not None:
            assert documented[key] == expected, key


@pytest.mark.parametrize("heading", ["`[[bus]]`", "`[[branch]]`"])
def test_lists_have_the_keys_of_tables(heading: str) -> None:
    keys = [[field.alias or name for name, field in table.model_fields.items()] for table in TABLE_OF_HEADING[heading]]
    assert keys[0] == keys[1]
