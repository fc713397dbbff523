"""The command line loads what a command needs when it runs: its options alone load no array, bus, schema or plot."""

from __future__ import annotations

import subprocess
import sys

HEAVY = ("numpy", "scipy", "zenoh", "msgspec", "pydantic", "cryptography", "rich", "matplotlib")


def test_the_command_line_loads_nothing_heavy_before_a_command_runs() -> None:
    code = f"import sys, coordinator.cli.main; print(*(name for name in {HEAVY} if name in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
