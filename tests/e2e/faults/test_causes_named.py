"""Each injected fault, and two at once, on real processes: ``dsse watch`` and the page's API name the cause first."""

from __future__ import annotations

import json
import signal
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
import tomli_w

from agents.area_files.area_file import save_area_file, stamp_split
from agents.area_files.reader import load_area_file
from coordinator.watch.observe.causes import CAUSE_KINDS
from tests.support.browser import browsing, serve
from tests.support.dsse_command import free_endpoint
from tests.support.faulted import FAULTS, rate, words_of
from tests.support.levels import further
from tests.support.system_by_hand import SystemByHand
from tests.support.waiting import wait_until

pytestmark = pytest.mark.slow
AREAS = ("area1", "area2", "area3")
SHIPPED = Path(__file__).parents[3] / "scenarios/shipped/ieee33.toml"
ENDED = {"area killed": "{0}", "gateway dead": "plant", "router dead": "router"}  # the process of each
OTHERS = [name for name in FAULTS if name not in (*ENDED, "liar")]
PAIRS = [
    *(("area killed", other) for other in ("link cut", "wrong file", "gateway dead", "clock off", "bad meter", "liar")),
    *(("link cut", other) for other in ("wrong file", "bad meter", "undervoltage")),
    *(("gateway dead", other) for other in ("liar", "clock off", "wrong file")),
    *(("overload", other) for other in ("area killed", "bad meter", "undervoltage")),
]


def changes_of(faults: Mapping[str, str], folder: Path) -> dict[str, Any]:
    """Keys of the scenario and values; a cut link loses all messages: no coordinator states the time of a cut."""
    changes: dict[str, Any] = {"run.scan_s": 1.0}
    for name, area in faults.items():
        if name == "link cut":
            ways = [("area1", area), (area, "area1")]
            found: dict[str, Any] = {"faults.link": [{"from": a, "to": b, "loss": 1.0} for a, b in ways]}
        else:
            found = {"network": rate(folder, area)} if FAULTS[name].rates else FAULTS[name].changes(area)
        for key, value in found.items():
            changes[key] = [*changes.get(key, []), *value] if isinstance(value, list) else value
    return changes


def write_scenario(path: Path, changes: Mapping[str, Any]) -> None:
    content = tomllib.loads(SHIPPED.read_text())
    for key, value in changes.items():
        *tables, last = key.split(".")
        table = content
        for name in tables:
            table = table.setdefault(name, {})
        table[last] = value
    path.write_text(tomli_w.dumps(content))


@contextmanager
def running(dsse: Any, folder: Path, faults: Mapping[str, str]) -> Iterator[tuple[SystemByHand, str]]:
    """All processes of the feeder with ``faults`` in its files; those of processes have not happened yet."""
    endpoint, changes = free_endpoint(), changes_of(faults, folder)
    write_scenario(folder / "ieee33.toml", changes)
    (folder / "before").mkdir()
    write_scenario(folder / "before/ieee33.toml", {**changes, "measurements.flow.sigma_percent": 2.0})
    for scenario, files in (("before/ieee33.toml", "old"), ("ieee33.toml", "areas")):
        assert dsse("split", scenario, "--out", files, "--connect", endpoint).returncode == 0
    for content in stamp_split([load_area_file(folder / "old" / f"{area}.toml") for area in AREAS], time=1.7e9):
        save_area_file(folder / "old" / f"{content.area.name}.toml", content)
    older = {area for name, area in faults.items() if FAULTS[name].is_older}
    with SystemByHand(folder) as system:
        system.start("router", "router", "--listen", endpoint)
        for area in AREAS:
            files = ("old", "--older-file") if area in older else ("areas",)
            system.start(area, "agent", f"{files[0]}/{area}.toml", *files[1:])
        system.start("plant", "plant", "ieee33.toml", "--connect", endpoint)
        yield system, endpoint


def read_causes(system: SystemByHand, url: str) -> list[list[str]]:
    """The causes that the newest line of the watcher has, and the page's API, each the first one first."""
    lines = system.read_log("watch").splitlines(keepends=True)
    newest = [json.loads(line) for line in lines[-2:] if line.endswith("\n")][-1:]
    views = [*newest, httpx.get(f"{url}api/now").json()]
    return [[cause["what"] for cause in view.get("causes", [])] for view in views]


def assert_named(dsse: Any, folder: Path, faults: Mapping[str, str]) -> None:
    """Wait until both name the causes of ``faults`` and no other."""
    in_order = sorted(faults, key=lambda name: CAUSE_KINDS.index(FAULTS[name].kind))
    expected = [words_of(name, faults[name]).partition(" since ")[0] for name in in_order]
    with running(dsse, folder, faults) as (system, endpoint):
        system.start("watch", "watch", "ieee33.toml", "--connect", endpoint, "--json")
        url = serve(system, "ieee33.toml", "--connect", endpoint).partition("?")[0]

        def name_first(*wanted: str) -> bool:
            said = read_causes(system, url)
            return len(said) == 2 and all(
                len(whats) == len(wanted) and all(map(str.startswith, whats, wanted)) for whats in said
            )

        ended = [ENDED[name].format(area) for name, area in faults.items() if name in ENDED]
        lasting = [words for words, name in zip(expected, in_order, strict=True) if name not in ENDED]
        wait_until(lambda: name_first(*lasting))
        for process in ended:
            system.end(process, signal.SIGKILL)
        wait_until(lambda: name_first(*expected))
        with browsing() as page:
            page.goto(url)
            for words in expected:
                page.wait_for_selector(f"#cause >> text={words}")
        if not {"plant", "router"} & {*ended}:  # a watcher that comes later has not seen them
            once = dsse("watch", "ieee33.toml", "--connect", endpoint, "--once").stdout
            assert " ".join(once.split()).startswith(expected[0]), once  # whose lines have 80 characters


@pytest.mark.parametrize("fault", ["area killed", "gateway dead", "router dead", "liar", *further(*OTHERS)])
def test_a_fault_is_named_first_by_the_watcher_and_the_page(dsse: Any, tmp_path: Path, fault: str):
    assert_named(dsse, tmp_path, {fault: "area2"})


@pytest.mark.long
@pytest.mark.parametrize("pair", PAIRS, ids=" and ".join)
def test_of_two_faults_watcher_and_page_name_both(dsse: Any, tmp_path: Path, pair: tuple[str, str]):
    assert_named(dsse, tmp_path, {pair[0]: "area2", pair[1]: "area3"})
