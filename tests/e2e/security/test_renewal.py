"""SIGHUP: real processes take up new keys and revoked names without a restart."""

from __future__ import annotations

import json
import shutil
import signal
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from agents.messages.keys import all_from_neighbours, all_live, state_key, telemetry_key
from agents.security.access_file import ACCESS_FILE, load_access, save_access
from agents.security.credentials import load_keys
from agents.transport.zenoh_bus import Session, TransportError
from coordinator.lab.deployment.certificates import create_keys
from tests.support.expiring import let_expire
from tests.support.impostor import Impostor
from tests.support.keys_by_hand import AREAS, RUN, KeysByHand, scenario_of
from tests.support.levels import further
from tests.support.system_by_hand import Watcher
from tests.support.waiting import wait_until

OPEN_AGAIN = "the bus is open again with the renewed keys, after "


def hang_up(system: KeysByHand, names: Sequence[str]) -> None:
    """Send SIGHUP to each, and wait until all have links again."""
    before = {name: system.read_log(name).count(OPEN_AGAIN) for name in names}
    for name in names:
        system.processes[name].send_signal(signal.SIGHUP)
    wait_until(lambda: all(system.read_log(name).count(OPEN_AGAIN) > before[name] for name in names))


def revoke(system: KeysByHand, name: str) -> None:
    path = system.keys / ACCESS_FILE
    save_access(path, replace(load_access(path), revoked=(name,)))


def watched_areas(dsse: Callable, system: KeysByHand) -> dict[str, dict]:
    """What ``dsse watch`` sees of the areas that are there."""
    direct = ["--direct"] if system.direct else []
    done = dsse("watch", *direct, "--once", "--json", "--wait", "5", *system.connect())
    return {n: a for n, a in json.loads(done.stdout)["areas"].items() if a["state"] != "gone"} if done.stdout else {}


def watch_until_seen(dsse: Callable, system: KeysByHand, *names: str) -> set[str]:
    """All areas that watchers have seen until they had seen ``names``: one may end before the last of them links."""
    seen: set[str] = set()

    def are_seen() -> bool:
        seen.update(watched_areas(dsse, system))
        return seen >= set(names)

    wait_until(are_seen)
    return seen


@pytest.mark.parametrize("kind", ["router", *further("neighbours")])
def test_keys_of_a_new_authority_end_neither_a_process_nor_the_exchange(
    dsse, edited_scenario: Callable[..., Path], tmp_path: Path, kind: str
):
    with KeysByHand(tmp_path, scenario_of(edited_scenario, kind)) as system:
        if not system.direct:
            system.start_router()
        system.start_others()

        def all_agree() -> bool:
            areas = watched_areas(dsse, system)
            return set(areas) == set(AREAS) and all(area["quality"] == "good" for area in areas.values())

        wait_until(all_agree)
        old = tmp_path / "old"
        shutil.copytree(system.keys, old)
        create_keys(tmp_path / "new", system.access, days=1, direct=system.direct)
        for path in (tmp_path / "new").iterdir():
            shutil.copy(path, system.keys / path.name)
        hang_up(system, list(system.processes))
        wait_until(all_agree)
        with pytest.raises(TransportError, match="its certificate is rejected here"):
            Session.connect(system.endpoints, 0.5, load_keys(old, "coordinator"))
        for name in (*AREAS, "plant", *(() if system.direct else ("router",))):
            assert system.end(name) == 0, system.read_log(name)


@pytest.mark.parametrize("kind", ["router", "neighbours"])
def test_a_revoked_name_neither_publishes_nor_receives_nor_is_seen(
    dsse, edited_scenario: Callable[..., Path], tmp_path: Path, kind: str
):
    with KeysByHand(tmp_path, scenario_of(edited_scenario, kind)) as system:
        if not system.direct:
            system.start_router()
        system.start_others()
        wait_until(lambda: set(watched_areas(dsse, system)) == set(AREAS))
        revoke(system, "area3")  # whose process goes on as if nothing had happened
        hang_up(system, [name for name in system.processes if name != "area3"])
        wait_until(lambda: set(watched_areas(dsse, system)) == {"area1", "area2"})

        def misses_area3() -> bool:
            notes = watched_areas(dsse, system).get("area1", {}).get("notes", ())
            return any("area3" in note and ("gone" in note or "absent" in note or "not" in note) for note in notes)

        wait_until(misses_area3)
        mode = "peer" if system.direct else "client"
        endpoints = [
            endpoint for name, endpoint in system.area_endpoints.items() if name != "area3"
        ] or system.endpoints
        with Impostor.calling(endpoints, system.keys, "area3", mode) as thief:
            thief.listen(telemetry_key(RUN, "area3"), all_from_neighbours(RUN, "area3"), all_live(RUN))
            thief.show(f"dsse/v3/{RUN}/live/area/area3/1-00000001")
            puts = thief.publish([state_key(RUN, "area3")])
            wait_until(
                lambda: "shows the certificate of 'area3'" in system.read_log("area1" if system.direct else "router")
            )
            for put in puts * 20:
                put()
            assert watch_until_seen(dsse, system, "area1", "area2") == {"area1", "area2"}
            assert not thief.received
            assert not thief.seen


def test_a_router_that_has_not_been_reported_brings_nothing_of_a_revoked_name_to_those_who_have(
    dsse, edited_scenario: Callable[..., Path], tmp_path: Path
):
    with KeysByHand(tmp_path, scenario_of(edited_scenario, "router")) as system:
        system.start_router()
        system.start_others()
        with Watcher(RUN, system.endpoints, system.keys) as watcher:  # does not know either
            watcher.wait_for_consensus()
            revoke(system, "area3")
            hang_up(system, ["area1"])
            watcher.wait_until(lambda: any("area3" in note for note in watcher.states["area1"].notes))
            watcher.wait_until(lambda: watcher.states["area1"].ages["area3"] > 2.0)  # s; never received again
            assert "area3 is not on the bus" not in watcher.obstacles()
        # a watcher that comes now reads who is revoked
        assert watch_until_seen(dsse, system, "area1", "area2") == {"area1", "area2"}


def test_no_certificate_ends_without_notice_before(edited_scenario: Callable[..., Path], tmp_path: Path):
    with KeysByHand(tmp_path, scenario_of(edited_scenario, "router")) as system:
        for name in ("router", "area1"):
            let_expire(system.keys, name, in_s=3600.0)  # of two days
        system.start_router()
        system.start_others()
        for name in ("router", "area1"):
            wait_until(lambda name=name: f"{name}.crt: expires at " in system.read_log(name))
        wait_until(lambda: "scan 1" in system.read_log("area2") or "estimates" in system.read_log("area2"))
        assert "expires at " not in system.read_log("area2")


def test_keys_that_cannot_be_used_change_nothing(edited_scenario: Callable[..., Path], tmp_path: Path):
    with KeysByHand(tmp_path, scenario_of(edited_scenario, "router")) as system:
        system.start_router()
        system.start_others()
        with Watcher(RUN, system.endpoints, system.keys) as watcher:
            watcher.wait_for_consensus()
            (system.keys / "router.crt").write_text("rubbish")
            (system.keys / "area1.crt").write_text("rubbish")
            for name in ("router", "area1"):
                system.processes[name].send_signal(signal.SIGHUP)
                wait_until(lambda name=name: "the keys in use stay as they were" in system.read_log(name))
                assert f"{name}.crt: holds no certificate in PEM" in system.read_log(name)
            watcher.wait_for_consensus()
