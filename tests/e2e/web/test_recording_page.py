"""A recording of real processes in a real browser: play, slider, the past of everything, and what it does not hold."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import pytest

from coordinator.show.web.playback.source import play_recording
from scenarios.scenario import load_scenario
from tests.support.browser import (
    browsing,
    cell_of,
    find_chromium,
    keep_picture,
    open_play,
    serve,
    show_moment,
    wait_for_moment,
)
from tests.support.system_by_hand import SystemByHand, agreeing_system
from tests.support.waiting import wait_until

pytestmark = pytest.mark.slow
AREAS_OF_ALL_MOMENTS = """async () => {
  const { times } = await (await fetch("/api/frames")).json(), found = [];
  for (const k of times.keys()) found.push((await (await fetch(`/api/frame/${k}`)).json()).view.areas);
  return found;
}"""


@pytest.fixture(autouse=True)
def _needs_a_browser() -> None:
    find_chromium()


def is_good(areas: dict[str, Any]) -> bool:
    """Whether both are, and have shown what they used."""
    return len(areas) == 2 and all(area["quality"] == "good" and area["worst_meter"] for area in areas.values())


def is_recorded(recording: Path, scan: int) -> bool:
    """Whether what is recorded up to now ends with both areas good at ``scan``."""
    newest = play_recording(recording, load_scenario("industrial13"), []).newest
    areas = json.loads(newest.payload)["view"]["areas"]
    return is_good(areas) and {area["scan"] for area in areas.values()} == {scan}


@pytest.fixture
def recording(dsse: Any, tmp_path: Path) -> Path:
    """Of industrial13 with scans one after the other, while area 2 dies and comes back; the last scan stays."""
    with agreeing_system(dsse, tmp_path) as (system, watcher, endpoint, _):
        assert system.end("plant") == 0
        system.start("plant", "plant", "industrial13", "--connect", endpoint, "--every", "0.5")
        system.start("recorder", "record", "industrial13", "--connect", endpoint, "--out", "rec")
        wait_until(lambda: "recording run industrial13" in system.read_log("recorder"))
        seen: set[int] = set()

        def see_scans(count: int) -> None:
            most = len(seen) + count
            watcher.wait_until(lambda: seen.update(s.header.scan for s in watcher.states.values()) or len(seen) >= most)

        see_scans(5)
        system.end("area2", signal.SIGKILL)
        watcher.wait_until(lambda: "area2" not in watcher.present)
        see_scans(3)
        system.start("area2", "agent", "areas/area2.toml")
        watcher.wait_until(lambda: "area2" in watcher.present)
        see_scans(5)
        assert system.end("plant") == 0
        last = max(seen)
        system.start("plant", "plant", "industrial13", "--connect", endpoint)
        watcher.wait_until(lambda: all(s.header.scan > last for s in watcher.states.values()))
        watcher.wait_for_consensus()
        scan = max(s.header.scan for s in watcher.states.values())
        wait_until(lambda: is_recorded(tmp_path / "rec", scan))
        assert system.end("recorder") == 0, system.read_log("recorder")
    return tmp_path / "rec"


def choose(page: Any, selector: str, fact: str) -> None:
    """Choose by keyboard what ``selector`` names; its ``fact`` and its past are shown then."""
    page.locator(selector).first.focus()
    page.keyboard.press("Enter")
    page.wait_for_selector(f"#facts >> text={fact}")
    page.wait_for_selector("#past canvas")


def find(page: Any, name: str, fact: str) -> None:
    """The same of what is asked for by its name."""
    page.fill("#what", name)
    page.keyboard.press("Enter")
    page.wait_for_selector(f"#facts >> text={fact}")
    page.wait_for_selector("#past canvas")


def mark_part(page: Any) -> None:
    """Mark a part of the left chart with the pointer; both charts show it then."""
    page.locator("#past canvas").first.scroll_into_view_if_needed()
    box = page.locator("#past .u-over").first.bounding_box()
    page.mouse.move(box["x"] + 0.2 * box["width"], box["y"] + 20)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.6 * box["width"], box["y"] + 20)
    page.mouse.up()
    wait_until(lambda: page.locator("#range").evaluate("range => range.selectedOptions[0].text") == "as marked")


def test_a_recording_is_played_and_the_past_of_everything_is_shown(tmp_path: Path, recording: Path):
    with SystemByHand(tmp_path) as system, browsing() as page:
        open_play(page, serve(system, "industrial13", "--recording", recording))
        moments = page.evaluate(AREAS_OF_ALL_MOMENTS)
        wait_for_moment(page, len(moments) - 1)
        assert "holds no messages between areas" in page.locator("#remarks").text_content()
        assert "no estimate" not in page.locator("#remarks").text_content()
        assert not page.locator("#messages-section").is_visible()
        slider = page.locator("#moment")
        assert int(slider.get_attribute("max")) == len(moments) - 1

        show_moment(page, max(k for k, areas in enumerate(moments) if is_good(areas)))
        assert page.locator("#areas .good").count() == 2
        assert page.locator("#meters tbody tr").count() > 5
        shown = page.locator("#meters tbody tr").first.locator("td").all_text_contents()
        assert "-" not in shown[3:7], shown  # reading, estimate, unit, residual
        find(page, "5", "voltage")
        page.get_by_label("Right stays").check()
        find(page, "1-2", "active power")
        assert page.locator("#past h3").all_text_contents() == ["branch 1-2", "bus 5"]  # two things side by side
        mark_part(page)
        page.select_option("#range", "all")
        page.get_by_label("Right stays").uncheck()
        choose(page, "#meters button", "normalised residual")
        choose(page, "#areas button", "degrees of freedom")
        keep_picture(page, "page-recording")

        slider.focus()
        page.keyboard.press("Home")
        wait_for_moment(page, 0)
        first = page.locator("#clock").text_content()
        page.locator("#play").focus()
        page.keyboard.press("Enter")
        wait_until(lambda: int(page.evaluate("document.body.dataset.moment")) >= 3)
        wait_until(lambda: page.locator("#clock").text_content() != first)
        page.keyboard.press("Enter")
        wait_until(lambda: page.locator("#play").get_attribute("aria-pressed") == "false")

        there = [areas.get("area2", {}).get("state") not in (None, "gone") for areas in moments]
        gone = there.index(False, there.index(True))
        show_moment(page, gone)
        said = page.locator("#events").text_content()
        assert said.index("area2 is gone") < said.index("area2 is there")  # newest first
        assert cell_of(page, "area2", "Why").startswith("is gone")  # what its last state lacked follows
        assert cell_of(page, "area2", "Quality") == "stale"
        show_moment(page, there.index(True, gone))
        said = page.locator("#events").text_content()
        assert said.index("area2 is there") < said.index("area2 is gone")
