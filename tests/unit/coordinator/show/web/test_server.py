"""The server on a real socket: readers who never read, connections that never ask, certificates."""

from __future__ import annotations

import datetime
import json
import re
import socket
import ssl
from collections.abc import Callable
from contextlib import ExitStack
from itertools import islice
from pathlib import Path

import httpx
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from agents.security.access import Access
from coordinator.lab.deployment.certificates import create_keys
from coordinator.show.web import app, readers, server
from coordinator.show.web.moment import Moments
from coordinator.show.web.server import PageAddress, choose_place
from coordinator.watch import http_front
from coordinator.watch.http_front import Front
from coordinator.watch.observe.watcher import Watcher
from dsse_core.errors import InvalidInputError
from tests.support.served import live, played, serving, wait_for
from tests.support.shown_states import a_state

INVITED = r"open https://feeder\.example:8443/\?token=([\w-]{32})"
TOKEN = "0123456789abcdef"
SHOWN = {"authorization": f"Bearer {TOKEN}"}


def connect(url: str) -> socket.socket:
    host, port = url.partition("://")[2].rstrip("/").split(":")
    return socket.create_connection((host, int(port)), timeout=180)


def ask(url: str, path: str) -> socket.socket:
    link = connect(url)
    link.sendall(f"GET {path} HTTP/1.1\r\nHost: {url.removeprefix('http://').rstrip('/')}\r\n\r\n".encode())
    return link


def is_answered(url: str) -> bool:
    try:
        return bool(httpx.get(f"{url}health", timeout=60).json()["status"] == "ok")
    except httpx.TransportError:
        return False


def is_closed(link: socket.socket) -> bool:
    link.settimeout(0.05)
    try:
        return link.recv(65536) == b""
    except TimeoutError:
        return False
    except OSError:
        return True


