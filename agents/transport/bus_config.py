"""The configuration of Zenoh, as data: no scouting, no shared memory, and with keys TLS and rules on every link."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from agents.messages.packing import MAX_BYTES
from agents.peers.orders_and_ages import PATIENCE_HEARTBEATS
from agents.security.access import Access, zenoh_access_control, zenoh_access_control_without_keys
from agents.security.credential_files import Credentials
from agents.security.credentials import Keys

SHORTEST_LEASE_S = 2.0
LEASE_HEARTBEATS = PATIENCE_HEARTBEATS  # where hundreds of processes share two cores, one may wait so long to run
BURST = 16  # messages of one priority, the most that Zenoh allows
RETRY = {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 2}


def bus_config(
    mode: str,
    keys: Keys | None = None,
    meets: Iterable[str] = (),
    heartbeat_s: float = 0.0,
    access: Access | None = None,
    **sections: Any,
) -> dict[str, Any]:
    """The configuration of a session of Zenoh in ``mode``; ``sections`` are added to it.

    ``meets``: names that may be at the other ends of links, with ``keys``. ``heartbeat_s``: interval of the process's
    heartbeats, s, from which the time follows that the other end waits for a sign. ``access``: of a router without
    keys, if known.
    """
    return {
        "mode": mode,
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "timestamping": {"enabled": True},
        "transport": {
            "shared_memory": {"enabled": False},
            "unicast": {
                "open_timeout": 10000,
                "accept_timeout": 10000,
                "accept_pending": 1000,
                "max_sessions": 2000,
            },
            "link": {
                **(_tls(keys.credentials) if keys else {}),
                "tx": {
                    "lease": int(1000 * max(SHORTEST_LEASE_S, LEASE_HEARTBEATS * heartbeat_s)),
                    "keep_alive": 4,
                    "queue": {
                        # messages that wait for the sending thread: an area sends a dozen at once, and Zenoh
                        # would drop all that find no place here
                        "size": {"data_high": BURST},
                        "congestion_control": {"block": {"wait_before_close": 1_000_000}},
                    },
                },
                "rx": {"max_message_size": MAX_BYTES},
            },
        },
        **_access_control(keys, meets, access),
        **sections,
    }


def _access_control(keys: Keys | None, meets: Iterable[str], access: Access | None) -> dict[str, Any]:
    if keys:
        return {"access_control": zenoh_access_control(keys.access, meets)}
    return {"access_control": zenoh_access_control_without_keys(access)} if access else {}


def _tls(credentials: Credentials) -> dict[str, Any]:
    """The section that shows the own certificate in both directions, and requires that of the other end."""
    certificate, key = str(credentials.certificate), str(credentials.key)
    tls = {
        "root_ca_certificate": str(credentials.authority),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
        "listen_certificate": certificate,
        "listen_private_key": key,
        "connect_certificate": certificate,
        "connect_private_key": key,
    }
    return {"protocols": ["tls"], "tls": tls}


def at_once(endpoints: Sequence[str], timeout_s: float) -> dict[str, Any]:
    """The section that connects to the first of ``endpoints`` that answers, or fails after ``timeout_s``."""
    return {
        "endpoints": list(endpoints),
        "timeout_ms": max(1, int(timeout_s * 1000)),  # Zenoh waits for ever where it is negative
        "exit_on_failure": True,
        "retry": RETRY,
    }


def in_turns(endpoints: Sequence[str], first_s: float) -> Iterator[tuple[Sequence[str], float]]:
    """``endpoints``, each of them first in its turn, and how long to try that order, s; twice as long in each round.

    At the start Zenoh tries only the first one, even if it is wrong; later it goes on to the others.
    """
    while True:
        for number in range(len(endpoints)):
            yield [*endpoints[number:], *endpoints[:number]], first_s
        first_s *= 2


def in_the_background(endpoints: Sequence[str]) -> dict[str, Any]:
    """The section that connects to each of ``endpoints``, now or as soon as it is there."""
    return {"endpoints": list(endpoints), "timeout_ms": -1, "exit_on_failure": False, "retry": RETRY}


def find_protocol_problem(endpoints: Sequence[str], secured: bool) -> str:
    """Problem of the first endpoint that is secured without keys, or not secured with keys; empty if there is none."""
    for endpoint in endpoints:
        protocol, _, address = endpoint.partition("/")
        if secured and protocol != "tls":
            return f"{endpoint} is not secured, and there are keys; write tls/{address}, or give no keys"
        if protocol == "tls" and not secured:
            return f"{endpoint} needs a certificate and a private key; give their folder with --keys"
    return ""


def find_open_endpoints(endpoints: Sequence[str]) -> list[str]:
    """Those of ``endpoints`` that other hosts reach, to listen on."""
    return [endpoint for endpoint in endpoints if not _is_loopback(_host_of(endpoint))]


def _host_of(endpoint: str) -> str:
    return endpoint.partition("/")[2].rpartition(":")[0].strip("[]")


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host.partition("%")[0]).is_loopback
    except ValueError:
        return host == "localhost"
