"""Processes as a service manager and a monitoring system see them: notifications, metrics, health, readiness."""

from __future__ import annotations

import json
import os
import signal
import socket
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

from tests.support.dsse_command import free_endpoint, free_port
from tests.support.system_by_hand import SystemByHand, agreeing_system, prepare_by_hand
from tests.support.units import bytes_of, setting_of
from tests.support.waiting import DEADLINE_S, wait_until

LIMIT_US = 400_000


class ServiceManager:
    """The socket on which systemd is told by its processes; ``variables``: what it gives to them."""

    def __init__(self, folder: Path) -> None:
        path = folder / "notify"
        self.variables = {"NOTIFY_SOCKET": str(path), "WATCHDOG_USEC": str(LIMIT_US)}
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        self._socket.bind(str(path))

    def take(self, timeout_s: float) -> tuple[int, str]:
        """The next notification with the process id of its sender; (0, "") if none comes in time."""
        self._socket.settimeout(timeout_s)
        try:
            text, ancillary, _, _ = self._socket.recvmsg(4096, socket.CMSG_SPACE(12))
        except (TimeoutError, BlockingIOError):
            return 0, ""
        return int.from_bytes(ancillary[0][2][:4], "little"), text.decode()

    def close(self) -> None:
        self._socket.close()


@contextmanager
def service_manager(folder: Path) -> Iterator[ServiceManager]:
    made = ServiceManager(folder)
    try:
        yield made
    finally:
        made.close()


def test_a_process_that_is_stuck_falls_silent_to_systemd_and_the_others_do_not(dsse, tmp_path: Path):
    endpoint, _ = prepare_by_hand(dsse, False)
    port = free_port()
    with service_manager(tmp_path) as manager, SystemByHand(tmp_path, manager.variables) as system:
        system.start("router", "router", "--listen", endpoint)
        system.start("area1", "agent", "areas/area1.toml")
        system.start("plant", "plant", "industrial13", "--connect", endpoint)
        system.start("metrics", "metrics", "--listen", f"127.0.0.1:{port}", "--connect", endpoint)
        system.start("record", "record", "--run", "industrial13", "--connect", endpoint, "--out", "recording")
        pids = {system.processes[name].pid: name for name in system.processes}
        reports: dict[str, list[str]] = {name: [] for name in pids.values()}

        def take() -> bool:
            pid, text = manager.take(DEADLINE_S)
            reports[pids[pid]].append(text)
            return all(texts.count("WATCHDOG=1") >= 3 for texts in reports.values())

        wait_until(take)
        assert all(texts[0] == "READY=1" and set(texts[1:]) == {"WATCHDOG=1"} for texts in reports.values())
        frozen = system.processes["area1"].pid
        os.kill(frozen, signal.SIGSTOP)
        received: Counter[str] = Counter()

        def take_of_others() -> bool:
            received[pids[manager.take(DEADLINE_S)[0]]] += 1
            return all(received[name] >= 10 for name in ("router", "plant", "metrics", "record"))

        try:
            wait_until(lambda: psutil.Process(frozen).status() == psutil.STATUS_STOPPED)
            while manager.take(0.0) != (0, ""):  # what it has said before
                pass
            wait_until(take_of_others)  # some 4 s of four processes that go on
        finally:
            os.kill(frozen, signal.SIGCONT)
        assert received.keys() == {"router", "plant", "metrics", "record"}
        wait_until(lambda: manager.take(DEADLINE_S)[0] == frozen)


def ask(port: int, page: str) -> tuple[int, str]:
    """HTTP status and body; 0 while nobody listens."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/{page}", timeout=DEADLINE_S) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()
    except OSError:
        return 0, ""


def why_not(port: int, page: str) -> list[str]:
    """What health or readiness lacks, as an answer with status 503 says; nothing if it is there."""
    status, text = ask(port, page)
    return list(json.loads(text)["why"]) if status == 503 else []


UNIT_OF = {"area1": "dsse-agent@.service", "area2": "dsse-agent@.service"}


def assert_room(system: SystemByHand) -> None:
    """That no process takes half of the memory or the threads that its unit allows."""
    for name, process in system.processes.items():
        unit, seen = UNIT_OF.get(name, f"dsse-{name}.service"), psutil.Process(process.pid)
        assert seen.memory_info().rss < bytes_of(setting_of(unit, "MemoryMax")) / 2, name
        assert seen.num_threads() < int(setting_of(unit, "TasksMax")) / 2, name


def test_metrics_health_and_readiness_report_a_death_and_a_lost_bus(dsse, tmp_path: Path):
    port = free_port()
    with agreeing_system(dsse, tmp_path, secured=True) as (system, _, endpoint, keys):
        where = ("--listen", f"127.0.0.1:{port}", "--connect", endpoint, *keys)
        system.start("metrics", "metrics", *where)
        wait_until(lambda: ask(port, "ready")[0] == 200)
        assert_room(system)
        shown = (
            'dsse_area_quality{area="area1",quality="good"}',
            'dsse_run{run="industrial13"}',
            "dsse_gateways_alive",
        )
        wait_until(lambda: all(f"{sample} 1.0" in ask(port, "metrics")[1] for sample in shown))

        system.end("area1", signal.SIGKILL)
        wait_until(lambda: "area1 is gone" in why_not(port, "ready"))
        wait_until(lambda: ask(port, "health")[0] == 200)
        wait_until(lambda: 'dsse_area_quality{area="area1",quality="stale"} 1.0' in ask(port, "metrics")[1])
        system.start("area1", "agent", "areas/area1.toml", *keys)
        wait_until(lambda: ask(port, "ready")[0] == 200)

        system.processes["metrics"].send_signal(signal.SIGHUP)  # renewed keys: it knows who was there before
        wait_until(lambda: "open again with the renewed keys" in system.read_log("metrics"))
        wait_until(lambda: ask(port, "ready")[0] == 200)

        system.end("router", signal.SIGKILL)
        wait_until(lambda: why_not(port, "health") == ["has no link to the bus"])
        system.start("router", "router", "--listen", endpoint, *keys)
        wait_until(lambda: ask(port, "ready")[0] == 200)
        assert system.end("metrics") == 0


def test_a_system_that_is_started_after_its_monitor_is_found(dsse, tmp_path: Path):
    endpoint, _ = prepare_by_hand(dsse, False)
    port = free_port()
    with SystemByHand(tmp_path) as system:
        system.start("metrics", "metrics", "--listen", f"127.0.0.1:{port}", "--connect", endpoint)
        wait_until(lambda: "cannot reach" in ask(port, "health")[1])
        assert ask(port, "health")[0] == ask(port, "ready")[0] == 503
        system.start("router", "router", "--listen", endpoint)
        for name in ("area1", "area2"):
            system.start(name, "agent", f"areas/{name}.toml")
        system.start("plant", "plant", "industrial13", "--connect", endpoint)
        wait_until(lambda: ask(port, "ready")[0] == 200)
        assert system.end("metrics") == 0
    assert system.read_log("metrics").count("cannot reach") == 1


def test_without_a_bus_that_can_be_called_metrics_says_what_is_wrong(dsse):
    done = dsse("metrics", "--listen", "nowhere")
    assert done.returncode == 2
    assert "HOST:PORT" in done.stderr
    done = dsse("metrics", "--listen", f"127.0.0.1:{free_port()}", "--connect", free_endpoint("tls"), "--keys", "none")
    assert done.returncode == 2
    assert "none" in done.stderr
    assert "Traceback" not in done.stderr
