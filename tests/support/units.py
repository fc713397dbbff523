"""What the unit files of ``deploy/`` run, read as systemd reads it, so that a test runs the same."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path

DEPLOY = Path(__file__).parents[2] / "deploy"
PROGRAM = "/opt/dsse/bin/dsse"
CONFIGURATION = "/etc/dsse"


def read_host_file(text: str) -> dict[str, str]:
    """Variables of an ``EnvironmentFile``."""
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    return {name: shlex.split(value)[0] for name, value in (line.split("=", 1) for line in lines)}


def command_of(unit: str, variables: Mapping[str, str], configuration: Path, instance: str = "") -> list[str]:
    """The arguments of ``dsse`` in the unit's ``ExecStart``, with ``configuration`` in the place of /etc/dsse."""
    lines = (DEPLOY / unit).read_text().splitlines()
    (start,) = [line.removeprefix("ExecStart=") for line in lines if line.startswith("ExecStart=")]
    program, *words = start.replace("%i", instance).split()
    assert program == PROGRAM
    values = [variables[word[1:]].split() if word.startswith("$") else [word] for word in words]
    return [part.replace(CONFIGURATION, str(configuration)) for value in values for part in value]


def setting_of(unit: str, key: str) -> str:
    """What the unit says of ``key``; empty if nothing."""
    found = [line.partition("=")[2] for line in (DEPLOY / unit).read_text().splitlines() if line.startswith(f"{key}=")]
    return found[-1] if found else ""


def bytes_of(size: str) -> int:
    """A size as systemd writes it."""
    return int(size[:-1]) << {"K": 10, "M": 20, "G": 30}[size[-1]]
