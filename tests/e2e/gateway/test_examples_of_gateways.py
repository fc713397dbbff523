"""The examples of docs/how-to/gateway.md: a map that is sound, and a source of another distribution."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

from tests.support.dsse_command import COMMAND, ENVIRONMENT, ROOT, free_port
from tests.support.repeating import repeating
from tests.support.waiting import DEADLINE_S

EXAMPLES = ROOT / "examples"
METERS = EXAMPLES / "gateway" / "meters.py"


def check(map_file: Path, environment: dict[str, str], given: str | None = None, seconds: float = 10.0) -> str:
    """What ``dsse gateway --check`` prints, and its exit code in the last line; ``given``: on its standard input."""
    run = subprocess.run(
        [*COMMAND, "gateway", str(map_file), "--check", "--seconds", str(seconds)],
        env=environment,
        input=given,
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
    return f"{run.stdout}{run.stderr}{run.returncode}"


def test_the_map_of_the_page_is_sound() -> None:
    lines = subprocess.run(
        [sys.executable, METERS, "0.6"], capture_output=True, text=True, timeout=DEADLINE_S, check=True
    ).stdout
    output = check(EXAMPLES / "gateway" / "map.toml", ENVIRONMENT, lines)
    readings = sum(len(json.loads(line)["values"]) for line in lines.splitlines())  # of as many lines as there was time
    assert f"nothing looks wrong\n{readings} readings received\n0" in output


@pytest.fixture
def installed(tmp_path: Path) -> dict[str, str]:
    """An environment with what an installer makes of ``examples/own_source``."""
    source = EXAMPLES / "own_source"
    project = tomllib.loads((source / "pyproject.toml").read_text())["project"]
    info = tmp_path / "installed" / "udp_source-0.1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: 0.1.0\n")
    ((group, entries),) = project["entry-points"].items()
    (info / "entry_points.txt").write_text(f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in entries.items()))
    (info.parent / "udp_source.py").write_text((source / "udp_source.py").read_text())
    return {**ENVIRONMENT, "PYTHONPATH": os.pathsep.join([ENVIRONMENT["PYTHONPATH"], str(info.parent)])}


def test_the_source_of_the_page_reads_packets_and_counts_bad_ones(installed: dict[str, str], tmp_path: Path) -> None:
    port = free_port()
    text = (EXAMPLES / "own_source" / "map.toml").read_text()
    scenario = EXAMPLES / "gateway" / "scenario.toml"
    map_file = tmp_path / "map.toml"
    map_file.write_text(text.replace("5005", str(port)).replace("../gateway/scenario.toml", str(scenario)))
    packets = ["works/u 11020", "works/in/p nan", "works/p abc", "nowhere 1", "x"]

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:

        def send() -> None:
            for packet in packets:
                sender.sendto(packet.encode(), ("127.0.0.1", port))

        with repeating(send, 0.05):
            deadline = time.monotonic() + DEADLINE_S
            while "works/u     V    11020" not in (output := check(map_file, installed, seconds=2.0)):
                assert time.monotonic() < deadline, output
    for reason in ("bad type", "malformed", "not finite", "unknown address"):
        assert f"wrong: {reason}, " in output
    assert output.endswith("1")


def test_a_source_that_is_not_installed_is_answered_with_those_that_are() -> None:
    output = check(EXAMPLES / "own_source" / "map.toml", ENVIRONMENT)
    assert "source.kind: unknown kind 'udp'; allowed: csv, jsonl, modbus, mqtt, opcua" in output
    assert output.endswith("2")


def test_without_its_library_a_source_says_what_to_install(tmp_path: Path) -> None:
    (tmp_path / "aiomqtt.py").write_text("raise ModuleNotFoundError('no', name='aiomqtt')\n")
    map_file = tmp_path / "map.toml"
    text = (EXAMPLES / "gateway" / "map.toml").read_text().replace("./scenario.toml", "ieee33")
    map_file.write_text(text.replace('kind = "jsonl"           # lines', 'kind = "mqtt"\nhost = "x" # lines'))
    path = os.pathsep.join([str(tmp_path), ENVIRONMENT["PYTHONPATH"]])
    output = check(map_file, {**ENVIRONMENT, "PYTHONPATH": path})
    assert "needs module 'aiomqtt', which is not installed; " in output
    assert output.endswith("2")
