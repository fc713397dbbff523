"""What strangers write reaches a real terminal as text: nothing of it is obeyed, and nothing ends the program."""

from __future__ import annotations

import io
import itertools
import json
import os
import re
import signal
import subprocess
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import pexpect
import pytest

from agents.messages.keys import live_key, state_key
from agents.messages.packing import Header, StateMessage, encode
from agents.protocol.quality import UNOBSERVABLE
from agents.runtime.presence import begin_incarnation
from agents.transport.zenoh_bus import Session
from tests.support.dsse_command import COMMAND, ENVIRONMENT, ROOT, free_endpoint
from tests.support.levels import further
from tests.support.repeating import repeating
from tests.support.system_by_hand import SystemByHand
from tests.support.waiting import DEADLINE_S, wait_until

NOTE = "[/nope] \x1b]0;owned\x07 \x1b[2J \x9b2J \rconsensus\n [bold]$\\frac$ \u202e"
SHOWN = r"[/nope] \x1b]0;owned\x07 \x1b[2J \x9b2J \rconsensus\n [bold]$\frac$ \u202e"
OF_RICH = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")  # how it draws: colours, and where the cursor goes


def terminal(folder: Path, *arguments: str, size: tuple[int, int] = (60, 500)) -> pexpect.spawn:
    """``dsse`` with ``arguments`` in a terminal of ``size`` (lines, columns): so wide that no text is broken."""
    of_worker = ("COLUMNS", "LINES")  # a test worker's own, which would count more than the terminal's
    environment = {name: value for name, value in ENVIRONMENT.items() if name not in of_worker}
    environment["TERM"] = "xterm-256color"
    command, *first = COMMAND
    return pexpect.spawn(
        command,
        [*first, *arguments],
        cwd=folder,
        env=environment,
        encoding="utf-8",
        timeout=DEADLINE_S,
        dimensions=size,
    )


def read_all(screen: pexpect.spawn) -> tuple[str, int | None]:
    """Everything that the program has written to the terminal, and its exit code."""
    screen.expect_exact(pexpect.EOF)
    before = str(screen.before)
    screen.close()
    return before, screen.exitstatus


def assert_harmless(output: str) -> None:
    """Only line ends and what rich draws with are left of the characters that steer a terminal."""
    assert "Traceback" not in output
    assert "\x1b[2J" not in output
    left = OF_RICH.sub("", output).replace("\r", "").replace("\n", "")
    assert left.isprintable(), [c for c in left if not c.isprintable()]


def hostile_state(run: str, area: str) -> StateMessage:
    return StateMessage(
        header=Header(run, area, begin_incarnation(), 1, 1, 0.0),
        **dict.fromkeys(("buses", "vm", "va", "sigma_vm", "sigma_va", "removed", "critical", "old_sides"), ()),
        **{key: {} for key in ("sent", "received", "rejected", "faults", "ages", "scans")},
        **{"referenced": False, "objective": 0.0, "degrees_of_freedom": 0, "checked": False},
        **{"messages": 0, "bytes": 0, "lost": 0, "notes": (NOTE,), "quality": "[/good]\x1b[8m", "telemetry_age": 0.0},
    )


def publishing(
    session: Session, states: Sequence[StateMessage], *, is_new: bool = True
) -> AbstractContextManager[None]:
    """Put ``states`` on the bus again and again, each with a new number if it ``is_new``."""
    publishers = [session.publisher(state_key(s.header.run, s.header.sender)) for s in states]
    sequence = itertools.count(2) if is_new else itertools.repeat(1)

    def publish() -> None:
        now = next(sequence)
        for put, state in zip(publishers, states, strict=True):
            put(encode(replace(state, header=replace(state.header, sequence=now))))

    return repeating(publish, 0.05)


def test_a_watcher_in_a_terminal_shows_what_strangers_say_and_obeys_none_of_it(tmp_path):
    endpoint = free_endpoint()
    with SystemByHand(tmp_path) as system:
        system.start("router", "router", "--listen", endpoint)
        with Session.connect([endpoint], DEADLINE_S) as session:
            name = "[bold]\x1b]0;owned\x07"
            session.declare_presence(live_key("run", "area", name, begin_incarnation()))
            with publishing(session, [hostile_state("run", name), hostile_state("run", "area1")]):
                screen = terminal(tmp_path, "watch", "--connect", endpoint, "--run", "run")
                screen.expect_exact(SHOWN)
                output = str(screen.before) + SHOWN
                screen.kill(signal.SIGINT)
                rest, code = read_all(screen)
                once = terminal(tmp_path, "watch", "--connect", endpoint, "--run", "run", "--once", "--wait", "8")
                lines, _ = read_all(once)
        assert system.end("router") == 0
    assert code == 0
    assert r"[bold]\x1b]0" in output + rest
    assert r"[/good]\x1b[8m" in output + rest
    assert r"\x1b]0;owned\x07" in lines
    assert_harmless(output + rest)
    assert_harmless(lines)


