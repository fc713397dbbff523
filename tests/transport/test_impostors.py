"""The owner of a key is at the endpoint of somebody else: what each process sends it and receives from it there.

The certificates here are good for everything, so that only the rules are left to tell who is who.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from agents.security.access import Access
from agents.security.credentials import load_keys
from agents.transport.zenoh_bus import Router, Session, TransportError
from coordinator.lab.deployment.certificates import create_keys
from tests.support.dsse_command import free_endpoint
from tests.support.impostor import Impostor, let_listen
from tests.support.levels import further
from tests.support.waiting import wait_until

CHAIN = Access("run", {"a": ("b",), "b": ("a", "c"), "c": ("b",)}, gateways={"north": ("a", "b")})
ALL = CHAIN.names
OWN_KEYS = {
    **{
        i: (
            *(f"area/{i}/information/{j}" for j in "abc"),
            f"area/{i}/state",
            f"area/{i}/readings",
            f"live/area/{i}/1-00000001",
        )
        for i in "abc"
    },
    "plant": (*(f"telemetry/{i}/plant" for i in "abc"), "live/plant/plant/1-00000001"),
    "coordinator": ("clock", "live/coordinator/coordinator/1-00000001"),
    "gateway-north": (*(f"telemetry/{i}/north" for i in "abc"), "live/gateway/north/1-00000001"),
    "operator": tuple(f"command/{name}" for name in (*"abc", "plant")),
    "watcher": (),
}
WATCHED = ("area/*/state", "area/*/readings", "command/*", "live/*/*/*")
SUBSCRIPTIONS = {
    **{
        i: (
            f"area/*/*/{i}",
            f"telemetry/{i}/*",
            f"command/{i}",
            "clock",
            *(f"live/area/{j}/*" for j in CHAIN.neighbours[i]),
        )
        for i in "abc"
    },
    "plant": ("command/plant",),
    "coordinator": WATCHED,
    "gateway-north": ("area/*/state", "live/area/*/*"),
    "operator": WATCHED,
    "watcher": WATCHED,
}
# (who says it, key, to whom) of messages, on links without a router
MESSAGES = {
    *((i, f"area/{i}/information/{j}", j) for i in "abc" for j in CHAIN.neighbours[i]),
    *((i, f"area/{i}/state", who) for i in "abc" for who in ("coordinator", "watcher", "operator")),
    *((i, f"area/{i}/readings", who) for i in "abc" for who in ("coordinator", "watcher", "operator")),
    *((i, f"area/{i}/state", "gateway-north") for i in "ab"),
    *(("gateway-north", f"telemetry/{i}/north", i) for i in "ab"),
    *(("operator", f"command/{i}", i) for i in "abc"),
    *(("plant", f"telemetry/{i}/plant", i) for i in "abc"),
    *(("coordinator", "clock", i) for i in "abc"),
}
# (who shows it, to whom) of tokens
TOKENS = {
    (i, j)
    for i in "abc"
    for j in (*CHAIN.neighbours[i], "plant", "coordinator", "operator", "watcher", *("gateway-north",) * (i in "ab"))
}


def whole(key: str) -> str:
    return f"dsse/v3/run/{key}"


def message_keys(name: str) -> list[str]:
    return [whole(key) for key in OWN_KEYS[name] if not key.startswith("live")]


def token_keys(name: str) -> list[str]:
    return [whole(key) for key in OWN_KEYS[name] if key.startswith("live")]


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys") / "keys"
    create_keys(folder, CHAIN, days=1)
    for name in ALL:
        let_listen(folder, name)
    return folder


class Victim:
    """The session of a process as it really is, which says, shows and receives all that this process does."""

    def __init__(self, session: Session, name: str) -> None:
        self.session, self.name = session, name
        self.received: set[tuple[str, str]] = set()
        self.seen: set[str] = set()
        for expression in SUBSCRIPTIONS[name]:
            session.subscribe(whole(expression), self._note)
            session.watch_presence(whole(expression), self._note_token)
        self.puts = [(session.publisher(key), name.encode()) for key in message_keys(name)]
        for key in token_keys(name):
            session.declare_presence(key)

    def _note(self, key: str, payload: bytes) -> None:
        if payload.decode() != self.name:  # a session receives itself
            self.received.add((payload.decode(), key))

    def _note_token(self, key: str, alive: bool) -> None:
        if key not in token_keys(self.name):
            self.seen.add(key)

    def publish(self) -> None:
        for put, payload in self.puts:
            put(payload)


def exchange(victim: Victim, impostor: Impostor, until: Callable[[], bool]) -> None:
    """Let both publish everything ``until`` something holds, and a while after it."""
    impostor.listen(*(whole(e) for of in SUBSCRIPTIONS.values() for e in of))
    impostor.show(*(key for name in OWN_KEYS for key in token_keys(name)))
    puts = impostor.publish([key for name in OWN_KEYS for key in message_keys(name)])

    def publish_all() -> bool:
        victim.publish()
        for put in puts:
            put()
        return until()

    wait_until(publish_all)
    for _ in range(20):
        publish_all()


@pytest.mark.parametrize("impostor", [name for name in ALL if name != "router"])
@pytest.mark.parametrize("victim", OWN_KEYS)
def test_nobody_but_a_router_is_reported_or_received_where_a_router_is_expected(
    keys: Path, victim: str, impostor: str, caplog: pytest.LogCaptureFixture
):
    endpoint = free_endpoint("tls")
    with (
        Impostor.at(endpoint, keys, impostor) as router,
        Session.connect([endpoint], keys=load_keys(keys, victim)) as session,
    ):
        talker = Victim(session, victim)
        exchange(talker, router, lambda: f"shows the certificate of '{impostor}'" in caplog.text)
        assert not router.received
        assert not talker.received
        assert not talker.seen


@pytest.mark.parametrize("mode", ["peer", *further("router")])
@pytest.mark.parametrize(("caller", "impostor"), [(c, i) for c in OWN_KEYS for i in ALL if c != i])
def test_between_neighbours_a_key_gives_its_own_rights_at_any_endpoint(
    keys: Path, caller: str, impostor: str, mode: str
):
    endpoint = free_endpoint("tls")
    with (
        Impostor.at(endpoint, keys, impostor, mode) as other,
        Session.meet([endpoint], keys=load_keys(keys, caller)) as session,
    ):
        talker = Victim(session, caller)
        sent = {(caller, whole(key)) for who, key, whom in MESSAGES if (who, whom) == (caller, impostor)}
        received = {(impostor, whole(key)) for who, key, whom in MESSAGES if (who, whom) == (impostor, caller)}
        shown = {key for who, whom in TOKENS if (who, whom) == (impostor, caller) for key in token_keys(who)}
        linked = lambda: bool(session.bus.info.links())  # type: ignore[union-attr]  # noqa: E731
        exchange(talker, other, lambda: linked() and sent <= other.received and received <= talker.received)
        assert other.received == sent
        assert talker.received == received
        assert talker.seen <= shown


def test_a_link_to_nobody_with_a_certificate_for_calling_only_comes_about(tmp_path: Path):
    create_keys(tmp_path / "keys", CHAIN, days=1)
    endpoint = free_endpoint("tls")
    with (
        Impostor.at(endpoint, tmp_path / "keys", "c"),
        pytest.raises(TransportError, match="its certificate is rejected here: unsuitable certificate purpose"),
    ):
        Session.connect([endpoint], 0.5, load_keys(tmp_path / "keys", "a"))


def test_a_client_goes_on_to_the_true_router_if_an_area_is_at_the_endpoint_of_another(tmp_path: Path):
    create_keys(tmp_path / "keys", CHAIN, days=1)
    endpoint = free_endpoint("tls")
    with (
        Impostor.at(endpoint, tmp_path / "keys", "c"),
        Router.listen(["tls/127.0.0.1:0"], load_keys(tmp_path / "keys", "router", listens=True)) as router,
        Session.connect([endpoint, *router.endpoints], keys=load_keys(tmp_path / "keys", "a")) as session,
    ):
        assert [link.auth_identifier for link in session.bus.info.links()] == ["router"]  # type: ignore[union-attr]
