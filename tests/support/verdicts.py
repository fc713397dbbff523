"""What a run's verdict must say."""

import json
import math
from pathlib import Path


def assert_centralised(folder: Path) -> None:
    verdict = json.loads((folder / "result.json").read_text())["verdict"]
    assert verdict["consensus"] is True
    assert verdict["gap_vm_pu"] <= 1e-8
    assert verdict["gap_va_deg"] <= math.degrees(1e-8)
