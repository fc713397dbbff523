"""Links to the bus that can be closed and opened again with renewed keys, with all declarations on them."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Protocol, Self

from agents.security.credentials import ExpiryWatch, Keys
from dsse_core.errors import InvalidInputError

log = logging.getLogger(__name__)
REOPEN_S = 1.0  # one attempt to open links again; a process that ends waits for the attempt
PAUSE_S = 0.2  # between two attempts


class OpenBus(Protocol):
    """Interface of an open bus: a session of Zenoh."""

    def close(self) -> Any: ...


@dataclass(slots=True)
class Declaration:
    """A declaration, and the function that repeats it; ``entity`` is None while there are no links."""

    declare: Callable[[Any], Any]
    entity: Any = None


class RenewableBus:
    """Opens the bus, closes it at the end of its ``with`` block, and in between takes up renewed keys.

    ``open_bus``: opens it with keys, waiting so many seconds for the other side; ``close_bus``: closes it.

    Raises:
        DsseError: of ``open_bus``.
    """

    def __init__(
        self,
        open_bus: Callable[[Keys | None, float], OpenBus],
        close_bus: Callable[[Any], None],
        keys: Keys | None = None,
        timeout_s: float = REOPEN_S,
    ) -> None:
        self.keys = keys
        self._open, self._close = open_bus, close_bus
        self._declared: list[Declaration] = []
        self._lock = threading.RLock()  # a declaration may call back at once
        self._reopening: threading.Thread | None = None
        self._given_up = threading.Event()
        self.bus: OpenBus | None = open_bus(keys, timeout_s)
        self._expiry = ExpiryWatch(keys.credentials) if keys else None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the bus; later calls do nothing."""
        if self._expiry:
            self._expiry.stop()
        self._take_down()

    def declare(self, declare: Callable[[Any], Any]) -> Declaration:
        """Call ``declare(bus)`` now and after every renewal, and keep the returned entity referenced."""
        declared = Declaration(declare)
        with self._lock:
            self._declared.append(declared)
            if self.bus:
                declared.entity = declare(self.bus)
        return declared

    @property
    def declarations(self) -> tuple[Declaration, ...]:
        """All present declarations, in order."""
        with self._lock:
            return tuple(self._declared)

    def withdraw(self, declared: Declaration) -> None:
        """Take back a declaration, for good."""
        with self._lock:
            self._declared = [other for other in self._declared if other is not declared]
            entity, declared.entity = declared.entity, None
        if entity is not None:
            entity.undeclare()

    def is_open(self, bus: OpenBus) -> bool:
        """True where ``bus`` is the one in use; messages from a former one are ignored."""
        return bus is self.bus

    def interrupt(self) -> bool:
        """Read the keys again and, if they can be used, close all links until ``resume``; True if so.

        Nothing arrives any more when this returns, and payloads published meanwhile are lost.
        """
        if self.keys is None:
            return False
        try:
            self.keys = self.keys.load_anew()
        except InvalidInputError as error:
            log.error("the keys in use stay as they were: %s", error)
            return False
        self._take_down()
        return True

    def resume(self) -> None:
        """Try to open the bus again in the background, until that succeeds or ``close`` is called."""
        self._given_up.clear()
        self._reopening = threading.Thread(target=self._reopen, daemon=True)
        self._reopening.start()

    def _take_down(self) -> None:
        if self._reopening:
            self._given_up.set()
            self._reopening.join()  # when the process ends, no thread may be inside Zenoh
            self._reopening = None
        self._drop()

    def _drop(self) -> None:
        """Close the bus in use, if there is one; its declarations have no entities then."""
        with self._lock:
            bus, self.bus = self.bus, None
            for declared in self._declared:
                declared.entity = None
        if bus:
            self._close(bus)

    def _reopen(self) -> None:
        began, logged = time.monotonic(), False
        while not self._given_up.is_set():
            try:
                self._open_with_declarations()
            except Exception as error:  # of any kind: only this thread opens the bus again
                if not logged:
                    log.warning("the bus is not open again yet: %s", error)
                logged = True
                self._given_up.wait(PAUSE_S)
                continue
            log.info("the bus is open again with the renewed keys, after %.2f s", time.monotonic() - began)
            self._mind_expiry()
            return

    def _open_with_declarations(self) -> None:
        """Open the bus and repeat all declarations on it; where one fails, the bus is closed again."""
        bus = self._open(self.keys, REOPEN_S)
        try:
            with self._lock:
                self.bus = bus  # before the declarations: one may call back at once
                for declared in self._declared:
                    declared.entity = declared.declare(bus)
        except Exception:
            self._drop()
            raise

    def _mind_expiry(self) -> None:
        if self._expiry and self.keys:
            self._expiry.stop()
            self._expiry = ExpiryWatch(self.keys.credentials)
