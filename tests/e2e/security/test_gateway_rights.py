"""A gateway with a key of its own: it speaks for its meters, and for those of nobody else."""

from __future__ import annotations

import math
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

from agents.messages.keys import telemetry_key
from agents.messages.packing import Header, TelemetryMessage, encode
from agents.runtime.presence import begin_incarnation
from agents.security.credentials import load_keys
from agents.transport.zenoh_bus import Session
from dsse_core.grid.measurement import Source
from tests.support.system_by_hand import SystemByHand, Watcher, free_endpoint
from tests.support.waiting import DEADLINE_S

RUN = "industrial13"


def test_a_gateway_cannot_speak_for_the_meters_of_another(
    dsse: Callable[..., subprocess.CompletedProcess[str]], edited_scenario: Callable[..., Path], tmp_path: Path
):
    scenario, endpoint = edited_scenario(RUN), free_endpoint("tls")
    scenario.write_text(scenario.read_text() + '[gateways.north]\nareas = ["area2"]\nmeters = ["vm@*"]\n')
    assert dsse("keys", "create", scenario, "--out", "keys", "--run", RUN).returncode == 0
    assert dsse("split", scenario, "--out", "areas", "--connect", endpoint, "--run", RUN).returncode == 0
    with SystemByHand(tmp_path) as system:
        system.start("router", "router", "--listen", endpoint, "--keys", "keys")
        for name in ("area1", "area2"):
            system.start(name, "agent", f"areas/{name}.toml", "--keys", "keys")
        system.start("plant", "plant", scenario, "--connect", endpoint, "--keys", "keys", "--run", RUN)
        with (
            Watcher(RUN, [endpoint], tmp_path / "keys") as watcher,
            Session.connect([endpoint], DEADLINE_S, load_keys(tmp_path / "keys", "gateway-north")) as gateway,
        ):
            watcher.wait_for_consensus()
            readings = [m for m in watcher.telemetry.by_area["area2"] if m.meter.source is not Source.VIRTUAL]
            others = next(m for m in readings if not m.meter.id.startswith("vm@"))
            now = time.time()
            header = Header(RUN, "north", begin_incarnation(), 0, 1, now)
            columns = (others.meter.id,), (others.value + 1.0,), (others.sigma / 1000,), (now,), (True,)
            put = gateway.publisher(telemetry_key(RUN, "area2", "north"))

            def is_rejected() -> bool:
                put(encode(TelemetryMessage(header, "area2", *columns)))
                return "meter of another gateway" in watcher.states["area2"].rejected

            watcher.wait_until(is_rejected)
            gap = watcher.wait_for_consensus()
            assert max(gap.vm_pu or 0.0, math.radians(gap.va_deg or 0.0)) <= 1e-8
