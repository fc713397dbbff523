"""What areas with a scan a second log: what holds at the ends of scans, not the exchange at work."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import pytest

from agents.messages.packing import TelemetryMessage
from agents.protocol.events import Action, Conclude, Event
from agents.runtime.log import ChangeLog
from tests.support.levels import further
from tests.support.ticking import SCAN_S, Ticking, by_clock

SCANS = 10


class Logs:
    """What the agents of ``run`` write; ``ends``: all that their protocols conclude."""

    def __init__(self, run: Ticking, caplog: pytest.LogCaptureFixture) -> None:
        caplog.set_level("INFO", "agents.runtime.log")
        self._caplog = caplog
        self.ends: list[Conclude] = []
        self._lines: dict[str, list[str]] = {}
        for name, protocol in run.bus.protocols.items():
            self._listen(name, protocol)

    def _listen(self, name: str, protocol: Any) -> None:
        handle, changes = protocol.handle, ChangeLog()

        def handle_and_log(events: Sequence[Event], now: float) -> Iterator[Action]:
            for action in handle(events, now):
                if isinstance(action, Conclude):
                    before = len(self._caplog.messages)
                    changes.take(action, now)
                    self.ends.append(action)
                    self._lines.setdefault(name, []).extend(self._caplog.messages[before:])
                yield action

        protocol.handle = handle_and_log

    def lines_of(self, name: str) -> list[str]:
        return [line.partition(": ")[2] for line in self._lines[name]]


@pytest.mark.parametrize(
    "changes", [{}, *further({"faults__loss": 0.2, "faults__delay_ms": 20.0}, {"strategy": "angle-offset"})]
)
def test_scan_after_scan_leaves_one_line_in_the_log_of_each_area(caplog: pytest.LogCaptureFixture, changes):
    run = Ticking(by_clock(**changes))
    logs = Logs(run, caplog)
    run.run(5.0)
    lines = {name: len(logs.lines_of(name)) for name in run.bus.protocols}
    run.run(SCANS * SCAN_S)
    assert len(logs.ends) >= SCANS * len(lines)
    for name, before in lines.items():
        assert not logs.lines_of(name)[before:], logs.lines_of(name)
    if not changes:
        assert logs.lines_of("area2") == ["estimates"]


def test_what_has_happened_is_logged_with_the_scan_and_once(caplog: pytest.LogCaptureFixture):
    publishes = True

    def spoil(message: TelemetryMessage, now: float) -> TelemetryMessage | None:
        return message if publishes or message.area != "area2" else None

    run = Ticking(by_clock(), spoil)
    logs = Logs(run, caplog)
    run.run(5.0)
    run.bus.kill("area3")
    run.run(10.0)
    lines = logs.lines_of("area1")
    assert lines[0] == "estimates"
    assert any("neighbour area3 is gone" in line and "no information from area3" in line for line in lines)
    assert len(lines) <= 3, lines
    publishes = False
    run.run(20.0)
    assert any("overdue: the reading of vm@" in line for line in logs.lines_of("area2"))
    assert len(logs.lines_of("area2")) <= 7, logs.lines_of("area2")
    assert not any("under way" in end.text for end in logs.ends)
