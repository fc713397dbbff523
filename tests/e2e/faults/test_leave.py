"""An area that ends in order is distinguished from one that dies, by its neighbours and by who watches."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest

from tests.support.levels import SECURED_FURTHER
from tests.support.system_by_hand import SystemByHand, Watcher, prepare_by_hand
from tests.support.waiting import wait_until

NOTES = {signal.SIGTERM: "neighbour area2 has left: SIGTERM", signal.SIGKILL: "neighbour area2 is gone"}


@pytest.mark.parametrize("secured", SECURED_FURTHER)
def test_neighbours_and_watchers_tell_an_orderly_end_from_a_death(dsse, tmp_path: Path, secured: bool):
    endpoint, keys = prepare_by_hand(dsse, secured)
    with SystemByHand(tmp_path) as system:
        system.start("router", "router", "--listen", endpoint, *keys)
        system.start("plant", "plant", "industrial13", "--connect", endpoint, *keys)
        system.start("area1", "agent", "areas/area1.toml", *keys)
        with Watcher("industrial13", [endpoint], tmp_path / "keys" if secured else None) as watcher:
            for number in (signal.SIGTERM, signal.SIGKILL):
                system.start("area2", "agent", "areas/area2.toml", *keys)
                watcher.wait_for_consensus()
                system.end("area2", number)
                note = NOTES[number]
                watcher.wait_until(lambda note=note: note in watcher.states["area1"].notes)
                # the watcher, too, or the next incarnation would be killed before it is there
                watcher.wait_until(lambda: "area2 is not on the bus" in watcher.obstacles())

        def is_told() -> bool:
            done = dsse("watch", "--connect", endpoint, *keys, "--once", "--json")
            areas = json.loads(done.stdout)["areas"] if done.returncode == 0 else {}
            told = areas.get("area1", {}).get("quality"), areas.get("area2", {}).get("state")
            return told == ("degraded", "gone")

        wait_until(is_told)
