"""Endpoints of the bus, ``tcp/HOST:PORT`` or ``tls/HOST:PORT``, checked before Zenoh sees them.

Zenoh tries an endpoint of another form again and again without a pause.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable, Iterator, Sequence

from dsse_core.errors import InvalidInputError
from dsse_core.printable import shortened_inside

PROTOCOLS = ("tcp", "tls")
HIGHEST_PORT = 65535
LONGEST_HOST = 253  # letters of a host's name
EXAMPLE = "one looks like tcp/192.0.2.7:7447"
_LABEL = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?", re.ASCII)
_DIGITS = re.compile(r"[0-9.]*")
_ZONE = re.compile(r"[A-Za-z0-9_.-]{1,15}", re.ASCII)  # of a link-local address: the name of an interface


def find_endpoint_problem(endpoint: str, *, listens: bool = False) -> str:
    """The first problem of an endpoint, as text; empty if it has none.

    Only an endpoint that ``listens`` may have port 0, which stands for any free port.
    """
    called = repr(shortened_inside(endpoint, 80))
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    if protocol in PROTOCOLS and address and ":" not in address:
        return f"{called}: the port is missing; {EXAMPLE}"
    if protocol not in PROTOCOLS or not host:
        return f"{called} is no endpoint, {' or '.join(f'{p}/HOST:PORT' for p in PROTOCOLS)}; {EXAMPLE}"
    if not (port.isascii() and port.isdigit() and len(port) <= 5 and int(port) <= HIGHEST_PORT):
        return f"{called}: the port is {port[:20]!r}; it must be a number from 1 to {HIGHEST_PORT}"
    if int(port) == 0 and not listens:
        return f"{called}: port 0 is for listening on any that is free; give the port that is listened on"
    if not _is_host(host):
        return f"{called}: the host is {shortened_inside(host, 40)!r}; give a name, or an address, IPv6 in brackets"
    return ""


def add_protocol(endpoints: Iterable[str], *, secured: bool) -> tuple[str, ...]:
    """The endpoints, each ``HOST:PORT`` with the protocol of a bus with or without certificates."""
    return tuple(e if "/" in e else f"{'tls' if secured else 'tcp'}/{e}" for e in endpoints)


def check_endpoints(what: str, endpoints: Iterable[str], *, listens: bool = False) -> None:
    """Checks that all ``endpoints`` can be given to the bus; errors call them ``what``.

    Raises:
        InvalidInputError: listing the first problem of every endpoint that has one.
    """
    if problems := [p for endpoint in endpoints if (p := find_endpoint_problem(endpoint, listens=listens))]:
        raise InvalidInputError(what, problems)


def find_problems_in(key: str, endpoints: Sequence[str], *, listens: bool = False) -> Iterator[str]:
    """The problems of ``endpoints`` in a list of a file, each with its place there; items count from 1."""
    for k, endpoint in enumerate(endpoints, 1):
        if problem := find_endpoint_problem(endpoint, listens=listens):
            yield f"{key}[{k}]: {problem}"


def _is_host(host: str) -> bool:
    """True for a name, an IPv4 address, and an IPv6 address in brackets."""
    if host.startswith("[") and host.endswith("]"):
        address, percent, zone = host[1:-1].partition("%")
        return _is_address(address, 6) and (not percent or bool(_ZONE.fullmatch(zone)))
    if _DIGITS.fullmatch(host):
        return _is_address(host, 4)
    return len(host) <= LONGEST_HOST and all(map(_LABEL.fullmatch, host.removesuffix(".").split(".")))


def _is_address(text: str, version: int) -> bool:
    try:
        return ipaddress.ip_address(text).version == version
    except ValueError:
        return False
