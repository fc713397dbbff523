"""A network with phases in a real browser: buses are counted as buses, and every number has its phase."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest

from tests.support.browser import browsing, find_chromium, keep_picture, open_play, serve
from tests.support.system_by_hand import SystemByHand
from tests.support.waiting import wait_until

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("page by phase")]
COLOURS_OF_PROFILE = """() => {
  const wanted = ["a", "b", "c"].map(phase => {
    const probe = document.createElement("span");
    probe.style.color = `var(--phase-${phase})`;
    document.body.append(probe);
    const found = getComputedStyle(probe).color.match(/\\d+/g).map(Number);
    probe.remove();
    return found;
  });
  const canvas = document.querySelector("#profile canvas"), { width, height } = canvas;
  const { data } = canvas.getContext("2d").getImageData(0, 0, width, height);
  return wanted.map(ink => {
    const columns = new Set();
    for (let k = 0; k < data.length; k += 4) {
      const isInk = data[k + 3] > 60 && ink.every((part, n) => Math.abs(data[k + n] - part) < 25);
      if (isInk) columns.add((k / 4) % width);
    }
    return columns.size / width;
  });
}"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    find_chromium()
    with SystemByHand(tmp_path_factory.mktemp("page")) as system, browsing() as opened:
        open_play(opened, serve(system, "ieee13", "--simulate"))
        yield opened


def table_of(page: Any, table: str) -> dict[str, list[str]]:
    """First cell -> the other cells of each row."""
    rows = page.eval_on_selector_all(
        f"#{table} tbody tr", "rows => rows.map(r => [...r.cells].map(c => c.textContent))"
    )
    return {first: rest for first, *rest in rows}


def facts_of(page: Any) -> dict[str, str]:
    """What is said of the selected, at one moment."""
    texts = page.locator("#facts > *").all_text_contents()
    return dict(zip(texts[::2], texts[1::2], strict=True))


def choose(page: Any, what: str) -> None:
    page.fill("#what", what)
    page.keyboard.press("Enter")
    wait_until(lambda: "phases" in facts_of(page) and what in facts_of(page).values())


def test_buses_are_counted_as_buses_and_every_number_has_its_phase(page: Any):
    tiles = page.locator("#glance").text_content()
    assert "All 41 phases of 16 buses within 0.9 to 1.1 p.u." in tiles
    assert re.search(r"652\.a: 0\.9\d+", tiles)
    assert re.search(r"675: unbalance \d\.\d %", tiles)
    assert "generation" not in tiles  # what loads leave over after rounding
    assert "with 16 buses" in page.locator("#drawing").get_attribute("aria-label")
    assert page.locator("#legend .of-phases").is_visible()
    choose(page, "671")
    shown = table_of(page, "by-phase")
    assert page.locator("#by-phase th").all_text_contents() == ["", "■ a", "● b", "▲ c", "all"]
    assert all(re.fullmatch(r"\d\.\d{4}", cell) for cell in shown["voltage (p.u.)"][:3])
    p_kw = [float(cell) for cell in shown["injected active power (kW)"]]
    assert sum(p_kw[:3]) == pytest.approx(p_kw[3], abs=0.2)
    assert 0 < float(facts_of(page)["unbalance (%)"]) < 5
    wait_until(lambda: {row[0] for row in table_of(page, "meters-there").values()} == {"a", "b", "c"})
    keep_picture(page, "page-phases")


def test_a_bus_of_two_phases_has_two_columns_and_a_branch_names_its_most_loaded_phase(page: Any):
    choose(page, "646")
    wait_until(lambda: page.locator("#by-phase th").all_text_contents() == ["", "● b", "▲ c", "all"])
    assert "unbalance (%)" not in facts_of(page)
    page.wait_for_selector("#past canvas")
    wait_until(lambda: page.locator("#past .phases").first.text_content() == "● b▲ c")
    choose(page, "632-670")
    facts = facts_of(page)
    currents = dict(zip("abc", map(float, table_of(page, "by-phase")["current (A)"][:3]), strict=True))
    assert facts["most loaded phase"] == f"a, {max(currents.values()):.1f} A"
    assert 0 < float(facts["neutral current (A)"]) < sum(currents.values())
    assert (facts["from"], facts["to"]) == ("632", "670")
    page.locator("#meters-there button", has_text="p_flow@632.b:632-670").click()
    wait_until(lambda: facts_of(page).get("phase") == "b")
    assert not page.locator("#by-phase").is_visible()


def test_the_profile_has_a_line_for_each_phase_and_meters_a_column(page: Any):
    assert page.locator("#profile-phases").text_content() == "■ a● b▲ c"
    wait_until(lambda: all(share > 0.3 for share in page.evaluate(COLOURS_OF_PROFILE)))
    headers = page.locator("#meters th").all_text_contents()
    assert headers[3] == "Phase"
    assert {cells[2] for cells in table_of(page, "meters").values()} == {
        "a",
        "b",
        "c",
        "bc",
    }  # bc: a load between two phases
