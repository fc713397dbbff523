"""What the process of a gateway tells others of itself."""

from __future__ import annotations

import asyncio
import socket
from pathlib import Path

import pytest

from coordinator.field.gateway import gateway

DEADLINE_S = 180.0


def test_systemd_is_notified_that_the_loop_goes_round(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "40000")

        async def test() -> list[bytes]:
            task = asyncio.create_task(gateway._notify_systemd())
            async with asyncio.timeout(DEADLINE_S):
                states = [await asyncio.get_running_loop().sock_recv(manager, 100) for _ in range(4)]
            task.cancel()
            return states

        assert asyncio.run(test()) == [b"READY=1", *[b"WATCHDOG=1"] * 3]
