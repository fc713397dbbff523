"""Certificates on real links: what is delivered, at a router, and what happens at expiry."""

from __future__ import annotations

import shutil
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest

from agents.security.access import Access
from agents.security.access_file import ACCESS_FILE, load_access, save_access
from agents.security.credentials import load_keys
from agents.transport.zenoh_bus import Router, Session, TransportError
from coordinator.lab.deployment.certificates import create_keys
from tests.support.expiring import let_expire
from tests.support.waiting import DEADLINE_S, wait_until

CHAIN = Access("run", {"a": ("b",), "b": ("a", "c"), "c": ("b",)}, gateways={"north": ("a", "b"), "south": ("c",)})
NAMES = ("a", "b", "c", "plant", "coordinator", "operator", "watcher", "gateway-north", "gateway-south")
SUBSCRIPTIONS = {
    **{area: (f"area/*/*/{area}", f"telemetry/{area}/*", f"command/{area}") for area in CHAIN.neighbours},
    "plant": ("command/plant",),
    **dict.fromkeys(("operator", "gateway-north", "gateway-south"), ("area/*/state",)),
    **dict.fromkeys(("coordinator", "watcher"), ("area/*/state", "area/*/readings", "command/*")),
}
KEYS = (
    *(f"area/{i}/information/{j}" for i in "abc" for j in "abc"),
    *(f"area/{i}/{kind}" for i in "abc" for kind in ("state", "readings")),
    *(f"telemetry/{i}/{gateway}" for i in "abc" for gateway in ("plant", "north", "south")),
    *(f"command/{name}" for name in ("a", "b", "c", "plant")),
)
DELIVERED = {
    ("a", "area/a/information/b", "b"),
    ("b", "area/b/information/a", "a"),
    ("b", "area/b/information/c", "c"),
    ("c", "area/c/information/b", "b"),
    *((area, f"area/{area}/state", who) for area in "abc" for who in ("coordinator", "watcher", "operator")),
    *((area, f"area/{area}/readings", who) for area in "abc" for who in ("coordinator", "watcher")),
    *(("plant", f"telemetry/{area}/plant", area) for area in "abc"),
    *(
        message
        for gateway, areas in CHAIN.gateways.items()
        for area in areas
        for message in (
            (f"gateway-{gateway}", f"telemetry/{area}/{gateway}", area),
            (area, f"area/{area}/state", f"gateway-{gateway}"),
        )
    ),
    *(("operator", f"command/{to}", who) for to in ("a", "b", "c", "plant") for who in (to, "coordinator", "watcher")),
}

Received = set[tuple[str, str, str]]


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys") / "keys"
    create_keys(folder, CHAIN, days=1)
    return folder


@pytest.fixture
def router(keys: Path) -> Iterator[Router]:
    with Router.listen(["tls/127.0.0.1:0"], load_keys(keys, "router", listens=True)) as router:
        yield router


@pytest.fixture
def join(keys: Path, router: Router) -> Iterator[Callable[[str], Session]]:
    with ExitStack() as opened:
        yield lambda name: opened.enter_context(Session.connect(router.endpoints, keys=load_keys(keys, name)))


def listen(session: Session, name: str, received: Received) -> None:
    """Note (who says it, key, ``name``) of all that arrives at ``name``, in ``received``."""

    def note(key: str, payload: bytes) -> None:
        received.add((payload.decode(), key.removeprefix("dsse/v3/run/"), name))

    for expression in SUBSCRIPTIONS.get(name, ()):
        session.subscribe(f"dsse/v3/run/{expression}", note)


def publish_all(session: Session, name: str) -> list[Callable[[], None]]:
    """Functions that say ``name`` on every key there is, what is rejected first."""
    keys = sorted(KEYS, key=lambda key: any(key == k for who, k, _ in DELIVERED if who == name))
    publishers = [session.publisher(f"dsse/v3/run/{key}") for key in keys]
    return [lambda put=put: put(name.encode()) for put in publishers]  # type: ignore[misc]


def test_of_all_that_anybody_publishes_only_what_is_allowed_is_delivered(join: Callable[[str], Session]):
    received: Received = set()
    for name in NAMES:
        listen(join(name), name, received)
    puts = [put for name in NAMES for put in publish_all(join(name), name)]

    def publish_until_received() -> bool:
        for put in puts:
            put()
        return received >= DELIVERED

    wait_until(publish_until_received)
    assert publish_until_received()  # once more, now that everybody knows who listens
    assert received == DELIVERED


