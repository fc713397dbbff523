"""Cost of a command: seconds of a processor and memory, its children included."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import click


@dataclass(frozen=True, slots=True)
class Cost:
    """``cpu_s``: user and system time; ``peak_mib``: largest resident memory of one process."""

    cpu_s: float
    peak_mib: float


def measure(arguments: Sequence[str], folder: Path) -> Cost:
    """Run ``dsse`` with ``arguments`` in ``folder`` to its end.

    Raises:
        click.ClickException: it fails; with its last lines.
    """
    errors = folder / "errors.txt"
    with errors.open("w", encoding="utf-8") as err:
        process = subprocess.Popen(
            [sys.executable, "-m", "coordinator", *arguments],
            cwd=folder,
            stdout=subprocess.DEVNULL,
            stderr=err,
            env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])},
        )
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        last = errors.read_text(encoding="utf-8", errors="replace")[-500:]
        raise click.ClickException(f"dsse {' '.join(arguments)} ended with {process.returncode}: {last}")
    return Cost(usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024)
