"""Reports as a browser takes them: no error on its console, no request to anywhere, whatever their size."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

from coordinator.show.report.run_report import write_report
from scenarios.generate.generated_files import write_generated
from scenarios.scenario import load_scenario
from tests.support.levels import further
from tests.support.made_results import make_result
from tests.support.read_page import read_page

NAMES = ("chromium-headless-shell", "chrome-headless-shell", "chromium", "chromium-browser", "google-chrome")
BROWSER = next(filter(None, map(shutil.which, NAMES)), None)
QUIET = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"]
QUIET += ["--disable-component-update", "--disable-sync", "--disable-default-apps", "--disable-dev-shm-usage"]
ALONE = "--host-resolver-rules=MAP * ~NOTFOUND"  # the test itself asks nobody for anything either
DEADLINE_S = 600

pytestmark = [pytest.mark.slow, pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")]


@dataclass(frozen=True)
class Opened:
    """``page``: what the browser has made of the file; ``console``: its messages; ``requests``: to the network."""

    page: str
    console: list[str]
    requests: set[str]


def open_in_browser(path: Path, folder: Path) -> Opened:
    log = folder / "net.json"
    done = subprocess.run(
        [
            *(str(BROWSER), *QUIET, ALONE),
            *(f"--user-data-dir={folder / 'profile'}", f"--log-net-log={log}", "--enable-logging=stderr"),
            *("--dump-dom", path.as_uri()),
        ],
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=True,
    )
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return Opened(done.stdout, console, find_requests(log))


def find_requests(log: Path) -> set[str]:
    """What the browser has asked the network for, of which files and data that it has are no part."""
    events = json.loads(log.read_text(encoding="utf-8"))["events"]
    asked = {str(event.get("params", {}).get("url", "")) for event in events}
    return {url for url in asked if re.match(r"(https?|wss?|ftp):", url)}


def test_what_a_page_asks_for_and_complains_of_is_seen(tmp_path: Path) -> None:
    """Else the tests below would see nothing, whatever happens."""
    page = tmp_path / "asking.html"
    page.write_text('<p>here<img src="http://nowhere.example/a.png"><script>console.error("alas")</script>')
    opened = open_in_browser(page, tmp_path)
    assert "http://nowhere.example/a.png" in opened.requests
    assert any("alas" in line for line in opened.console)


@pytest.mark.parametrize("n_bus", [33, *further(1000)])
def test_a_report_opens_without_error_and_without_a_request(n_bus: int, tmp_path: Path) -> None:
    name: str | Path = "ieee33"
    if n_bus > 33:
        name = write_generated(tmp_path / "feeder", n_bus, 3, n_area=100, meters="sparse")
    (tmp_path / "run").mkdir()
    assert write_report(make_result(load_scenario(name), tmp_path / "run"), [], ["run", str(name)]).unwritten is None
    opened = open_in_browser(tmp_path / "run" / "report.html", tmp_path)
    assert opened.console == []
    assert opened.requests == set()
    page = read_page(opened.page)
    assert page.count("svg") == 6
    assert "Consensus after 4.00 s" in page.text
    assert f"Buses ({n_bus})" in page.text
    assert page.text.rstrip().endswith(f"dsse run {name}")
