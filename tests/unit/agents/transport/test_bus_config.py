"""Sections of the bus's configuration."""

from __future__ import annotations

import pytest

from agents.transport.bus_config import at_once


@pytest.mark.parametrize("left_s", [-1.5, -1e-4, 0.0, 1e-5])
def test_a_wait_that_is_over_is_not_one_without_an_end(left_s: float):
    assert at_once(["tcp/127.0.0.1:7447"], left_s)["timeout_ms"] == 1
