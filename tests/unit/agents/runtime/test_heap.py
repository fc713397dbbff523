"""Free memory between what is in use is given back; where the C library cannot do it, nothing happens."""

from __future__ import annotations

import platform
from pathlib import Path

import numpy as np
import pytest

from agents.runtime import heap

PIECE, N_PIECE = 64 * 2**10, 1000  # bytes; too small for a mapping of their own


def resident() -> int:
    """Bytes of this process in memory."""
    status = Path("/proc/self/status").read_text()
    return next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS")) * 1024


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="of glibc alone")
def test_what_is_free_below_what_is_in_use_goes_back_to_the_system():
    pieces = [np.ones(PIECE, dtype=np.uint8) for _ in range(N_PIECE)]
    kept = pieces[-1]
    pieces.clear()
    before = resident()
    heap.give_back()
    assert before - resident() > 0.5 * PIECE * N_PIECE
    assert kept.all()


def test_a_function_that_the_c_library_lacks_does_nothing():
    assert heap._find("no_such_function_in_any_c_library")(0) == 0
