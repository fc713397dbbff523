"""An area that is started again with an older file: it is refused, or named by all areas, and no area is good."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from agents.area_files.area_file import save_area_file, stamp_split
from agents.area_files.reader import load_area_file
from agents.protocol.quality import GOOD
from agents.runtime.duplicate_guard import REPLACED_CODE
from tests.support.system_by_hand import agreeing_system

DAY_S = 86_400.0


def test_an_older_file_is_refused_beside_a_running_agent_and_named_by_all_areas_after_its_end(dsse, tmp_path: Path):
    with agreeing_system(dsse, tmp_path) as (system, watcher, _, _):
        new = [load_area_file(tmp_path / "areas" / f"{name}.toml") for name in ("area1", "area2")]
        branch, *others = new[1].area.network.branches
        network = replace(new[1].area.network, branches=(replace(branch, r=2 * branch.r, x=2 * branch.x), *others))
        assert new[1].split is not None
        changed = [new[0], replace(new[1], area=replace(new[1].area, network=network))]
        old = stamp_split(changed, time=new[1].split.time - DAY_S)[1]
        save_area_file(tmp_path / "old.toml", old)

        system.start("older", "agent", "old.toml")
        refused = system.processes["older"]
        watcher.wait_until(lambda: refused.poll() is not None)
        assert refused.returncode == REPLACED_CODE
        log = system.read_log("older")
        assert all(str(content.identity) in log for content in (old, new[1])), log
        assert not watcher.obstacles()
        assert {state.quality for state in watcher.states.values()} == {GOOD}

        system.start("told", "agent", "old.toml", "--older-file")

        def is_named() -> bool:
            states = watcher.states
            if old.identity != states["area2"].split:
                return False
            sentences = ("the file of area2 is older", "the file of this area is older")
            named = zip((states["area1"], states["area2"]), sentences, strict=True)
            return all(any(n.startswith(what) and str(old.identity) in n for n in s.notes) for s, what in named)

        watcher.wait_until(is_named)
        assert watcher.states["area2"].quality != GOOD
        watcher.wait_until(lambda: system.processes["area2"].poll() is not None)
        system.end("told")
        system.start("new again", "agent", "areas/area2.toml")
        watcher.wait_until(
            lambda: {state.quality for state in watcher.states.values()} == {GOOD} and not watcher.obstacles()
        )
        assert watcher.states["area2"].split == new[1].identity