@pytest.mark.slow
def test_twenty_browsers_see_the_same_and_one_that_never_reads_is_dropped_unnoticed(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(readers, "PATIENCE_S", 3.0)
    watcher = Watcher("run")
    n = 4000
    watcher.take_state(
        a_state(buses=tuple(range(n)), **dict.fromkeys(("vm", "va", "sigma_vm", "sigma_va"), (1.0,) * n)), 0.0
    )
    with live(watcher) as source, serving(source) as url, ExitStack() as opened:
        lazy = socket.socket()
        lazy.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        lazy.connect((url.removeprefix("http://").rstrip("/").split(":")[0], int(url.rstrip("/").rsplit(":", 1)[1])))
        opened.enter_context(lazy)
        lazy.sendall(f"GET /api/stream HTTP/1.1\r\nHost: {url.removeprefix('http://').rstrip('/')}\r\n\r\n".encode())
        browsers = [opened.enter_context(httpx.Client(base_url=url, timeout=60)) for _ in range(20)]
        streams = [opened.enter_context(browser.stream("GET", "/api/stream")) for browser in browsers]
        numbers = []
        for answer in streams:
            lines = (line for line in answer.iter_lines() if line.startswith("data: "))
            first, second = json.loads(next(lines)[6:]), json.loads(next(lines)[6:])
            numbers.append(second["number"] - first["number"])
        assert min(numbers) > 0

        def is_dropped() -> bool:
            try:
                lazy.sendall(b"\r\n")
            except OSError:
                return True
            return False

        wait_for(is_dropped)
        assert browsers[0].get("/health").json()["status"] == "ok"


def test_a_server_that_has_nothing_new_is_heard_by_the_page(monkeypatch: pytest.MonkeyPatch):
    """Who hears nothing takes it for gone; a comment in the stream would reach no script."""
    monkeypatch.setattr(app, "PULSE_S", 0.1)
    with serving(played()) as url, httpx.stream("GET", f"{url}api/stream", timeout=60) as said:
        lines = list(islice(said.iter_lines(), 9))
    assert lines[lines.index("event: pulse") + 1] == "data"


def test_connections_that_never_ask_are_closed_and_others_are_answered_meanwhile(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(readers, "REQUEST_S", 0.3)
    with serving(played()) as url, ExitStack() as opened:
        idle = [opened.enter_context(connect(url)) for _ in range(50)]
        for k, link in enumerate(idle[:25]):
            link.sendall(b"GET / HTTP/1.1\r\nHo"[: k % 18])
        wait_for(lambda: is_answered(url))  # in the time that it has, too, where this process gets no processor
        wait_for(lambda: all(is_closed(link) for link in idle))


def test_a_connection_that_dribbles_its_question_is_closed(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(readers, "REQUEST_S", 0.3)
    with serving(played()) as url, connect(url) as link:
        link.sendall(b"GET / HTTP/1.1\r\n")

        def is_ended() -> bool:
            try:
                link.sendall(b"X-a: b\r\n")
            except OSError:
                return True
            return is_closed(link)

        wait_for(is_ended)


def test_a_question_without_an_end_is_not_kept():
    with serving(played()) as url, connect(url) as link:
        link.sendall(b"GET / HTTP/1.1\r\n" + b"X-a: " + b"b" * 100_000 + b"\r\n")
        answer = link.recv(4096)
        assert answer.startswith(b"HTTP/1.1 4") or answer == b""


def test_beyond_loopback_a_certificate_a_token_and_a_name_are_needed():
    with pytest.raises(InvalidInputError) as caught:
        choose_place("0.0.0.0:8080", None, None, None, ())
    text = str(caught.value)
    assert all(word in text for word in ("--tls-cert and --tls-key", "--name"))
    assert "--token-file" not in text


def test_a_token_is_made_once_and_stands_in_the_whole_address(tmp_path: Path):
    keys = tmp_path / "keys"
    create_keys(keys, Access("run", {"area1": ()}), days=1)

    def place(token_file: Path | None, listen: str = "0.0.0.0:0") -> PageAddress:
        return choose_place(listen, keys / "router.crt", keys / "router.key", token_file, ("feeder.example",))

    first, second = (re.fullmatch(INVITED, place(None).invite("https://0.0.0.0:8443/")) for _ in range(2))
    assert first
    assert second
    assert first[1] != second[1]
    kept = place(tmp_path / "token")
    assert kept == place(tmp_path / "token")
    assert (tmp_path / "token").stat().st_mode & 0o777 == 0o600
    (tmp_path / "token").write_text("a+b/c=0123456789")
    assert "?token=a%2Bb%2Fc%3D0123456789" in place(tmp_path / "token").invite("https://0.0.0.0:8443/")
    assert (
        choose_place("127.0.0.1:0", None, None, None, ()).invite("http://127.0.0.1:80/") == "open http://127.0.0.1:80/"
    )
    proxied = choose_place("127.0.0.1:0", None, None, None, ("feeder.example",)).invite("http://127.0.0.1:80/")
    assert proxied == "through a proxy: https://feeder.example/\nopen http://127.0.0.1:80/"


@pytest.mark.parametrize(
    ("host", "is_own"),
    [
        ("feeder.example", True),
        ("feeder.example:8080", True),
        ("other.example:8443", True),
        ("other.example", False),
        ("127.0.0.1:8080", True),
        ("evil.example:8080", False),
        ("feeder.example:8443", False),
    ],
)
def test_on_loopback_a_proxy_asks_under_the_names_that_are_given(host: str, is_own: bool):
    front = Front.of("127.0.0.1", 8080, ["Feeder.example", "other.example:8443"])
    headers = [("host", host), ("origin", f"https://{host}")]
    assert (front.find_rejection("GET", headers) is None) == is_own


@pytest.mark.parametrize("listen", ["", "8080", ":8080", "127.0.0.1:", "127.0.0.1:x", "127.0.0.1:70000", "127.0.0.1:٣"])
def test_a_place_that_is_none_is_named(listen: str):
    with pytest.raises(InvalidInputError, match=r"HOST:PORT looks like 127\.0\.0\.1:8080"):
        choose_place(listen, None, None, None, ())


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (lambda keys: (keys / "router.key").unlink(), "router.key: is missing"),
        (lambda keys: (keys / "router.crt").write_text("rubbish"), "router.crt: holds no certificate in PEM"),
        (lambda keys: (keys / "router.key").write_text("rubbish"), "router.key: holds no private key in PEM"),
        (lambda keys: (keys / "area1.key").rename(keys / "router.key"), "router.key: does not belong to .*router.crt"),
        (lambda keys: encrypt(keys / "router.key"), "router.key: is protected by a password"),
        (lambda keys: let_expire(keys), "router.crt: expired at"),
        (lambda keys: ((keys / "token").unlink(), (keys / "token").mkdir()), "token: is a folder"),
    ],
)
def test_files_that_cannot_be_used_are_named_before_anything_is_served(
    tmp_path: Path, spoil: Callable[[Path], object], why: str
):
    keys = tmp_path / "keys"
    create_keys(keys, Access("run", {"area1": ()}), days=1)
    (keys / "token").write_text("0123456789abcdef\n")
    spoil(keys)
    with pytest.raises(InvalidInputError, match=why):
        choose_place("127.0.0.1:0", keys / "router.crt", keys / "router.key", keys / "token", ())


def encrypt(path: Path) -> None:
    key = serialization.load_pem_private_key(path.read_bytes(), None)
    protected = serialization.BestAvailableEncryption(b"secret")
    form = (serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8)
    path.write_bytes(key.private_bytes(*form, protected))


def let_expire(keys: Path) -> None:
    """Write a certificate of the same key that was valid until yesterday."""
    old = x509.load_pem_x509_certificate((keys / "router.crt").read_bytes())
    key = serialization.load_pem_private_key((keys / "router.key").read_bytes(), None)
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    now = datetime.datetime.now(datetime.UTC)
    days = [now - datetime.timedelta(days=number) for number in (2, 1)]
    builder = x509.CertificateBuilder(old.subject, old.subject, old.public_key(), 1, *days)
    (keys / "router.crt").write_bytes(builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM))


