"""Every command where the operating system lacks a piece: it works, or says in one line what is missing."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.dsse_command import ENVIRONMENT, ROOT
from tests.support.levels import further

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


WITHOUT_SIGCHLD = {"run industrial13": "this system has no SIGCHLD", "stop run": "there is no such folder"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "hidden",
    [
        "fcntl resource",
        *further(
            "os.fork",
            "os.sched_getaffinity os.geteuid os.nice os.killpg os.getpgrp os.fchmod",
            "os.O_NOFOLLOW os.O_NONBLOCK os.O_NOCTTY socket.SOCK_CLOEXEC",
            "signal.SIGHUP signal.SIGQUIT signal.SIGUSR1 signal.SIGUSR2 signal.SIGSTOP signal.SIGCONT signal.SIGKILL "
            "signal.pthread_sigmask signal.pthread_kill",
        ),
    ],
)
def test_without_a_piece_of_the_system_every_command_works(tmp_path: Path, hidden: str):
    codes, errors = run_without(tmp_path, hidden, list(COMMANDS))
    assert codes == COMMANDS, errors


@pytest.mark.parametrize("commands", [[*WITHOUT_SIGCHLD], *further([*COMMANDS])], ids=["that need it", "all"])
def test_without_the_signal_of_an_ended_child_a_run_states_it_and_other_commands_work(
    tmp_path: Path, commands: list[str]
):
    chosen = [command for command in COMMANDS if command.startswith(tuple(commands))]
    codes, errors = run_without(tmp_path, "signal.SIGCHLD", chosen)
    needing = [command for command in chosen if command.startswith(tuple(WITHOUT_SIGCHLD))]
    assert codes == {command: 2 if command in needing else COMMANDS[command] for command in chosen}, errors
    assert all(reason in errors for reason in WITHOUT_SIGCHLD.values())


def run_without(folder: Path, hidden: str, commands: list[str]) -> tuple[dict[str, int], str]:
    """Exit codes of ``commands``, run one after the other in a process without ``hidden``; its standard error."""
    (folder / "sitecustomize.py").write_text(HIDE)
    (folder / "driver.py").write_text(DRIVER)
    ended = subprocess.run(
        [sys.executable, "-P", "driver.py", json.dumps(commands)],
        cwd=folder,
        env=ENVIRONMENT | {"PYTHONPATH": f"{folder}:{ROOT}", "PIECES_HIDDEN": hidden},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert "Traceback" not in ended.stderr, ended.stderr
    return json.loads((folder / "codes.json").read_text()), ended.stderr
