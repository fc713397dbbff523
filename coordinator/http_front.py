"""The front of everything that answers over HTTP, page and metrics alike: names under which it is asked for, requests
that it refuses, and room for so many connections.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeVar
from urllib.parse import urlsplit

from coordinator.listen import name_address

LOOPBACK_NAMES = ("localhost", "127.0.0.1", "[::1]")
BACKLOG = 2048  # connections that wait to be taken
MOST_READERS = 200
LONGEST_REQUEST = 16 * 1024  # bytes
REQUEST_S = 10.0  # in which a request must have come whole
PATIENCE_S = 10.0  # with a reader that takes nothing


def is_loopback(host: str) -> bool:
    """True for an address that this machine alone reaches."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def open_listener(host: str, port: int) -> socket.socket:
    """A socket that listens at ``host``:``port``, 0 for any port that is free.

    Raises:
        OSError: the place is taken or is not there.
    """
    listener = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen(BACKLOG)  # readers that are told the address may ask at once
    except BaseException:
        listener.close()
        raise
    return listener


@dataclass(frozen=True)
class Rejection:
    """The answer to a request that is refused; ``headers``: beside those of every answer."""

    status: int
    text: str
    headers: dict[str, str] = field(default_factory=dict)


LAST = {"connection": "close"}  # after an answer to what may have a body, the rest of which is not waited for


@dataclass(frozen=True)
class Front:
    """Lets in requests for one of ``hosts`` (``name:port``), the first of which errors name, that only read.

    ``by_address``: also requests for any address in digits. A page of another site that a browser is led to can neither
    read an answer (Origin) nor ask for it under a name of its own (Host), which is how pages attack servers on
    loopback; a name of its own is never an address in digits.
    """

    hosts: Sequence[str]
    by_address: bool = False

    @classmethod
    def of(cls, host: str, port: int, names: Iterable[str] = (), *, by_address: bool = False) -> Front:
        """The front of what listens at ``host``:``port``; ``names``: of this host, beyond loopback."""
        others = LOOPBACK_NAMES if is_loopback(host) else tuple(name.lower() for name in names)
        own = name_address(host, port)
        usual = (*others, own.rpartition(":")[0]) if port in (80, 443) else ()  # browsers leave these ports out
        return cls((own, *(f"{name}:{port}" for name in others), *usual), by_address and not is_loopback(host))

    def find_rejection(self, method: str, headers: Iterable[tuple[str, str]]) -> Rejection | None:
        """The answer to a request that is refused; None for one that is let in. ``headers``: names in small letters."""
        given: dict[str, list[str]] = {}
        for name, value in headers:
            given.setdefault(name, []).append(value)
        if not self._is_own([value.lower() for value in given.get("host", [])]):
            return Rejection(421, f"this page is called {self.hosts[0]}; ask for it under that name\n")
        if not {_host_of(origin) for origin in given.get("origin", [])} <= set(self.hosts):
            return Rejection(403, "other sites cannot ask for this page\n")
        if method not in ("GET", "HEAD"):
            return Rejection(405, "this page can only be read\n", {"allow": "GET, HEAD", **LAST})
        if given.get("content-length", ["0"]) != ["0"] or "transfer-encoding" in given:
            return Rejection(400, "a request to read this page has no body\n", LAST)
        return None

    def _is_own(self, hosts: Sequence[str]) -> bool:
        if len(hosts) != 1:
            return False
        return hosts[0] in self.hosts or (self.by_address and _is_address(hosts[0]))


def _is_address(host: str) -> bool:
    """True for ``ADDRESS``, ``ADDRESS:PORT`` and ``[ADDRESS]:PORT``, an address being digits."""
    name, _, port = host.rpartition(":")
    if not (port.isascii() and port.isdigit()) or host.endswith("]"):
        name = host
    try:
        ipaddress.ip_address(name.removeprefix("[").removesuffix("]"))
    except ValueError:
        return False
    return True


def _host_of(origin: str) -> str:
    """``name:port`` of an origin; empty if it has none."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""


class Silent(Protocol):
    """A connection without an answer to wait for, since ``silent_since``, s."""

    @property
    def silent_since(self) -> float: ...

    def end(self) -> None:
        """Close it at once."""
        ...


AnySilent = TypeVar("AnySilent", bound=Silent)


def make_room(connections: int, silent: Iterable[AnySilent]) -> None:
    """Room for one more beside so many ``connections``: of MOST_READERS the one that is silent longest is closed."""
    if connections >= MOST_READERS and (longest := min(silent, key=lambda one: one.silent_since, default=None)):
        longest.end()
