"""The page in a real browser: a running system, an area that dies, playback, keyboard, hostile names."""

from __future__ import annotations

import io
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from agents.messages.keys import live_key, readings_key, state_key
from agents.messages.packing import Header, ReadingsMessage, StateMessage, encode
from agents.runtime.presence import begin_incarnation
from agents.transport.zenoh_bus import Session
from tests.support.browser import browsing, cell_of, find_chromium, keep_picture, open_play, serve, wait_for_moment
from tests.support.dsse_command import free_endpoint
from tests.support.levels import further
from tests.support.system_by_hand import SystemByHand, agreeing_system
from tests.support.waiting import DEADLINE_S, wait_until

pytestmark = pytest.mark.slow
LONG_MS = DEADLINE_S * 1000


@dataclass
class Shown:
    """A page that shows a running system."""

    system: SystemByHand
    url: str
    endpoint: str


@pytest.fixture(autouse=True)
def _needs_a_browser() -> None:
    find_chromium()


@pytest.fixture
def shown(dsse: Any, tmp_path: Path) -> Iterator[Shown]:
    with agreeing_system(dsse, tmp_path) as (system, _, endpoint, _):
        yield Shown(system, serve(system, "industrial13", "--connect", endpoint), endpoint)


def test_a_bus_is_selected_an_area_dies_and_comes_back(shown: Shown):
    with browsing() as page:
        page.goto(shown.url)
        wait_until(lambda: page.locator("#areas .good").count() == 2)
        wait_until(lambda: "2 good" in page.locator("#status").text_content())
        page.fill("#what", "3")
        page.keyboard.press("Enter")
        page.wait_for_selector("#facts >> text=voltage")
        wait_until(lambda: "shared with" in page.locator("#facts").text_content())
        page.wait_for_selector("#past canvas")
        keep_picture(page, "page-live")
        shown.system.end("area2", signal.SIGKILL)
        page.wait_for_selector("#cause.bad >> text=the agent of area2 is gone", timeout=LONG_MS)
        page.wait_for_selector("#areas >> text=is gone", timeout=LONG_MS)
        wait_until(lambda: cell_of(page, "area1", "Quality") == "degraded")
        page.wait_for_selector("#glance .bad >> text=2 of 2 not good")
        page.locator("#glance button", has_text="area2: stale").click()
        page.wait_for_selector("#facts >> text=is gone")
        page.wait_for_selector("#facts >> text=not fresh: the last ones")
        page.wait_for_selector("#glance >> text=known, within")
        page.wait_for_selector("#events >> text=area2 is gone", timeout=LONG_MS)
        page.locator("#alarms button", has_text="Acknowledge").first.click()
        page.reload()
        page.wait_for_selector("#alarms >> text=acknowledged", timeout=LONG_MS)  # this browser has kept it
        assert page.locator("#alarms button").count() == 0
        assert "Selected: the worst" in page.locator("#selected-title").text_content()
        page.wait_for_selector("#facts >> text=area2")
        with page.expect_download() as download:
            page.locator("#meters-csv").click()
        header, *rows = Path(download.value.path()).read_text().splitlines()
        assert {"meter", "reading", "unit", "fresh"} <= set(header.split(","))
        assert len(rows) > 5
        shown.system.start("area2", "agent", "areas/area2.toml")
        page.wait_for_selector("#cause.good >> text=Nothing is wrong", timeout=LONG_MS)
        wait_until(lambda: page.locator("#areas .good").count() == 2)
        wait_until(lambda: page.locator("#alarms li", has_text="area2 is gone").count() == 0)  # acknowledged, and over


def test_the_page_says_that_the_server_is_gone_and_goes_on_when_it_is_back(shown: Shown):
    port = shown.url.rstrip("/").rsplit(":", 1)[1]
    with browsing(may_complain=True) as page:
        page.goto(shown.url)
        page.wait_for_selector("#areas .good", timeout=LONG_MS)
        shown.system.end("page")
        page.wait_for_selector("#status.lost", timeout=LONG_MS)
        page.wait_for_selector("#status >> text=has sent nothing since", timeout=LONG_MS)
        shown.system.start(
            "page", "serve", "industrial13", "--connect", shown.endpoint, "--listen", f"127.0.0.1:{port}"
        )
        page.wait_for_selector("#status:not(.lost)", timeout=LONG_MS)
        wait_until(lambda: cell_of(page, "area1", "Quality") == "good")