@pytest.mark.parametrize("size", [(24, 80), *further((40, 120))])
def test_a_watcher_fits_its_terminal_and_says_what_it_leaves_out(size: tuple[int, int], tmp_path):
    endpoint, (high, wide) = free_endpoint(), size
    with SystemByHand(tmp_path) as system:
        system.start("router", "router", "--listen", endpoint)
        with Session.connect([endpoint], DEADLINE_S) as session:
            session.declare_presence(live_key("run", "area", "area1", begin_incarnation()))
            note, n = "behind area2 something is missing or old, " * 5, 50
            buses = {"buses": tuple(range(n)), **dict.fromkeys(("vm", "va", "sigma_vm", "sigma_va"), (1.0,) * n)}
            long = replace(hostile_state("run", "area1"), notes=(note,), quality="degraded", **buses)
            dead = replace(hostile_state("run", "area2"), notes=(), quality="good")  # its token is not there
            with publishing(session, [long, dead]):
                words = ["watch", "--connect", endpoint, "--run", "run", "--buses", "--meters"]
                screen = terminal(tmp_path, *words, size=size)
                screen.logfile_read = io.StringIO()
                screen.expect_exact("is gone (it said good)")
                screen.expect_exact("rows more: --once shows all")
                screen.kill(signal.SIGINT)
                _, code = read_all(screen)
        assert system.end("router") == 0
    assert code == 0
    text = OF_RICH.sub("", screen.logfile_read.getvalue()).replace("\r", "")
    begins = r"(?=the agent of area2 is gone)|(?<!\n)(?=run run,)"  # with its cause, or before that is known
    pictures = [picture.split("\n") for picture in re.split(begins, text)[1:]]
    assert any(line.startswith("area1") for picture in pictures for line in picture)
    assert [line for picture in pictures for line in picture if len(line) > wide] == []
    assert max(map(len, pictures)) <= high


def test_a_run_in_a_terminal_ends_with_its_verdict_whatever_strangers_say(deaf_scenario, tmp_path):
    out = tmp_path / "out"
    limit = ("--timeout", str(DEADLINE_S))  # before, what they say for long ends the run
    screen = terminal(tmp_path, "run", str(deaf_scenario), "--out", str(out), *limit, "--no-plots")
    endpoints, events = out / "logs" / "router.endpoints", out / "events.jsonl"
    # of an area's states those of the incarnation that began last are shown
    wait_until(lambda: events.exists() and events.read_text().count('"appeared", "role": "area"') == 2)
    run = json.loads(events.read_text().splitlines()[0])["run"]
    lies = [replace(hostile_state(run, f"area{k}"), quality=UNOBSERVABLE) for k in (1, 2)]
    endpoint = endpoints.read_text().split()[0]
    with Session.connect([endpoint], DEADLINE_S) as session, publishing(session, lies, is_new=False):
        output, code = read_all(screen)
    assert code == 1
    table, _, verdict = output.partition("NO CONSENSUS")
    assert "[/nope]" in table
    assert SHOWN in verdict
    assert_harmless(output)


@pytest.mark.parametrize("command", ["check", *further("run", "simulate")])
def test_the_name_of_a_file_is_text_in_tables_and_pictures(command: str, tmp_path: Path):
    (tmp_path / "[").mkdir()  # as far as the slash the name is that of a folder
    name = "[/nope]$\\frac$\x1b]0;owned\x07.toml"
    (tmp_path / name).write_text((ROOT / "scenarios" / "shipped" / "industrial13.toml").read_text())
    options = {"run": ["--out", "out", "--timeout", str(DEADLINE_S)], "simulate": ["--out", "out"]}
    output, code = read_all(terminal(tmp_path, command, name, *options.get(command, [])))
    assert code == 0, output
    assert r"nope]$\frac$\x1b]0;owned\x07" in output
    assert_harmless(output)


def test_an_error_about_a_strangers_file_is_text(tmp_path):
    (tmp_path / "bad.toml").write_text('"\\u001b]0;owned\\u0007[/nope]\\nmade-up line" = 1\n')
    output, code = read_all(terminal(tmp_path, "check", "bad.toml"))
    assert code == 2
    assert r"\x1b]0;owned\x07[/nope]\nmade-up line: unknown key" in output
    assert_harmless(output)


@pytest.mark.parametrize("name", [b"no text \xff.toml", *further(b"\xc3\x98rsted.toml")])
def test_a_name_that_the_terminal_cannot_write_is_no_traceback(name: bytes, tmp_path):
    text = (ROOT / "scenarios" / "shipped" / "industrial13.toml").read_text()
    (tmp_path / os.fsdecode(name)).write_text(text)
    for command in ("check", "run"):
        options = ["--out", "out", "--no-plots", "--timeout", str(DEADLINE_S)] if command == "run" else []
        done = subprocess.run(
            [*COMMAND, command, name, *options],
            cwd=tmp_path,
            env={**ENVIRONMENT, "PYTHONIOENCODING": "ascii"},
            capture_output=True,
            timeout=DEADLINE_S,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        assert b"Traceback" not in done.stderr
        assert (b"\\xd8rsted" if b"rsted" in name else b"no text \\udcff") in done.stdout
