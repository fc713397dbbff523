"""Machine and packages of a measurement."""

from __future__ import annotations

import os
import platform
import subprocess
from collections.abc import Iterable
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from benchmarks.methods.ours import PACKAGE


def find_version(package: str) -> str | None:
    """Version of a package, None if it is not installed; of ours, git's description of this checkout."""
    if package == PACKAGE:
        return _describe_checkout()
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def describe_machine(packages: Iterable[str]) -> dict[str, str]:
    """Name -> text: date, processor, memory, load, Python and packages."""
    cores = os.cpu_count() or 0
    described = {
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "processor": f"{_processor()}, {cores} cores",
        "memory": _memory(),
        "load before": f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown",
        "system": platform.platform(),
        "Python": platform.python_version(),
    }
    return described | {package: find_version(package) or "not installed" for package in packages}


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _memory() -> str:
    try:
        return f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.0f} GiB"
    except (AttributeError, ValueError, OSError):
        return "unknown"


def _describe_checkout() -> str:
    command = ["git", "describe", "--always", "--dirty"]
    try:
        found = subprocess.run(
            command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True, timeout=10
        )
    except (OSError, subprocess.SubprocessError):
        return "source tree"
    return f"commit {found.stdout.strip()}"