def test_a_run_is_played_back_with_the_keyboard_alone(tmp_path: Path):
    with SystemByHand(tmp_path) as system, browsing() as page:
        open_play(page, serve(system, "ieee33-lossy", "--simulate"))
        page.wait_for_selector("#areas .good", timeout=LONG_MS)
        keep_picture(page, "page-playback")
        page.locator("#first").focus()
        page.keyboard.press("Enter")
        page.wait_for_selector("#areas .bad")
        wait_for_moment(page, 0)
        assert page.locator("#clock").text_content() == "0 s"
        for _ in range(3):
            page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.id") == "forward"
        page.keyboard.press("Enter")
        wait_until(lambda: page.locator("#clock").text_content() != "0 s")
        page.locator("#moment").focus()
        page.keyboard.press("End")
        page.wait_for_selector("#areas .good")
        page.keyboard.press("Home")
        page.wait_for_selector("#areas .bad")
        page.locator("#play").focus()
        page.keyboard.press("Enter")
        page.wait_for_selector("#messages tbody tr", timeout=LONG_MS)
        page.keyboard.press("Enter")
        wait_until(lambda: page.locator("#play").get_attribute("aria-pressed") == "false")
        page.locator("#areas button").first.focus()
        page.keyboard.press("Enter")
        page.wait_for_selector("#facts >> text=degrees of freedom")


@pytest.mark.parametrize("scheme", ["dark", *further("light")])
def test_assistive_technology_finds_its_way(tmp_path: Path, scheme: str):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright")
    with SystemByHand(tmp_path) as system, browsing(color_scheme=scheme) as page:
        open_play(page, serve(system, "ieee33-lossy", "--simulate"))
        page.wait_for_selector("#areas .good", timeout=LONG_MS)
        page.fill("#what", "99")
        page.keyboard.press("Enter")
        assert "There is no bus" in page.evaluate("document.querySelector('#what').validationMessage")
        page.fill("#what", "18")
        page.keyboard.press("Enter")
        page.wait_for_selector("#past canvas")
        keep_picture(page, f"page-{scheme}")
        found = axe.Axe().run(page).response["violations"]
        page.set_viewport_size({"width": 400, "height": 900})
        page.locator("#meters").scroll_into_view_if_needed()
        assert page.evaluate("document.documentElement.scrollWidth") <= 400
        card = page.locator("#meters tbody tr").first
        assert card.bounding_box()["width"] <= 400
        assert card.locator("td[data-title=Reading]").is_visible()
    assert [(v["id"], [node["target"] for node in v["nodes"]]) for v in found] == []


def count_colours(page: Any, selector: str) -> int:
    """How many colours a picture of an element has; one if nothing is painted there."""
    image = pytest.importorskip("PIL.Image")
    with image.open(io.BytesIO(page.locator(selector).screenshot())) as picture:
        return len(picture.convert("RGB").getcolors(maxcolors=picture.width * picture.height))


COUNT_DARK = """(() => {
  const print = document.querySelector("#print");
  const { data } = print.getContext("2d").getImageData(0, 0, print.width, print.height);
  let dark = 0;
  for (let k = 0; k < data.length; k += 4) dark += data[k + 3] > 200 && data[k] + data[k + 1] + data[k + 2] < 240;
  return dark;
})()"""


COUNT_BRIGHT = """(() => {
  const chart = document.querySelector("#profile canvas");
  const { data } = chart.getContext("2d").getImageData(0, 0, chart.width, chart.height);
  let bright = 0;
  for (let k = 0; k < data.length; k += 4) bright += data[k + 3] > 200 && data[k] + data[k + 1] + data[k + 2] > 640;
  return bright;
})()"""


