"""Who has stolen a key sits where a router or a neighbour is looked for, or calls everybody: real processes and TLS."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh

from agents.messages.keys import all_incarnations, all_live, state_key, telemetry_key
from agents.messages.packing import Header, encode
from agents.runtime.presence import begin_incarnation
from agents.security.access import Access, find_rights
from coordinator.lab.deployment.certificates import create_keys
from tests.support.impostor import Impostor, let_listen
from tests.support.keys_by_hand import AREAS, RUN, KeysByHand, scenario_of
from tests.support.levels import further
from tests.support.shown_states import a_state
from tests.support.system_by_hand import Watcher
from tests.support.waiting import DEADLINE_S, wait_until

ROUNDS = 200


def attack(impostor: Impostor, lies: dict[str, bytes]) -> None:
    """Listen to everybody, show everybody's tokens, and publish ``lies``."""
    impostor.listen(*(state_key(RUN, area) for area in ("*", *AREAS)), *(telemetry_key(RUN, area) for area in AREAS))
    impostor.listen(*(f"dsse/v3/{RUN}/area/*/*/{area}" for area in AREAS), all_live(RUN))
    impostor.listen(
        *(all_incarnations(RUN, role, name) for role, name in (*(("area", a) for a in AREAS), ("plant", "plant")))
    )
    impostor.show(*(f"dsse/v3/{RUN}/live/area/{area}/fffffffffff-ffffffff" for area in AREAS))
    puts = [put for key, lie in lies.items() for put in impostor.publish([key], lie)]
    pause = threading.Event()
    for _ in range(ROUNDS):
        for put in puts:
            put()
        pause.wait(0.01)


def forge_state(area: str) -> bytes:
    """A good state of ``area``, newer than any, with a note."""
    header = Header(RUN, area, begin_incarnation(), 10**9, 1, time.time())
    return encode(replace(a_state(notes=("forged",)), header=header))


def is_due(access: Access, name: str, key: str) -> bool:
    """Whether ``name`` may receive or see what is on ``key``."""
    rights = find_rights(access)[name]
    return any(zenoh.KeyExpr(allowed).intersects(key) for allowed in (*rights.receives, *rights.sees))


@pytest.mark.parametrize(
    "is_for_everything",
    [pytest.param(False, id="as made", marks=pytest.mark.long), pytest.param(True, id="good for everything")],
)
def test_with_the_key_of_an_area_nobody_is_taken_for_the_router(
    edited_scenario: Callable[..., Path], tmp_path: Path, is_for_everything: bool
):
    with KeysByHand(tmp_path, scenario_of(edited_scenario, "router")) as system:
        system.start_router()
        system.start_others()
        with Watcher(RUN, system.endpoints, system.keys) as watcher:
            watcher.wait_for_consensus()
        stolen = tmp_path / "stolen"
        shutil.copytree(system.keys, stolen)
        if is_for_everything:
            let_listen(stolen, "area3")
        system.end("router")
        with Impostor.at(system.endpoints[0], stolen, "area3") as impostor:
            if is_for_everything:
                wait_until(
                    lambda: all("shows the certificate of 'area3'" in system.read_log(a) for a in (*AREAS, "plant"))
                )
            attack(impostor, system.lies() | {state_key(RUN, area): forge_state(area) for area in AREAS})
            system.start("watch", "watch", "--once", "--json", "--wait", "3", *system.connect())
            assert system.processes["watch"].wait(DEADLINE_S) in (1, 2)  # nothing to be seen, or no router at all
            assert not impostor.received
            assert not impostor.seen
        assert "forged" not in system.read_log("watch")
        system.start_router()
        with Watcher(RUN, system.endpoints, system.keys) as watcher:
            watcher.wait_for_consensus()
            assert all(state.rejected == {} for state in watcher.states.values())
        for name in (*AREAS, "plant", "router"):
            assert system.end(name) == 0, system.read_log(name)


def test_between_neighbours_the_key_of_an_area_receives_and_forges_nobody_else(
    edited_scenario: Callable[..., Path], tmp_path: Path
):
    with KeysByHand(tmp_path, scenario_of(edited_scenario, "neighbours")) as system:
        system.start_others(AREAS[:2])  # area3 is in wrong hands
        forged = {state_key(RUN, area): forge_state(area) for area in AREAS[:2]}
        system.start("watch", "watch", "--direct", "--json", *system.connect())
        with Impostor.at(system.area_endpoints["area3"], system.keys, "area3", "peer") as impostor:
            wait_until(lambda: '"area2"' in system.read_log("watch") and '"area1"' in system.read_log("watch"))
            attack(impostor, system.lies() | forged)
            wait_until(lambda: any("/telemetry/area3" in key for _, key in impostor.received))
            assert [key for _, key in impostor.received if not is_due(system.access, "area3", key)] == []
            assert [key for key in impostor.seen if not is_due(system.access, "area3", key)] == []
        assert "forged" not in system.read_log("watch")
        for name in (*AREAS[:2], "plant"):
            assert system.end(name) == 0, system.read_log(name)


@pytest.mark.parametrize("name", ["area2", "router", *further("area3", "plant", "coordinator")])
def test_between_neighbours_whoever_calls_everybody_receives_its_due_only(
    edited_scenario: Callable[..., Path], tmp_path: Path, name: str
):
    with KeysByHand(tmp_path, scenario_of(edited_scenario, "neighbours")) as system:
        system.start_others()
        others = tmp_path / "others"
        create_keys(others, system.access, days=1, direct=True)
        lies = {key: lie for key, lie in system.lies().items() if name != "plant"}
        forged = {state_key(RUN, area): forge_state(area) for area in AREAS if area != name}
        with (
            Impostor.calling(system.endpoints, others, name, "peer") as stranger,
            Impostor.calling(system.endpoints, system.keys, name, "peer") as impostor,
        ):
            attack(stranger, lies | forged)
            attack(impostor, lies | forged)
            assert not stranger.received
            assert not stranger.seen
            if name == "router":  # there is none
                assert not impostor.received
                assert not impostor.seen
            else:
                assert [key for _, key in impostor.received if not is_due(system.access, name, key)] == []
                assert [key for key in impostor.seen if not is_due(system.access, name, key)] == []
        system.start("watch", "watch", "--direct", "--json", *system.connect())
        wait_until(lambda: system.read_log("watch").count('"state": "estimates"') >= len(AREAS))
        assert "forged" not in system.read_log("watch")
        for area in (*AREAS, "plant"):
            assert system.end(area) == 0, system.read_log(area)
