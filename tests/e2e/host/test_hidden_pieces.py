"""Every command where the operating system lacks a piece: it works, or says in one line what is missing."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.dsse_command import ENVIRONMENT, ROOT

HIDE = """
import os, signal, socket, sys
for piece in os.environ["PIECES_HIDDEN"].split():
    module, _, name = piece.partition(".")
    if name:
        delattr(sys.modules[module], name)
    else:
        sys.modules[module] = None
"""
COMMANDS = {  # with the exit code; a command that needs a running system finds none, and says so
    "scenarios copy industrial13 copied": 0,
    "check industrial13": 0,
    "partition industrial13": 0,
    "powerflow industrial13 --out flow": 0,
    "estimate industrial13 --out estimate": 0,
    "generate --buses 40 --areas 3 --out generated": 0,
    "import none.m --out imported": 2,
    "keys create industrial13 --out keys": 0,
    "split industrial13 --out areas": 0,
    "simulate industrial13 --strategy information --out simulated --quiet --no-plots": 0,
    "compare industrial13 --strategies information --out compared --no-plots": 0,
    "sweep industrial13 --vary faults.loss=0,0.1 --seeds 1 --strategies information --jobs 2 --out swept --quiet "
    "--no-plots": 0,
    "run industrial13 --strategy information --out run --quiet --no-plots": 0,
    "stop run": 0,
    "replay recorded": 2,
    "plant industrial13 --connect tcp/127.0.0.1:9 --wait 0.1": 2,
    "watch --connect tcp/127.0.0.1:9 --wait 0.1": 2,
}
DRIVER = """
import json, sys
from coordinator.__main__ import main
if __name__ == "__main__":
    codes = {}
    for command in json.loads(sys.argv[1]):
        try:
            codes[command] = main(command.split())
        except SystemExit as end:
            codes[command] = end.code
    with open("codes.json", "w") as file:
        json.dump(codes, file)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hidden", "missing"),
    [
        ("fcntl resource", {}),
        pytest.param("os.fork", {}, marks=pytest.mark.long),
        pytest.param(
            "os.sched_getaffinity os.geteuid os.nice os.killpg os.getpgrp os.fchmod", {}, marks=pytest.mark.long
        ),
        pytest.param("os.O_NOFOLLOW os.O_NONBLOCK os.O_NOCTTY socket.SOCK_CLOEXEC", {}, marks=pytest.mark.long),
        pytest.param(
            "signal.SIGHUP signal.SIGQUIT signal.SIGUSR1 signal.SIGUSR2 signal.SIGSTOP signal.SIGCONT signal.SIGKILL "
            "signal.pthread_sigmask signal.pthread_kill",
            {},
            marks=pytest.mark.long,
        ),
        ("signal.SIGCHLD", {"run industrial13": "this system has no SIGCHLD", "stop run": "there is no such folder"}),
    ],
)
def test_without_a_piece_of_the_system_no_command_fails_but_by_a_stated_reason(
    tmp_path: Path, hidden: str, missing: dict[str, str]
):
    (tmp_path / "sitecustomize.py").write_text(HIDE)
    (tmp_path / "driver.py").write_text(DRIVER)
    ended = subprocess.run(
        [sys.executable, "-P", "driver.py", json.dumps(list(COMMANDS))],
        cwd=tmp_path,
        env=ENVIRONMENT | {"PYTHONPATH": f"{tmp_path}:{ROOT}", "PIECES_HIDDEN": hidden},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert "Traceback" not in ended.stderr, ended.stderr
    codes = json.loads((tmp_path / "codes.json").read_text())
    stated = {command: 2 for command in COMMANDS if command.startswith(tuple(missing))} if missing else {}
    assert codes == COMMANDS | stated, ended.stderr
    assert all(reason in ended.stderr for reason in missing.values())
