"""A link between two areas that are both there is cut and restored: the page says so wherever one looks."""

from __future__ import annotations

import io
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.support.browser import browsing, cell_of, find_chromium, keep_picture, open_play, serve
from tests.support.system_by_hand import SystemByHand
from tests.support.tcp_fault_proxy import TcpFaultProxy
from tests.support.waiting import DEADLINE_S, wait_until

pytestmark = pytest.mark.slow
LONG_MS = DEADLINE_S * 1000
AMBER = 122, 79, 0  # --degraded of the light style sheet: the cross at a boundary, names of areas that are degraded


@pytest.fixture(autouse=True)
def _needs_a_browser() -> None:
    find_chromium()


@dataclass
class LinkedAreas:
    """The three areas of ieee33, linked directly; ``link``: what areas 1 and 2 say to each other passes it."""

    url: str
    link: TcpFaultProxy


@contextmanager
def linked_areas(dsse: Any, folder: Path) -> Iterator[LinkedAreas]:
    shipped = Path(__file__).parents[3] / "scenarios" / "shipped" / "ieee33.toml"
    scenario = folder / "ieee33.toml"
    scenario.write_text(shipped.read_text() + '\n[transport]\nkind = "neighbours"\n')
    assert dsse("split", scenario, "--out", "areas").returncode == 0
    files = (folder / "areas").iterdir()
    ends = {path.stem: tomllib.loads(path.read_text())["listen"][0] for path in files}
    everywhere = [word for end in ends.values() for word in ("--connect", end)]
    with TcpFaultProxy(int(ends["area1"].rpartition(":")[2])) as link, SystemByHand(folder) as system:
        system.start("area1", "agent", "areas/area1.toml")
        system.start("area2", "agent", "areas/area2.toml", "--connect", f"tcp/127.0.0.1:{link.port}")
        system.start("area3", "agent", "areas/area3.toml")
        system.start("plant", "plant", scenario, *everywhere)
        yield LinkedAreas(serve(system, scenario, "--direct", *everywhere), link)


def count_amber(page: Any) -> int:
    """Pixels of the drawing in the colour of warnings."""
    image = pytest.importorskip("PIL.Image")
    with image.open(io.BytesIO(page.locator("#drawing").screenshot())) as picture:
        colours = picture.convert("RGB").getcolors(maxcolors=picture.width * picture.height)
    return sum(n for n, colour in colours if colour == AMBER)


def test_a_link_that_is_cut_and_restored_shows_in_drawing_table_and_events(dsse: Any, tmp_path: Path):
    with linked_areas(dsse, tmp_path) as areas, browsing(color_scheme="light") as page:
        page.goto(areas.url)
        wait_until(lambda: page.locator("#areas .good").count() == 3)
        wait_until(lambda: cell_of(page, "area1", "Receives from") == "2 of 2")
        wait_until(lambda: count_amber(page) == 0)
        page.locator("#areas button", has_text="area1").focus()
        page.keyboard.press("Enter")

        areas.link.black_hole()
        page.wait_for_selector("#events >> text=area1 receives nothing from area2", timeout=LONG_MS)
        page.wait_for_selector("#events >> text=area2 receives nothing from area1", timeout=LONG_MS)
        wait_until(lambda: cell_of(page, "area1", "Receives from") == "1 of 2: nothing from area2")
        wait_until(lambda: cell_of(page, "area2", "Receives from") == "0 of 1: nothing from area1")
        page.wait_for_selector("#facts >> text=1 of 2: nothing from area2")
        wait_until(lambda: count_amber(page) > 0)
        wait_until(lambda: cell_of(page, "area1", "Quality") == "degraded")
        wait_until(lambda: "area2" in cell_of(page, "area1", "Why"))
        wait_until(lambda: cell_of(page, "area2", "Quality") != "good")
        wait_until(lambda: "area1" in cell_of(page, "area2", "Why"))
        drawing = page.locator("#drawing")
        wait_until(lambda: "nothing between area1 and area2" in drawing.get_attribute("aria-label"))
        keep_picture(page, "page-link-cut")

        areas.link.heal()
        page.wait_for_selector("#events >> text=area1 receives from area2 again", timeout=LONG_MS)
        page.wait_for_selector("#events >> text=area2 receives from area1 again", timeout=LONG_MS)
        wait_until(lambda: page.locator("#areas .good").count() == 3)
        wait_until(lambda: cell_of(page, "area1", "Receives from") == "2 of 2")
        wait_until(lambda: count_amber(page) == 0)


def test_a_lecture_sees_a_link_that_is_dead_from_the_begin_and_then_works(tmp_path: Path):
    with SystemByHand(tmp_path) as system, browsing() as page:
        open_play(page, serve(system, "ieee33-cut", "--simulate"))
        page.wait_for_selector("#events >> text=area1 receives from area2", timeout=LONG_MS)
        page.wait_for_selector("#events >> text=area1 receives nothing from area2", timeout=LONG_MS)
        said = page.locator("#events").text_content()
        assert said.index("area1 receives from area2") < said.index("area1 receives nothing from area2")  # newest first
