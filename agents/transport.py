"""Zenoh: sessions, publishers, subscribers, presence and the router. The only module that imports it.

Endpoints are explicit: multicast scouting, gossip and shared memory are off. A session must be closed, or
its process never exits; entities are kept referenced, or they vanish; nothing here may exist before a fork.
With credentials there are TLS links only, both ends show a certificate, and a router applies the rules of access.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Self

import zenoh

from agents.access import Access, zenoh_access_control
from agents.credentials import Credentials
from agents.messages import MAX_BYTES
from dsse_core.errors import DsseError
from dsse_core.limits import LONGEST_S

SHORTEST_LEASE_S = 2.0
LEASE_BEATS = 3  # by then, what has come over the link is stale anyway; where there are many, beats are long
RETRY = {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 2}


class TransportError(DsseError):
    """The bus cannot be reached or opened; names the endpoint."""


def _config(mode: str, credentials: Credentials | None = None, beat_s: float = 0.0, **sections: Any) -> zenoh.Config:
    """``beat_s``: that of who speaks here; the other end waits for a sign of life as long as that allows."""
    return zenoh.Config.from_json5(
        json.dumps(
            {
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
                        **_tls(credentials),
                        "tx": {
                            "lease": int(1000 * max(SHORTEST_LEASE_S, LEASE_BEATS * beat_s)),
                            "keep_alive": 4,
                            "queue": {"congestion_control": {"block": {"wait_before_close": 1_000_000}}},
                        },
                        "rx": {"max_message_size": MAX_BYTES},
                    },
                },
                **sections,
            }
        )
    )


def _tls(credentials: Credentials | None) -> dict[str, Any]:
    """Show one's own certificate in both directions, and insist on the other's."""
    if credentials is None:
        return {}
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


def _check_protocol(endpoints: Sequence[str], credentials: Credentials | None) -> None:
    """Raise TransportError for the first endpoint that does not fit to having keys, or having none."""
    for endpoint in endpoints:
        protocol, _, place = endpoint.partition("/")
        if credentials and protocol != "tls":
            raise TransportError(f"{endpoint} is not secured, and there are keys; write tls/{place}, or give no keys")
        if protocol == "tls" and not credentials:
            raise TransportError(f"{endpoint} needs a certificate and a private key; give their folder with --keys")


def _in_the_background(endpoints: Sequence[str]) -> dict[str, Any]:
    """Connect to each of ``endpoints``, now or whenever it is there."""
    return {"endpoints": list(endpoints), "timeout_ms": -1, "exit_on_failure": False, "retry": RETRY}


def _access_control(access: Access | None) -> dict[str, Any]:
    return {"access_control": zenoh_access_control(access)} if access else {}


def _log_refused_links(credentials: Credentials | None) -> None:
    """Let Zenoh write on standard output whom it refused; not that somebody is not there yet."""
    if credentials:
        zenoh.init_log_from_env_or("warn,zenoh::net::runtime::orchestrator=error")


def _cannot_listen(endpoints: Sequence[str], error: Exception) -> TransportError:
    return TransportError(
        f"cannot listen on {', '.join(endpoints)}: {_short(error)}; is the port taken by another "
        "program? Choose another, or port 0 for a free one"
    )


class _Closing:
    """A Zenoh session that closes with its block."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._kept: list[Any] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the session; later calls do nothing."""
        self._kept.clear()
        with contextlib.suppress(zenoh.ZError):  # a link that no longer answers; the process is leaving anyway
            self._session.close()  # type: ignore[no-untyped-call]


