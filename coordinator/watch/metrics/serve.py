"""The process of ``dsse metrics``: attaches to the bus, with retries, and shows the watcher's view on a page."""

from __future__ import annotations

import importlib.util
import logging
import signal
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Protocol

from agents.runtime.inbox import Inbox
from agents.runtime.renewal import Renewal, on_hangup
from agents.runtime.watchdog import Watchdog
from agents.transport.zenoh_bus import TransportError
from coordinator.watch.observe.watcher import Watcher
from dsse_core.errors import InvalidInputError
from dsse_core.files.installation import install_command

if TYPE_CHECKING:
    from coordinator.watch.metrics.metrics_page import MetricsPage

log = logging.getLogger(__name__)
LOOK_S = 0.25
PAUSE_S = 1.0  # between two attempts to attach
NO_LINK = "has no link to the bus"


class Attached(Protocol):
    """A watcher on the bus, of ``coordinator/watch/observe/attachment.py``."""

    def is_linked(self) -> bool:
        """True where the link to the bus is up."""
        ...

    def renew(self) -> None:
        """Load the keys from their files again."""
        ...

    def for_whole(self, duration_s: float) -> Watcher:
        """Take in the messages of ``duration_s``, and return the watcher after that time."""
        ...


def check_prometheus() -> None:
    """Check that metrics can be written.

    Raises:
        InvalidInputError: prometheus-client is not installed.
    """
    if importlib.util.find_spec("prometheus_client") is None:
        cure = f"needs prometheus-client; install it: {install_command('metrics')}"
        raise InvalidInputError("dsse metrics", [cure])


def serve_metrics(page: MetricsPage, attach: Callable[[], AbstractContextManager[Attached]], renews: bool) -> None:
    """Show the view of a run on ``page``, until SIGTERM or Ctrl-C; with ``renews`` SIGHUP loads the keys again.

    ``attach`` is called again until it succeeds, since the system may start later.

    Raises:
        InvalidInputError: from ``attach``: the keys cannot be used.
    """
    inbox, watchdog = Inbox(), Watchdog()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: inbox.put("stop", None))
    if renews:
        on_hangup(lambda: inbox.put("renewal", Renewal.ASKED), lambda: inbox.put("stop", None))
    watchdog.ready(time.monotonic())
    last = ""
    wait_s = 0.0
    while None not in inbox.take(min(wait_s, watchdog.ping(time.monotonic()))):
        try:
            with attach() as look:
                log.info("watching at %s", page.where)
                _look_on(page, look, inbox, watchdog)
                return
        except TransportError as error:
            if str(error) != last:
                log.warning("%s", error)
            last, wait_s = str(error), PAUSE_S
            page.show_trouble(time.monotonic(), last)


def _look_on(page: MetricsPage, look: Attached, inbox: Inbox, watchdog: Watchdog) -> None:
    """Look every LOOK_S and show the view, until a signal to stop."""
    linked = True
    while None not in (updates := inbox.take(0.0)):
        if Renewal.ASKED in updates:
            look.renew()
        watchdog.ping(time.monotonic())
        watcher = look.for_whole(LOOK_S)
        if look.is_linked() != linked:
            linked = not linked
            (log.info if linked else log.warning)("%s", "on the bus again" if linked else NO_LINK)
        page.show(watcher, time.monotonic(), "" if linked else NO_LINK)