def test_a_certificate_that_expires_in_operation_ends_its_link(
    keys: Path, tmp_path: Path, router: Router, join: Callable[[str], Session]
):
    changes: list[tuple[str, bool]] = []
    join("coordinator").watch_presence("dsse/v3/run/live/*/*/*", lambda key, alive: changes.append((key, alive)))
    short = tmp_path / "short"
    short.mkdir()
    for path in keys.iterdir():
        (short / path.name).write_bytes(path.read_bytes())
        (short / path.name).chmod(0o600)
    let_expire(short, "a", in_s=12.0)
    token = "dsse/v3/run/live/area/a/1-2"
    with Session.connect(router.endpoints, keys=load_keys(short, "a")) as session:
        session.declare_presence(token)
        wait_until(lambda: (token, True) in changes)
        wait_until(lambda: (token, False) in changes)


def test_while_both_authorities_are_believed_old_and_new_keys_link(keys: Path, tmp_path: Path):
    create_keys(tmp_path / "new", CHAIN, days=1)
    both = (keys / "authority.crt").read_bytes() + (tmp_path / "new" / "authority.crt").read_bytes()
    for name, folder in (("changing", keys), ("changed", tmp_path / "new")):
        shutil.copytree(folder, tmp_path / name)
        (tmp_path / name / "authority.crt").write_bytes(both)
    for first, second in (("changing", "changed"), ("changed", "changing")):
        with (
            Router.listen(["tls/127.0.0.1:0"], load_keys(tmp_path / first, "router", listens=True)) as router,
            Session.connect(router.endpoints, DEADLINE_S, load_keys(tmp_path / second, "a")) as session,
        ):
            assert session.bus is not None


def test_a_router_opens_again_at_the_endpoints_where_it_was(keys: Path):
    changes: list[bool] = []
    with (
        Router.listen(["tls/127.0.0.1:0"], load_keys(keys, "router", listens=True)) as router,
        Session.connect(router.endpoints, keys=load_keys(keys, "coordinator")) as watcher,
        Session.connect(router.endpoints, keys=load_keys(keys, "a")) as area,
    ):
        watcher.watch_presence("dsse/v3/run/live/*/*/*", lambda key, alive: changes.append(alive))
        area.declare_presence("dsse/v3/run/live/area/a/1-2")
        wait_until(lambda: changes == [True])
        assert router.interrupt()
        wait_until(lambda: changes == [True, False])
        router.resume()
        wait_until(lambda: changes == [True, False, True])


def test_a_router_whose_rules_name_others_than_before_opens_again_with_these(keys: Path, tmp_path: Path):
    folder = tmp_path / "keys"
    shutil.copytree(keys, folder)
    access = load_access(folder / ACCESS_FILE)
    with Router.listen(["tls/127.0.0.1:0"], load_keys(folder, "router", listens=True)) as router:
        for gateways in ({**access.gateways, "new": ("a",)}, {}):
            save_access(folder / ACCESS_FILE, replace(access, gateways=gateways))
            assert router.interrupt()
            router.resume()
            wait_until(lambda: router.bus is not None)
            with Session.connect(router.endpoints, DEADLINE_S, load_keys(folder, "a")):
                pass


def test_broken_handshakes_at_one_port_of_a_router_do_not_keep_links_at_another_waiting(keys: Path):
    own = load_keys(keys, "a")
    two = ["tls/127.0.0.1:0", "tls/127.0.0.1:0"]
    with Router.listen(two, load_keys(keys, "router", listens=True)) as router:
        flooded, private = router.endpoints
        host, _, port = flooded.partition("/")[2].rpartition(":")
        for _ in range(400):  # the router waits 0.1 s after each
            with socket.create_connection((host, int(port))) as link:
                link.sendall(b"rubbish")
        with Session.connect([private], DEADLINE_S, own):
            pass
        with pytest.raises(TransportError):  # or the flood was none
            Session.connect([flooded], 0.5, own)


def test_with_keys_no_link_is_open(keys: Path):
    own, endpoint = load_keys(keys, "a"), "tcp/127.0.0.1:7447"
    for opening in (
        lambda: Session.connect([endpoint], keys=own),
        lambda: Session.meet([endpoint], keys=own),
        lambda: Router.listen([endpoint], own),
    ):
        with pytest.raises(TransportError, match=r"is not secured, and there are keys; write tls/127\.0\.0\.1:7447"):
            opening()


def test_a_router_that_was_called_by_a_name_not_in_its_certificate_is_rejected_with_the_reason(keys: Path):
    with (
        Router.listen(["tls/127.0.0.2:0"], load_keys(keys, "router", listens=True)) as router,
        pytest.raises(TransportError) as caught,
    ):
        Session.connect(router.endpoints, 0.5, load_keys(keys, "a"))
    assert "its certificate is rejected here" in str(caught.value)
    assert "127.0.0.2" in str(caught.value)
