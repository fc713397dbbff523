"""The gateway: a process that publishes the meter readings of a source and passes results to sinks."""

from __future__ import annotations

import asyncio
import json
import logging
import signal
import sys
import time
from collections.abc import Coroutine, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from agents.messages.packing import StateMessage
from agents.runtime.duplicate_guard import REPLACED_CODE, ReplacedError
from agents.runtime.log import start_log
from agents.runtime.presence import begin_incarnation
from agents.runtime.renewal import on_hangup
from agents.runtime.watchdog import Watchdog
from coordinator.field.gateway.bus import GatewayBus, join_bus
from coordinator.field.gateway.intake import Intake
from coordinator.field.gateway.maps.map_file import GatewayMap, SinkOf, SourceOf
from coordinator.field.gateway.publisher import REPEATS_S, LeadingPublisher, Publisher
from coordinator.field.gateway.reconnection import Link, keep_on
from coordinator.field.gateway.results import ResultQueue, SilentAreas
from dsse_core.errors import DsseError
from dsse_core.files.drafts import whole_file
from dsse_core.reading_rules import allowed_lead_s

log = logging.getLogger(__name__)
STATUS_S = 1.0  # between two updates of the status file, where something has changed
LOG_S = 60.0  # between two lines in the log, where something has changed


def run_gateway(
    content: GatewayMap,
    endpoints: Sequence[str],
    timeout_s: float = 10.0,
    keys: Path | None = None,
    status_file: Path | None = None,
    direct: bool = False,
) -> int:
    """Run the gateway of a map until SIGTERM, Ctrl-C or the end of its source; 0, or 2 after a user's mistake.

    3 if another process of this name began later. ``keys``: folder of credentials. ``status_file``: file with one line
    of JSON, the counts of readings and the links, renewed when they change. ``direct``: ``endpoints`` are of all areas.
    """
    start_log()
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Zenoh's connecting would defer Python's handler to its end
    incarnation = begin_incarnation()
    try:
        with join_bus(content, incarnation, endpoints, timeout_s, keys, direct) as bus:
            asyncio.run(_Gateway(content, bus, status_file).serve(renews=keys is not None))
            bus.send_leave(b"stopped")
    except DsseError as error:
        print(f"error: {error}", file=sys.stderr)
        return REPLACED_CODE if isinstance(error, ReplacedError) else 2
    return 0