@pytest.mark.parametrize(("content", "why"), [(b"short", "5 characters; 16 at least"), ("ä".encode() * 16, "ASCII")])
def test_a_bad_token_is_named(tmp_path: Path, content: bytes, why: str):
    path = tmp_path / "token"
    path.write_bytes(content)
    with pytest.raises(InvalidInputError, match=why):
        choose_place("127.0.0.1:0", None, None, path, ())


@pytest.fixture
def guarded(tmp_path: Path) -> tuple[PageAddress, ssl.SSLContext]:
    """A place with TLS and the token ``TOKEN``, and what a browser trusts."""
    keys = tmp_path / "keys"
    create_keys(keys, Access("run", {"area1": ()}), days=1)
    (tmp_path / "token").write_text(f"{TOKEN}\n")
    place = choose_place("127.0.0.1:0", keys / "router.crt", keys / "router.key", tmp_path / "token", ())
    return place, ssl.create_default_context(cafile=str(keys / "authority.crt"))


def test_with_a_certificate_and_a_token_the_page_is_served_to_who_shows_it(guarded: tuple[PageAddress, ssl.SSLContext]):
    place, trusted = guarded
    with serving(played(), place) as url, httpx.Client(base_url=url, verify=trusted, timeout=60) as browser:
        assert url.startswith("https://")
        assert browser.get("/api/now").status_code == 401
        assert browser.get(f"/?token={TOKEN}", follow_redirects=True).status_code == 200
        assert browser.get("/api/now").status_code == 200


def test_a_tls_handshake_that_never_begins_does_not_hold_its_connection(
    guarded: tuple[PageAddress, ssl.SSLContext], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(readers, "HANDSHAKE_S", 0.3)
    place, trusted = guarded
    with serving(played(), place) as url, ExitStack() as opened:
        idle = [opened.enter_context(connect(url)) for _ in range(20)]
        for link in idle[:10]:
            link.sendall(b"\x16\x03\x01\x02")  # a hello that does not go on
        wait_for(lambda: all(is_closed(link) for link in idle), 30.0)  # asyncio itself waits for a minute
        assert httpx.get(f"{url}health", verify=trusted, headers=SHOWN).status_code == 200


def test_more_tls_handshakes_that_never_begin_than_there_is_room_for_keep_nobody_out(
    guarded: tuple[PageAddress, ssl.SSLContext], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(http_front, "MOST_READERS", 10)
    monkeypatch.setattr(readers, "HANDSHAKE_S", 600.0)
    place, trusted = guarded
    with serving(played(), place) as url, ExitStack() as opened:
        idle = [opened.enter_context(connect(url)) for _ in range(50)]
        wait_for(lambda: sum(map(is_closed, idle)) >= 40)
        with httpx.Client(base_url=url, verify=trusted, timeout=60) as browser:
            assert browser.get("/health", headers=SHOWN).status_code == 200


def test_a_place_that_is_taken_is_one_error_that_names_it():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        place = PageAddress("127.0.0.1", taken.getsockname()[1])
        with pytest.raises(InvalidInputError, match=rf":{place.port}: 1 problem\n  - Address already in use"):
            server.serve(played(), place, (), lambda url: None)


@pytest.mark.slow
def test_hours_of_updates_leave_the_memory_of_the_server_as_it_was():
    watcher = Watcher("run")
    moments = Moments(None)
    n, sizes = 50, []
    for scan in range(4000):
        state = a_state(buses=tuple(range(n)), **dict.fromkeys(("vm", "va", "sigma_vm", "sigma_va"), (1.0,) * n))
        watcher.take_state(state, float(scan))
        moments._scans_kept = None
        moments.make(watcher, float(scan), float(scan))
        sizes.append(sum(series.bytes for series in moments.history.of.values()))
    assert len(moments.events.kept) <= 200
    assert max(sizes) <= 64 * 1024 * 1024
