"""Each recorded number says how good and how old it was, and an injection is that of the bus."""

from __future__ import annotations

import math
from typing import Any

import pytest

from coordinator.watch.recording.recorded_tables import COLUMNS, RowMaker
from tests.support.recordings import AT, RUN, entry_of, load_areas_of, make_state


def rows_of(table: str, *states: Any) -> list[dict[str, Any]]:
    maker = RowMaker(RUN, load_areas_of())
    made = [row for k, state in enumerate(states) for row in maker.rows_of(entry_of(state, AT + k))]
    made += maker.finish()
    return [dict(zip(COLUMNS[table], row, strict=True)) for name, row in made if name == table]


@pytest.mark.parametrize("table", ["buses", "branches"])
@pytest.mark.parametrize(
    ("published", "expected"),
    [
        ([("degraded", 0.1), ("good", 0.3), ("stale", 9.0)], ("good", 0.3)),
        ([("degraded", 0.1), ("stale", 9.0)], ("stale", 9.0)),
        ([("stale", 9.0), ("good", 0.2)], ("good", 0.2)),
    ],
)
def test_rows_of_an_estimate_have_the_quality_that_stands_for_it(
    table: str, published: list[tuple[str, float]], expected: tuple[str, float]
) -> None:
    content = load_areas_of()[0]
    states = [
        make_state(content, sequence=1 + k, quality=quality, telemetry_age=age)
        for k, (quality, age) in enumerate(published)
    ]
    rows = rows_of(table, *states)
    assert {(row["quality"], row["value_age_s"]) for row in rows} == {expected}
    assert len(rows) == len(content.area.network.buses if table == "buses" else content.area.network.branches)


def test_an_injection_stands_in_the_rows_of_the_owner_and_elsewhere_its_reason() -> None:
    contents = load_areas_of()
    owner = contents[0].area
    n = len(owner.powers_into_children)
    found = {
        content.area.name: rows_of("buses", make_state(content, into_children=(0.25,) * n * (content is contents[0])))
        for content in contents
    }
    common = set(owner.boundary_buses)
    assert all(not math.isnan(row["p_kw"]) and row["injection_problem"] is None for row in found[owner.name])
    (row,) = (row for row in found[owner.name] if row["bus"] in common)
    assert row["p_kw"] == pytest.approx(2 * 0.25 * 1000 * owner.network.base_mva)  # at 1 p.u. its own branches carry 0
    (row,) = (row for row in found["area2"] if row["bus"] in common)
    assert math.isnan(row["p_kw"])
    assert row["injection_problem"] == f"{owner.name} owns this bus"
