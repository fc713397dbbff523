"""Router, plant and agents started one by one, as on several hosts: nobody needs the coordinator."""

from __future__ import annotations

import ctypes
import os
import queue
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from agents.messages.keys import all_states
from agents.messages.packing import StateMessage, decode
from agents.transport.zenoh_bus import Session
from tests.support.dsse_command import COMMAND, ENVIRONMENT, free_endpoint
from tests.support.waiting import DEADLINE_S

PATIENCE = ("--wait", str(DEADLINE_S))  # with the router, which starts beside


def test_agents_started_by_hand_agree_and_end_with_exit_code_0(dsse, tmp_path: Path):
    endpoint = free_endpoint()
    assert dsse("split", "industrial13", "--out", "areas", "--connect", endpoint).returncode == 0
    commands = [
        [sys.executable, "-m", "coordinator.lab.process_run.router_process", "--listen", endpoint],
        [*COMMAND, "agent", str(tmp_path / "areas" / "area1.toml"), *PATIENCE],
        [sys.executable, "-m", "agents", str(tmp_path / "areas" / "area2.toml"), *PATIENCE],
        [*COMMAND, "plant", "industrial13", "--connect", endpoint, *PATIENCE],
    ]
    processes = [subprocess.Popen(command, env=ENVIRONMENT) for command in commands]
    try:
        states: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        with Session.connect([endpoint], DEADLINE_S) as session:
            session.subscribe(all_states("industrial13"), lambda key, payload: states.put(payload))
            deadline = time.monotonic() + DEADLINE_S
            referenced: set[str] = set()
            while referenced != {"area1", "area2"}:
                state = decode(states.get(timeout=max(0.0, deadline - time.monotonic())))
                assert isinstance(state, StateMessage)
                if state.referenced:
                    referenced.add(state.header.sender)
        for process in reversed(processes):  # the router last
            process.send_signal(signal.SIGTERM)
            assert process.wait(DEADLINE_S) == 0
    finally:
        for process in processes:
            process.kill()
            process.wait()


@pytest.mark.skipif(sys.platform != "linux", reason="needs tgkill")
def test_a_router_receives_a_signal_that_another_thread_of_it_has_caught():
    """The system may hand a signal to any thread; Python acts on it in the first one, once that is awake."""
    router = subprocess.Popen(
        [*COMMAND, "router", "--listen", free_endpoint()], env=ENVIRONMENT, stdout=subprocess.PIPE, text=True
    )
    try:
        assert router.stdout is not None
        assert router.stdout.readline().startswith("listening on")
        other = next(thread for thread in map(int, os.listdir(f"/proc/{router.pid}/task")) if thread != router.pid)
        assert ctypes.CDLL(None).tgkill(router.pid, other, signal.SIGTERM) == 0
        assert router.wait(DEADLINE_S) == 0
    finally:
        router.kill()
        router.wait()