@dataclass
class _Gateway:
    content: GatewayMap
    bus: GatewayBus
    status_file: Path | None
    links: list[Link] = field(default_factory=list)
    queues: list[ResultQueue] = field(default_factory=list)
    _status: str = ""
    _status_problem: str = ""

    async def serve(self, renews: bool) -> None:
        """Serve until a signal or the end of the source; ReplacedError where a later process has the gateway's name."""
        content = self.content
        self.intake = Intake(content.points, time.time, allowed_lead_s(content.scenario.run.scan_s))
        publisher = self._make_publisher()
        ended = asyncio.Event()
        self._on_signals(ended, renews)
        areas = {area.name: area for area in content.scenario.partition.areas}
        self.queues, self.silent = [ResultQueue(areas) for _ in content.sinks], SilentAreas(content.run, areas)
        self.bus.watch(publisher.publish_soon, self._on_state if content.sinks else None)
        log.info(
            "gateway %s of run %s, %s meters in %s areas",
            content.name,
            content.run,
            len(content.points),
            len(content.areas),
        )
        jobs: list[Coroutine[Any, Any, None]] = [
            _wait(ended),
            self.bus.mind_successors(),
            self._report(),
            self._mind_silence(),
            _notify_systemd(),
        ]
        if content.source:
            jobs.append(self._read(content.source))
        jobs += [self._write(sink, queue) for sink, queue in zip(content.sinks, self.queues, strict=True)]
        tasks = [asyncio.create_task(job) for job in jobs]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            publisher.finish()
            self._write_status()
            log.info("gateway %s ends: %s", content.name, self.intake.counts.describe())

    def _make_publisher(self) -> Publisher:
        content = self.content
        cls = LeadingPublisher if content.leads else Publisher
        publisher = cls(
            run=content.run,
            name=content.name,
            incarnation=self.bus.incarnation,
            intake=self.intake,
            send=self.bus.send,
            least_interval_s=content.least_interval_s,
            scan_s=content.scenario.run.scan_s,
            repeats_s=(content.scenario.run.beat_s,) if content.leads else REPEATS_S,
        )
        publisher.start()
        return publisher

    def _on_signals(self, ended: asyncio.Event, renews: bool) -> None:
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, ended.set)
        if renews:

            def renew() -> None:
                loop.call_soon_threadsafe(self.bus.renew)

            def end() -> None:
                loop.call_soon_threadsafe(ended.set)

            on_hangup(renew, end)

    def _on_state(self, state: StateMessage) -> None:
        self.silent.take(state, time.monotonic())
        for queue in self.queues:
            queue.put(state)

    async def _mind_silence(self) -> None:
        """Put the last state of each area that falls silent into the queues again, as stale."""
        while True:
            await asyncio.sleep(STATUS_S)
            for state in self.silent.find(time.monotonic()):
                for queue in self.queues:
                    queue.put(state)

    async def _read(self, source: SourceOf) -> None:
        link = Link("source")
        self.links.append(link)
        await read_source(source, self.intake, link)
        log.info("the source has no more readings")

    async def _write(self, sink: SinkOf, queue: ResultQueue) -> None:
        link = Link(sink.name)
        self.links.append(link)
        queue.on_written = link.note_success

        async def attempt() -> None:
            queue.begin()
            await sink.make().write(queue)

        await keep_on(link, attempt)
        await asyncio.Event().wait()  # a sink that returns does not end the gateway

    async def _report(self) -> None:
        """Write the status file and the log at their intervals."""
        logged, due = "", 0.0
        while True:
            await asyncio.sleep(STATUS_S)
            self._write_status()
            described = self.intake.counts.describe()
            if time.monotonic() >= due and described != logged:
                log.info(described)
                logged, due = described, time.monotonic() + LOG_S

    def _write_status(self) -> None:
        if self.status_file is None:
            return
        content: dict[str, Any] = {"gateway": self.content.name, "run": self.content.run}
        content |= self.intake.counts.as_json()
        content["links"] = [{"name": link.name, "failures": link.failures, "error": link.error} for link in self.links]
        content["results"] = [{"written": q.written, "superseded": q.superseded} for q in self.queues]
        text = json.dumps(content)
        if text == self._status:
            return
        try:
            with whole_file(self.status_file) as draft:
                draft.write_text(text + "\n", encoding="utf-8")
            self._status = text
            self._status_problem = ""
        except OSError as error:
            if (problem := error.strerror or str(error)) != self._status_problem:
                log.warning("status file %s: %s", self.status_file, problem)
            self._status_problem = problem


async def read_source(source: SourceOf, intake: Intake, link: Link) -> None:
    """Read ``source`` into ``intake`` until the source ends; after an error a new source is made."""
    addresses = tuple(intake.points)

    class Noting:
        """An ``Emit`` by which every reading shows that the link works."""

        reject = staticmethod(intake.reject)

        def __call__(self, *arguments: Any, **options: Any) -> None:
            if link.error:
                link.note_success()
            intake(*arguments, **options)

    await keep_on(link, lambda: source.make(addresses).read(Noting()))


async def _notify_systemd() -> None:
    """Ping the watchdog of systemd as long as the loop runs; a source that blocks the loop stops the pings."""
    watchdog = Watchdog()
    watchdog.ready(time.monotonic())
    while True:
        await asyncio.sleep(min(STATUS_S, watchdog.ping(time.monotonic())))


async def _wait(ended: asyncio.Event) -> None:
    await ended.wait()