class Session(_Closing):
    """A client of one or more routers, or a peer of some others; it reconnects by itself."""

    @classmethod
    def connect(
        cls,
        endpoints: Sequence[str],
        timeout_s: float = 10.0,
        credentials: Credentials | None = None,
        *,
        beat_s: float = 0.0,
    ) -> Session:
        """Connect to the first of ``endpoints`` that answers within ``timeout_s``.

        Raises:
            TransportError: none answers, or takes our certificate, or one is not a Zenoh endpoint.
        """
        _check_protocol(endpoints, credentials)
        if not 0 < timeout_s <= LONGEST_S:
            raise TransportError(f"a wait of {timeout_s} s for the bus; it must be positive and at most a day")
        connect = {
            "endpoints": list(endpoints),
            "timeout_ms": int(timeout_s * 1000),
            "exit_on_failure": True,
            "retry": RETRY,
        }
        try:
            return cls(zenoh.open(_config("client", credentials, beat_s, connect=connect)))
        except zenoh.ZError as error:
            raise TransportError(
                f"cannot reach {', '.join(endpoints)} within {timeout_s:g} s: "
                f"{_reason(endpoints, credentials) or _short(error)}; is the router running (dsse router), "
                "is the endpoint right (e.g. tcp/127.0.0.1:7447), and have both sides keys of one authority, or none?"
            ) from None

    @classmethod
    def meet(
        cls,
        endpoints: Sequence[str],
        listen: Sequence[str] = (),
        credentials: Credentials | None = None,
        access: Access | None = None,
        *,
        beat_s: float = 0.0,
    ) -> Session:
        """Link with each of ``endpoints`` directly, as soon and as often as it is there; no router takes part.

        What passes between two others does not pass here. ``listen``: where others link with us. ``access``: who may
        speak here.

        Raises:
            TransportError: an endpoint to listen on is occupied or cannot be opened.
        """
        _check_protocol([*endpoints, *listen], credentials)
        _log_refused_links(credentials if listen else None)
        try:
            config = _config(
                "peer",
                credentials,
                beat_s,
                listen={"endpoints": list(listen), "exit_on_failure": True},
                connect=_in_the_background(endpoints),
                **_access_control(access),
            )
            return cls(zenoh.open(config))
        except zenoh.ZError as error:
            raise _cannot_listen(listen, error) from None

    @classmethod
    def join(
        cls,
        endpoints: Sequence[str],
        timeout_s: float = 10.0,
        credentials: Credentials | None = None,
        *,
        beat_s: float = 0.0,
        direct: bool = False,
    ) -> Session:
        """``connect`` to one of the routers at ``endpoints``, or, ``direct``, ``meet`` all areas there."""
        if direct:
            return cls.meet(endpoints, credentials=credentials, beat_s=beat_s)
        return cls.connect(endpoints, timeout_s, credentials, beat_s=beat_s)

    def publisher(self, key: str) -> Callable[[bytes], None]:
        """A function that puts a payload on ``key``."""
        publisher = self._session.declare_publisher(
            key,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA_HIGH,
            express=True,
        )
        self._kept.append(publisher)
        return publisher.put

    def subscribe(self, key_expression: str, callback: Callable[[str, bytes], None]) -> None:
        """Call ``callback(key, payload)`` for every message, on the thread that receives; it must return at once."""

        def on_sample(sample: zenoh.Sample) -> None:
            callback(str(sample.key_expr), sample.payload.to_bytes())

        self._kept.append(self._session.declare_subscriber(key_expression, _directly(on_sample)))

    def declare_presence(self, key: str) -> None:
        """Show a liveliness token on ``key`` until the session closes or the process dies."""
        self._kept.append(self._session.liveliness().declare_token(key))

    def watch_presence(self, key_expression: str, callback: Callable[[str, bool], None]) -> None:
        """Call ``callback(key, alive)`` for every token, those already there included."""

        def on_sample(sample: zenoh.Sample) -> None:
            callback(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        self._kept.append(
            self._session.liveliness().declare_subscriber(key_expression, _directly(on_sample), history=True)
        )


def _directly(callback: Callable[[zenoh.Sample], None]) -> zenoh.handlers.Callback[zenoh.Sample]:
    """Without a Python thread of its own for every subscriber, which costs memory and changes of threads."""
    return zenoh.handlers.Callback(callback, indirect=False)


class Router(_Closing):
    """A Zenoh router inside this process."""

    endpoints: tuple[str, ...] = ()

    @classmethod
    def listen(
        cls,
        endpoints: Sequence[str],
        credentials: Credentials | None = None,
        access: Access | None = None,
        others: Sequence[str] = (),
        *,
        beat_s: float = 0.0,
    ) -> Router:
        """Open a router on ``endpoints``; port 0 takes a free one, ``Router.endpoints`` says which.

        ``others``: routers to link with, as soon and as often as they are there; linked routers are one bus.
        ``beat_s``: of those who will link with it. ``access``: who may speak; without it everybody may who gets a link.
        What is refused is logged on standard output by Zenoh: links at level ``warn``, messages at
        ``RUST_LOG=zenoh::net::routing::interceptor=trace``.

        Raises:
            TransportError: an endpoint is occupied or cannot be opened.
        """
        _check_protocol([*endpoints, *others], credentials)
        _log_refused_links(credentials)
        try:
            session = zenoh.open(
                _config(
                    "router",
                    credentials,
                    beat_s,
                    listen={"endpoints": list(endpoints), "exit_on_failure": True},
                    connect=_in_the_background(others),
                    adminspace={"enabled": True},
                    **_access_control(access),
                )
            )
        except zenoh.ZError as error:
            raise _cannot_listen(endpoints, error) from None
        router = cls(session)
        router.endpoints = _locators(session)
        return router


def _locators(session: zenoh.Session) -> tuple[str, ...]:
    """The endpoints that this router really listens on, from its own administration space."""
    deadline = time.monotonic() + 5.0
    while time.monotonic() < deadline:
        for reply in session.get(f"@/{session.zid()}/router", timeout=1.0):
            if reply.ok is not None and (locators := json.loads(reply.ok.payload.to_string()).get("locators")):
                return tuple(locators)
    raise TransportError("the router does not say where it listens; this is a defect, please report it")


def _reason(endpoints: Sequence[str], credentials: Credentials | None) -> str:
    """What a secured endpoint and we have against each other; empty if that is not the reason."""
    if credentials is None:
        return ""
    from agents.certificate_checks import explain_refusal  # whoever has no keys need not wait for it

    reasons = {endpoint: explain_refusal(endpoint, credentials) for endpoint in endpoints}
    return "; ".join(f"{endpoint}: {reason}" for endpoint, reason in reasons.items() if reason)


def _short(error: Exception) -> str:
    """The first sentence of Zenoh's error, without its source locations."""
    return str(error).split(" at ", 1)[0].strip().rstrip(".")