def test_the_feeder_is_painted_on_a_thread_of_its_own_and_on_paper_in_light_colours(tmp_path: Path):
    with SystemByHand(tmp_path) as system, browsing(color_scheme="dark") as page:
        open_play(page, serve(system, "ieee33-lossy", "--simulate"))
        page.wait_for_selector("#areas .good", timeout=LONG_MS)
        wait_until(lambda: count_colours(page, "#drawing") > 50)
        assert len(page.workers) == 1
        with pytest.raises(Exception, match=r"transferred|offscreen"):
            page.evaluate("document.querySelector('#drawing').getContext('2d').fillRect(0, 0, 1, 1)")
        dark = page.evaluate("getComputedStyle(document.body).backgroundColor")
        page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
        assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
        wait_until(lambda: page.evaluate(COUNT_DARK) > 100)  # names of buses and rings, dark on white
        page.evaluate("window.dispatchEvent(new Event('afterprint'))")
        assert page.evaluate("getComputedStyle(document.body).backgroundColor") == dark
        page.emulate_media(color_scheme="light")
        wait_until(lambda: page.evaluate(COUNT_BRIGHT) == 0)
        page.emulate_media(color_scheme="dark")
        wait_until(lambda: page.evaluate(COUNT_BRIGHT) > 100)  # names of the axes
        page.emulate_media(media="print")
        assert page.locator("#print").is_visible()
        assert not page.locator("#drawing").is_visible()


MARKUP = "<img src=x onerror=\"document.title='owned'\"><script>document.title='owned'</script>"
NAMED = "<img src=x onerror=document.title='owned'>"  # as a name in a key can be
REPORT = "addEventListener('securitypolicyviolation', event => console.error('policy: ' + event.violatedDirective))"


def hostile(area: str, sequence: int) -> tuple[StateMessage, ReadingsMessage]:
    """A state and readings with markup wherever there is text."""
    header, ones = Header("run", area, begin_incarnation(), sequence, 1, 0.0), (1.0, 1.0)
    texts = dict.fromkeys(("removed", "critical", "old_sides", "meters_off"), (MARKUP,))
    counts = {key: {MARKUP: 1, NAMED: 1} for key in ("rejected", "faults", "scans")}
    pairs = {key: {"area1": (1, 1), NAMED: (1, 1)} for key in ("sent", "received")}
    numbers = {key: {MARKUP: 1.0, NAMED: 1.0} for key in ("ages", "clock_skews")}
    state = StateMessage(
        header=header,
        buses=(1, 2),
        **dict.fromkeys(("vm", "va", "sigma_vm", "sigma_va"), ones),
        **{**texts, **counts, **pairs, **numbers},
        **{"referenced": False, "objective": 0.0, "degrees_of_freedom": 0, "checked": False},
        **{"messages": 0, "bytes": 0, "lost": 0, "notes": (MARKUP,) * 3, "telemetry_age": 0.0},
        quality=MARKUP if sequence % 2 else "good",
    )
    values: dict[str, Any] = dict.fromkeys(("values", "sigmas", "times", "estimates", "normalised"), ones)
    return state, ReadingsMessage(header=header, taken_at=0.0, meters=(MARKUP, NAMED), **values)


def test_what_strangers_write_is_text_on_the_page(tmp_path: Path):
    endpoint = free_endpoint()
    with SystemByHand(tmp_path) as system:
        system.start("router", "router", "--listen", endpoint)
        with Session.connect([endpoint], DEADLINE_S) as session, browsing() as page:
            page.add_init_script(REPORT)
            put: list[tuple[str, Callable[[bytes], None], Callable[[bytes], None]]] = []
            for area in ("area1", NAMED):
                for role in ("area", "gateway", NAMED):
                    session.declare_presence(live_key("run", role, area, begin_incarnation()))
                state, readings = state_key("run", area), readings_key("run", area)
                put.append((area, session.publisher(state), session.publisher(readings)))
            page.goto(serve(system, "--connect", endpoint, "--run", "run"))

            def shown_everywhere() -> bool:
                numbers.append(len(numbers) + 1)
                for area, put_state, put_readings in put:
                    state, readings = hostile(area, numbers[-1])
                    put_state(encode(state))
                    put_readings(encode(readings))
                page.wait_for_timeout(100)
                return all(
                    page.locator(table, has_text="onerror").count() for table in ("#areas", "#meters", "#events")
                )

            numbers: list[int] = []
            wait_until(shown_everywhere)
            wait_until(lambda: "<script>" in page.locator("#areas").text_content())
            page.fill("#what", NAMED)
            page.keyboard.press("Enter")
            for button in page.locator("#areas button, #meters button").all()[:4]:
                button.click()
                page.wait_for_timeout(100)
            assert page.locator("main img, main script, body [onerror]").count() == 0
            assert page.title() == "Running feeder"
