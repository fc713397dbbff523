"""The log of a process: one printable line for each record, even with unprintable text in it."""

from __future__ import annotations

import logging

from dsse_core.printable import printable


class PrintableFormatter(logging.Formatter):
    """Escapes control characters, which a terminal would obey: names and notes in a record come from the bus."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        """The line of ``record``; the traceback of a defect, if there is one, follows on lines of its own."""
        return printable(super().formatMessage(record))


def start_log() -> None:
    """Log to standard error; for the entry points of processes. A log that cannot be written ends none of them."""
    logging.raiseExceptions = False
    handler = logging.StreamHandler()
    handler.setFormatter(PrintableFormatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[handler])
