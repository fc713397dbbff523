"""Zenoh: sessions, publishers, subscribers, presence and the router. The only module that imports it.

Endpoints are explicit: multicast scouting, gossip and shared memory are off. A session must be closed, or its process
never exits. Entities must be kept referenced, or they vanish. Nothing here may exist before a fork. With keys there are
only TLS links; both ends show a certificate, and each applies the rules of access to the other.
"""

from __future__ import annotations

import contextlib
import json
import logging
import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, cast

import zenoh

from agents.security.access import ROUTER, Access
from agents.security.credential_files import Credentials
from agents.security.credentials import Keys
from agents.transport.bus_config import (
    at_once,
    bus_config,
    find_open_endpoints,
    find_protocol_problem,
    in_the_background,
    in_turns,
)
from agents.transport.renewable_bus import Declaration, RenewableBus
from dsse_core.endpoints import check_endpoints
from dsse_core.errors import DsseError
from dsse_core.files.bounded_parsing import parse_json
from dsse_core.limits import LONGEST_S

log = logging.getLogger(__name__)
FIRST_SLICE_S, LAST_SLICE_S = 0.5, 0.01  # time for which one of several endpoints is tried
MAX_LOGGED = 1000  # links of names without rights that are logged
AnyBus = TypeVar("AnyBus", bound=RenewableBus)
Payload = TypeVar("Payload")


class TransportError(DsseError):
    """The bus cannot be reached or opened; names the endpoint."""


