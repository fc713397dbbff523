"""The units of ``deploy/``, and three network namespaces as hosts that run what they say."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.dsse_command import ENVIRONMENT
from tests.support.units import DEPLOY, PROGRAM, command_of, read_host_file, setting_of
from tests.support.waiting import DEADLINE_S

UNITS = sorted(path.name for path in DEPLOY.glob("*.service"))
OWN_NETWORK = ["unshare", "--user", "--map-root-user", "--net"]


def why_no_namespaces() -> str:
    """Why this host cannot make network namespaces and veth links; empty if it can."""
    for program in ("unshare", "nsenter", "ip"):
        if shutil.which(program) is None:
            return f"the program {program} is not here"
    veth = ["ip", "link", "add", "left", "type", "veth", "peer", "name", "right"]
    tried = subprocess.run([*OWN_NETWORK, *veth], capture_output=True, text=True, check=False)
    return tried.stderr.strip() if tried.returncode else ""


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="the program systemd-analyze is not here")
def test_systemd_accepts_every_unit(tmp_path: Path):
    names = ["dsse-agent@", "dsse-gateway@", "dsse-metrics", "dsse-plant", "dsse-record", "dsse-router"]
    assert [f"{name}.service" for name in names] == UNITS
    for name in UNITS:  # systemd looks whether the program is there
        (tmp_path / name).write_text((DEPLOY / name).read_text().replace(PROGRAM, sys.executable))
    for name in UNITS:
        unit = tmp_path / name.replace("@", "@area1")
        done = subprocess.run(["systemd-analyze", "verify", str(unit)], capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize("name", UNITS)
def test_every_unit_is_restarted_when_its_loop_is_stuck_and_bounded_in_memory_and_tasks(name: str):
    settings = {key: setting_of(name, key) for key in ("Type", "WatchdogSec", "Restart", "MemoryMax", "TasksMax")}
    assert (settings["Type"], settings["Restart"]) == ("notify", "always")
    assert all(settings.values()), settings


@pytest.mark.parametrize("name", UNITS)
def test_the_command_of_every_unit_is_one_that_dsse_knows(dsse, name: str):
    arguments = command_of(name, read_host_file((DEPLOY / "host.env").read_text()), Path("nowhere"), "area1")
    done = dsse(*arguments)
    assert done.returncode == 2
    assert "nowhere" in done.stderr  # where its keys or its area should be, and not: an option that is unknown


@pytest.mark.long
def test_a_host_that_is_cut_off_is_noticed_and_rejoins_when_its_link_is_back(tmp_path: Path):
    if reason := why_no_namespaces():
        pytest.skip(f"network namespaces are not allowed here: {reason}")
    process = subprocess.Popen(
        [*OWN_NETWORK, sys.executable, "-P", "-m", "tests.support.three_hosts", str(tmp_path)],
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        reported, _ = process.communicate(timeout=3 * DEADLINE_S)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    assert process.returncode == 0
    happened = json.loads(reported)
    assert happened["gap before"] <= 1e-8
    assert "area1 is not on the bus" in happened["obstacles when cut off"]
    assert all("neighbour area1 is gone" in notes for notes in happened["notes when cut off"].values())
    assert happened["gap after"] <= 1e-8
    assert set(happened["exit codes"]) == {0}
