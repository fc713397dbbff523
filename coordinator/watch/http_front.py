"""Front of the HTTP servers, page and metrics alike: their host names, the requests that they refuse, and the limit on
connections.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeVar
from urllib.parse import urlsplit

from coordinator.watch.listen import name_address

LOOPBACK_NAMES = ("localhost", "127.0.0.1", "[::1]")
BACKLOG = 2048  # connections that wait to be accepted
MOST_READERS = 200
LONGEST_REQUEST = 16 * 1024  # bytes
REQUEST_S = 10.0  # for a whole request to arrive
PATIENCE_S = 10.0  # with a reader that receives nothing


def is_loopback(host: str) -> bool:
    """True for an address that this machine alone reaches."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def open_listener(host: str, port: int) -> socket.socket:
    """A socket that listens at ``host``:``port``, 0 for any free port.

    Raises:
        OSError: the port is in use, or the address is not one of this host.
    """
    listener = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen(BACKLOG)  # readers may connect as soon as they know the address
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


LAST = {"connection": "close"}  # for a request that may have a body, whose rest is not read


@dataclass(frozen=True)
class Front:
    """Lets in reading requests for one of ``hosts`` (``name:port``); errors name the first of them.

    ``by_address``: also lets in requests for any address in digits. A page of another site in a browser can neither
    read an answer (Origin) nor request it under a host name of that site (Host), the way in which pages attack servers
    on loopback. Such a host name is never an address in digits.
    """

    hosts: Sequence[str]
    by_address: bool = False

    @classmethod
    def of(cls, host: str, port: int, names: Iterable[str] = (), *, by_address: bool = False) -> Front:
        """The front of a server at ``host``:``port``.

        ``names``: ``NAME`` or ``NAME:PORT``, of this host or of a proxy before it, whose port may be a usual one, which
        browsers leave out.
        """
        given = tuple(name.lower() for name in names)
        others = (*(LOOPBACK_NAMES if is_loopback(host) else ()), *(name for name in given if ":" not in name))
        own = name_address(host, port)
        usual = (*others, own.rpartition(":")[0]) if port in (80, 443) else ()
        hosts = (own, *(f"{name}:{port}" for name in others), *usual, *given)
        return cls(tuple(dict.fromkeys(hosts)), by_address and not is_loopback(host))

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
    """``name:port`` of an origin, or ``name`` alone; empty if it has none."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""


class Silent(Protocol):
    """A connection without an answer to wait for, since ``silent_since``, s."""

    @property
    def silent_since(self) -> float: ...

    def end(self) -> None:
        """Close the connection at once."""
        ...


AnySilent = TypeVar("AnySilent", bound=Silent)


def make_room(connections: int, silent: Iterable[AnySilent]) -> None:
    """Make room for one more connection: of MOST_READERS ``connections``, the one silent longest is closed."""
    if connections >= MOST_READERS and (longest := min(silent, key=lambda one: one.silent_since, default=None)):
        longest.end()