class Session(RenewableBus):
    """A client of one or more routers, or a peer of other processes; the session reconnects by itself."""

    @classmethod
    def connect(
        cls, endpoints: Sequence[str], timeout_s: float = 10.0, keys: Keys | None = None, *, heartbeat_s: float = 0.0
    ) -> Session:
        """Connect to the first of ``endpoints`` that answers within ``timeout_s``; with keys only a router is allowed.

        Raises:
            InvalidInputError: one is no endpoint.
            TransportError: none answers, or accepts the certificate of this process.
        """
        _check_endpoints(endpoints, keys)
        if not 0 < timeout_s <= LONGEST_S:
            raise TransportError(f"a wait of {timeout_s} s for the bus; it must be positive and at most a day")

        def open_bus(keys: Keys | None, wait_s: float) -> zenoh.Session:
            deadline = time.monotonic() + wait_s
            for order, slice_s in in_turns(endpoints, FIRST_SLICE_S):
                left_s = deadline - time.monotonic()
                try:
                    connect = at_once(order, left_s if len(endpoints) == 1 else min(slice_s, left_s))
                    return _open(bus_config("client", keys, (ROUTER,), heartbeat_s, connect=connect))
                except zenoh.ZError as error:
                    if time.monotonic() >= deadline - LAST_SLICE_S:
                        raise _cannot_reach(endpoints, wait_s, keys, error) from None
                    time.sleep(LAST_SLICE_S)  # an error that comes at once comes again
            raise AssertionError("turns never end")

        return _with_watched_links(cls(open_bus, _close, keys, timeout_s), lambda _: (ROUTER,))

    @classmethod
    def meet(
        cls, endpoints: Sequence[str], listen: Sequence[str] = (), keys: Keys | None = None, *, heartbeat_s: float = 0.0
    ) -> Session:
        """Link with each of ``endpoints`` directly, as soon and as often as it is there; no router takes part.

        Messages between two other processes do not pass here. ``listen``: endpoints where others link with this one.

        Raises:
            InvalidInputError: one is no endpoint.
            TransportError: an endpoint to listen on is occupied or cannot be opened.
        """
        _check_endpoints(endpoints, keys, listen)
        _log_rejected_links(keys if listen else None)
        warn_of_strangers(listen, keys is not None)

        def open_bus(keys: Keys | None, _: float) -> zenoh.Session:
            meets = _met_directly(keys) if keys else ()
            sections: dict[str, Any] = {
                "listen": {"endpoints": list(listen), "exit_on_failure": True},
                "connect": in_the_background(endpoints),
            }
            try:
                return _open(bus_config("peer", keys, meets, heartbeat_s, **sections))
            except zenoh.ZError as error:
                raise _cannot_listen(listen, error) from None

        return _with_watched_links(cls(open_bus, _close, keys), _met_directly)

    @classmethod
    def join(
        cls,
        endpoints: Sequence[str],
        timeout_s: float = 10.0,
        keys: Keys | None = None,
        *,
        heartbeat_s: float = 0.0,
        direct: bool = False,
    ) -> Session:
        """``connect`` to one of the routers at ``endpoints``, or, if ``direct``, ``meet`` all areas there."""
        if direct:
            return cls.meet(endpoints, keys=keys, heartbeat_s=heartbeat_s)
        return cls.connect(endpoints, timeout_s, keys, heartbeat_s=heartbeat_s)

    def is_linked(self) -> bool:
        """True where there is a link to a router, or to a process met directly."""
        bus = cast("zenoh.Session | None", self.bus)
        return bus is not None and any((bus.info.routers_zid(), bus.info.peers_zid()))

    def publisher(self, key: str) -> Callable[[bytes], None]:
        """A function that puts a payload on ``key``; while links are closed for a renewal, the payload is lost."""
        declared = self.declare(
            lambda bus: bus.declare_publisher(
                key,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.DATA_HIGH,
                express=True,
            )
        )

        def put(payload: bytes) -> None:
            if (publisher := declared.entity) is not None:
                publisher.put(payload)

        return put

    def subscribe(self, key_expression: str, callback: Callable[[str, bytes], None]) -> Declaration:
        """Call ``callback(key, payload)`` for every message, on the receiving thread; the callback must return at once.

        The result may be given to ``withdraw``.
        """

        def declare(bus: zenoh.Session) -> Any:
            def on_sample(sample: zenoh.Sample) -> None:
                if self.is_open(bus):
                    callback(str(sample.key_expr), sample.payload.to_bytes())

            return bus.declare_subscriber(key_expression, _directly(on_sample))

        return self.declare(declare)

    def declare_presence(self, key: str) -> None:
        """Show a liveliness token on ``key`` until the session closes or the process dies."""
        self.declare(lambda bus: bus.liveliness().declare_token(key))

    def find_presence(self, key_expression: str, timeout_s: float) -> tuple[str, ...]:
        """The keys of all tokens that are there, as the bus answers within ``timeout_s``; see ``watch_presence``."""
        bus = cast("zenoh.Session | None", self.bus)
        replies = bus.liveliness().get(key_expression, timeout=timeout_s) if bus is not None else ()
        return tuple(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)

    def watch_presence(self, key_expression: str, callback: Callable[[str, bool], None]) -> None:
        """Call ``callback(key, alive)`` for every token, those already there included.

        Watch tokens by name: a wildcard that matches the tokens of strangers blocks the router when they leave, also
        after the wildcard was asked for (``coordinator/watch/observe/watched_keys.py``).

        After ``interrupt`` no token counts until it is seen again: the ends of tokens are not reported.
        """

        def declare(bus: zenoh.Session) -> Any:
            def on_sample(sample: zenoh.Sample) -> None:
                if self.is_open(bus):
                    callback(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

            return bus.liveliness().declare_subscriber(key_expression, _directly(on_sample), history=True)

        self.declare(declare)


class Router(RenewableBus):
    """A Zenoh router inside this process."""

    endpoints: tuple[str, ...] = ()

    @classmethod
    def listen(
        cls,
        endpoints: Sequence[str],
        keys: Keys | None = None,
        others: Sequence[str] = (),
        *,
        heartbeat_s: float = 0.0,
        access: Access | None = None,
    ) -> Router:
        """Open a router on ``endpoints``; port 0 takes a free one, which ``Router.endpoints`` names.

        ``others``: routers to link with, as soon and as often as they are there; linked routers are one bus.
        ``heartbeat_s``: of the processes that will link with the router. Without ``keys`` every process with a link may
        publish, under any name, or, with ``access``, under the names of the processes of that run. Zenoh logs
        rejections on standard output: links at level ``warn``, messages at
        ``RUST_LOG=zenoh::net::routing::interceptor=trace``.

        Raises:
            InvalidInputError: one is no endpoint.
            TransportError: an endpoint is occupied or cannot be opened.
        """
        _check_endpoints(others, keys, endpoints)
        _log_rejected_links(keys)
        warn_of_strangers(endpoints, keys is not None)
        bound = tuple(endpoints)

        def open_bus(keys: Keys | None, _: float) -> zenoh.Session:
            meets = keys.access.names if keys else ()
            sections: dict[str, Any] = {
                "listen": {"endpoints": list(bound), "exit_on_failure": True},
                "connect": in_the_background(others),
                "adminspace": {"enabled": True},
            }
            try:
                return _open(bus_config("router", keys, meets, heartbeat_s, access, **sections))
            except zenoh.ZError as error:
                raise _cannot_listen(bound, error) from None

        router = _with_watched_links(cls(open_bus, _close, keys), lambda keys: keys.access.names)
        router.endpoints = _locators(cast(zenoh.Session, router.bus))
        if any(endpoint.endswith(":0") for endpoint in endpoints):
            bound = router.endpoints  # where other processes look for the router when it opens again
        return router


def _open(config: dict[str, Any]) -> zenoh.Session:
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


def _close(session: zenoh.Session) -> None:
    with contextlib.suppress(zenoh.ZError):  # a link that no longer answers; it is given up anyway
        session.close()  # type: ignore[no-untyped-call]


def _met_directly(keys: Keys) -> Sequence[str]:
    return keys.access.met_directly_by(keys.name)


def _with_watched_links(bus: AnyBus, meets: Callable[[Keys], Sequence[str]]) -> AnyBus:
    """Log links with processes that have no rights here, also those found where another process was expected.

    ``meets``: names that the rules of some keys allow at the other ends of links; the keys in use may be renewed.
    """
    if bus.keys is None:
        return bus
    logged: set[tuple[str, str]] = set()

    def on_link(event: zenoh.LinkEvent) -> None:
        endpoint, name = event.link.dst, event.link.auth_identifier or ""
        has_rights = bus.keys is not None and name in meets(bus.keys) and name not in bus.keys.access.revoked
        if (
            event.kind == zenoh.SampleKind.PUT
            and not has_rights
            and (endpoint, name) not in logged
            and len(logged) < MAX_LOGGED
        ):
            logged.add((endpoint, name))
            log.warning("%s shows the certificate of %r, a name without rights here: no message passes", endpoint, name)

    bus.declare(lambda opened: opened.info.declare_link_events_listener(_directly(on_link), history=True))
    return bus


def _directly(callback: Callable[[Payload], None]) -> zenoh.handlers.Callback[Payload]:
    """A callback without a Python thread for every subscriber, which would cost memory and changes of threads."""
    return zenoh.handlers.Callback(callback, indirect=False)


def _check_endpoints(endpoints: Sequence[str], keys: Keys | None, listen: Sequence[str] = ()) -> None:
    """Check that all ``endpoints``, and those to ``listen`` on, can be given to Zenoh.

    Raises:
        InvalidInputError: one is no endpoint.
        TransportError: the first that is secured without keys, or not secured with keys.
    """
    check_endpoints("endpoints to listen on", listen, listens=True)
    check_endpoints("endpoints", endpoints)
    if problem := find_protocol_problem([*listen, *endpoints], keys is not None):
        raise TransportError(problem)


def warn_of_strangers(listen: Sequence[str], secured: bool) -> None:
    """Log the endpoints of ``listen`` that other hosts reach, where links need no keys."""
    if not secured and (open_endpoints := find_open_endpoints(listen)):
        log.warning(
            "this process listens without keys on %s: any process that reaches it may receive and send everything; "
            "give --keys, or listen on 127.0.0.1",
            ", ".join(open_endpoints),
        )


def _log_rejected_links(keys: Keys | None) -> None:
    """Let Zenoh write rejected links on standard output, but not that a process is not there yet."""
    if keys:
        zenoh.init_log_from_env_or("warn,zenoh::net::runtime::orchestrator=error")


def _cannot_reach(endpoints: Sequence[str], wait_s: float, keys: Keys | None, error: Exception) -> TransportError:
    return TransportError(
        f"cannot reach {', '.join(endpoints)} within {wait_s:g} s: "
        f"{_reason(endpoints, keys.credentials if keys else None) or _short(error)}; is the router running "
        "(dsse router), is the endpoint right (e.g. tcp/127.0.0.1:7447), and have both sides keys of one "
        "authority, or none?"
    )


def _cannot_listen(endpoints: Sequence[str], error: Exception) -> TransportError:
    return TransportError(
        f"cannot listen on {', '.join(endpoints)}: {_short(error)}; is the port taken by another "
        "program? Choose another, or port 0 for a free one"
    )


def _locators(session: zenoh.Session) -> tuple[str, ...]:
    """The endpoints that this router really listens on, from its own administration space."""
    deadline = time.monotonic() + 5.0
    while time.monotonic() < deadline:
        for reply in session.get(f"@/{session.zid()}/router", timeout=1.0):
            if reply.ok is not None and (locators := parse_json(reply.ok.payload.to_string()).get("locators")):
                return tuple(locators)
    raise TransportError("the router does not say where it listens; this is a defect, please report it")


def _reason(endpoints: Sequence[str], credentials: Credentials | None) -> str:
    """Reasons why secured endpoints and this process reject each other; empty if that is not the problem."""
    if credentials is None:
        return ""
    from agents.security.certificate_checks import explain_rejection  # not needed without keys

    reasons = {endpoint: explain_rejection(endpoint, credentials) for endpoint in endpoints}
    return "; ".join(f"{endpoint}: {reason}" for endpoint, reason in reasons.items() if reason)


def _short(error: Exception) -> str:
    """The first sentence of Zenoh's error, without its source locations."""
    return str(error).split(" at ", 1)[0].strip().rstrip(".")
