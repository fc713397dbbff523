"""Certificates that end soon: a line in the log at the start and every day, from a month before."""

from __future__ import annotations

import datetime
import logging
import threading

from agents.security.credential_files import Credentials

log = logging.getLogger(__name__)
AHEAD = datetime.timedelta(days=30)
SHARE = 3  # a certificate with a short life ends soon only in its last third
DAY_S = 86400.0


def describe_expiry(credentials: Credentials, now: datetime.datetime) -> list[str]:
    """Sentences about the certificates in ``credentials`` that end soon, and what to do; unreadable ones are left out.

    ``now``: with its time zone.
    """
    from agents.security.certificate_checks import read_validity  # not needed without keys

    lines = []
    for path in (credentials.authority, credentials.certificate):
        for begin, end in read_validity(path):
            if now > end - min(AHEAD, (end - begin) / SHARE):
                when = f"expired at {end:%Y-%m-%d %H:%M} UTC" if now > end else f"expires at {end:%Y-%m-%d %H:%M} UTC"
                lines.append(
                    f"{path}: {when}, and its links end then; put a new one in its place and send SIGHUP to the process"
                )
    return lines


class ExpiryWatch:
    """Logs now and every day the certificates of ``credentials`` that end soon, until ``stop``."""

    def __init__(self, credentials: Credentials) -> None:
        self._credentials = credentials
        self._stopped = threading.Event()
        self._warn()
        threading.Thread(target=self._go_on, daemon=True).start()

    def stop(self) -> None:
        self._stopped.set()

    def _go_on(self) -> None:
        while not self._stopped.wait(DAY_S):
            self._warn()

    def _warn(self) -> None:
        for line in describe_expiry(self._credentials, datetime.datetime.now(datetime.UTC)):
            log.warning("%s", line)
