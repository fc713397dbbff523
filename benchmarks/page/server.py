"""A page in a process of its own, so that its memory can be read and it computes beside the browser."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from benchmarks.page.feed import RUN, Feed
from coordinator.lab.evaluation.evaluation import choose_scenario
from coordinator.show.web import app, sources
from coordinator.show.web.server import PageAddress, serve
from coordinator.show.web.sources import LiveSource
from coordinator.watch.observe.grid_tables import GridTables

START_S = 300.0


@dataclass(frozen=True)
class Server:
    """``url``: address of the page; ``pid``: id of its process."""

    url: str
    pid: int

    def resident_mb(self) -> float:
        """Memory of the process, MB."""
        status = Path(f"/proc/{self.pid}/status").read_text(encoding="ascii")
        return next(int(line.split()[1]) / 1000 for line in status.splitlines() if line.startswith("VmRSS"))


@contextmanager
def serving(scenario: str, *, is_hurried: bool = False) -> Iterator[Server]:
    """A page of ``scenario``; ``is_hurried``: as many moments as it can make.

    Raises:
        TimeoutError: the page is not there in time.
    """
    receiver, sender = multiprocessing.get_context("spawn").Pipe(duplex=False)
    process = multiprocessing.get_context("spawn").Process(target=_serve, args=(sender, scenario, is_hurried))
    process.start()
    sender.close()
    try:
        if not receiver.poll(START_S):
            raise TimeoutError(f"the page of {scenario} is not there after {START_S:g} s")
        assert process.pid is not None
        yield Server(receiver.recv(), process.pid)
    finally:
        process.terminate()
        process.join()


def _serve(sender: Connection, scenario: str, is_hurried: bool) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the parent, which ends this process
    chosen = choose_scenario(scenario)
    if is_hurried:
        sources.UPDATE_S, sources.BUSY_SHARE, sources.MOST_RATE, app.LOOK_S = 0.0, 0, 10**12, 0.001
    source = LiveSource(Feed(chosen), GridTables(chosen), RUN)
    source.start()
    try:
        serve(source, PageAddress("127.0.0.1", 0), (), sender.send)
    finally:
        source.close()
