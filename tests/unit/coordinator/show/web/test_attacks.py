"""Requests as strangers write them, on a real socket: what is answered, and that others are answered still."""

from __future__ import annotations

import resource
import socket
from collections.abc import Iterator
from contextlib import ExitStack

import httpx
import pytest

from coordinator.show.web import readers
from coordinator.watch import http_front
from tests.support.served import client, played, serving, wait_for

HEAD = b"GET /health HTTP/1.1\r\nHost: {host}\r\n"
NEXT = b"GET /api/now HTTP/1.1\r\nHost: {host}\r\n\r\n"
TOKEN = "0123456789abcdef"


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    with serving(played()) as url:
        yield url


def answers(url: str, request: bytes) -> tuple[list[int], bytes]:
    """Status of each answer to ``request``, and all that came until the server closed the connection."""
    host, port = url.removeprefix("http://").rstrip("/").split(":")
    with socket.create_connection((host, int(port)), timeout=180) as link:
        received = b""
        try:
            link.sendall(request.replace(b"{host}", f"{host}:{port}".encode()))
            while piece := link.recv(65536):
                received += piece
        except OSError:  # it closes before it has read all
            pass
    return [int(part[:3]) for part in received.split(b"HTTP/1.1 ")[1:]], received


@pytest.mark.parametrize(
    ("status", "rest"),
    [
        (400, b"Content-Length: 4\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n" + NEXT),
        (400, b"Transfer-Encoding: chunked\r\n\r\n0\r\n\r\n" + NEXT),
        (400, b"Content-Length: 5\r\n\r\nhello" + NEXT),
        (400, b"Content-Length: 5000\r\n\r\nh"),
        (400, b"Content-Length: 0\r\nContent-Length: 50\r\n\r\n" + NEXT),
        (400, b"Content-Length: -1\r\n\r\n" + NEXT),
        (400, b"Content-Length: +0\r\n\r\n" + NEXT),
        (400, b"Transfer-Encoding: xchunked\r\n\r\n" + NEXT),
        (400, b"X : a\r\n\r\n" + NEXT),
        (400, b"X: a\rb\r\n\r\n" + NEXT),
        (400, b"X: a\x00b\r\n\r\n" + NEXT),
        (400, b"Host: evil.example\r\n\r\n" + NEXT),
    ],
)
def test_what_one_reader_sends_is_never_taken_for_two_requests(url: str, status: int, rest: bytes) -> None:
    assert answers(url, HEAD + rest)[0] == [status]


@pytest.mark.parametrize(
    ("status", "line"),
    [
        *(
            (404, f"GET /static/{path} HTTP/1.1")
            for path in ("../app.py", "%2e%2e/app.py", "..%2fapp.py", "..\\app.py")
        ),
        *(
            (404, f"GET {path} HTTP/1.1")
            for path in ("/static//etc/passwd", "/static/%2fetc/passwd", "//static/main.js")
        ),
        *((404, f"GET /static/{path} HTTP/1.1") for path in ("%00", "main.js%00.html", "%ff", "vendor/", "a/" * 4000)),
        *((404, f"GET /api/frame/{number} HTTP/1.1") for number in (-1, 10**30, "9" * 6000, "%D9%A3", "0x1", "")),
        *((405, f"{method} /health HTTP/1.1") for method in ("POST", "OPTIONS", "TRACE", "CONNECT", "get", "ANY")),
        *(
            (400, f"GET /api/history?{query} HTTP/1.1")
            for query in ("", "kind=bus&id=%D9%A3", "a=1&" * 3000, "%00=%zz")
        ),
        (200, "GET /health HTTP/1.1\r\nConnection: Upgrade, HTTP2-Settings\r\nUpgrade: h2c\r\nHTTP2-Settings: AAMA"),
        (200, "GET /health HTTP/1.1\r\nConnection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13"),
        (400, f"GET /static/main.js HTTP/1.1\r\nRange: bytes=0-{'9' * 5000}"),
        (400, "GET /static/main.js HTTP/1.1\r\nRange: lines=1-2"),
        *((403, f"GET /health HTTP/1.1\r\nOrigin: {origin}") for origin in ("null", "", "http://[::1", "file:///x")),
        (403, "GET /health HTTP/1.1\r\nOrigin: http://{host}\r\nOrigin: http://evil.example"),
    ],
)
def test_odd_paths_methods_and_headers_are_refused_in_words(url: str, status: int, line: str) -> None:
    first, _, more = line.partition("\r\n")
    headers = ["Host: {host}", "Connection: close", *filter(None, [more])]
    seen, received = answers(url, "\r\n".join([first, *headers, "", ""]).encode())
    assert seen == [status]
    assert b"content-security-policy" in received
    assert b"root:" not in received


@pytest.mark.parametrize("name", ["LOCALHOST:{port}", "[::1]:{port}", "127.0.0.1:{port}"])
def test_the_server_answers_to_its_names_in_any_case(url: str, name: str) -> None:
    port = url.rstrip("/").rsplit(":", 1)[1]
    assert httpx.get(f"{url}health", headers={"host": name.format(port=port)}, timeout=60).status_code == 200


@pytest.mark.parametrize("name", ["localhost.:{port}", "[::1%lo]:{port}", "127.1:{port}", "2130706433:{port}", "evil"])
def test_it_answers_to_no_other_name(url: str, name: str) -> None:
    port = url.rstrip("/").rsplit(":", 1)[1]
    assert httpx.get(f"{url}health", headers={"host": name.format(port=port)}, timeout=60).status_code == 421


@pytest.mark.parametrize("headers", [b"X: b\r\n" * 20_000, b"X: " + b"b" * 100_000 + b"\r\n"])
def test_headers_without_end_are_not_read(url: str, headers: bytes) -> None:
    assert 200 not in answers(url, HEAD + b"Connection: close\r\n" + headers + b"\r\n")[0]
    assert httpx.get(f"{url}health", timeout=60).status_code == 200


def test_an_answer_to_a_defect_says_what_a_page_may_do(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(number: int) -> bytes:
        raise RuntimeError("a defect")

    source = played()
    monkeypatch.setattr(type(source), "frame", lambda _, number: fails(number))
    with serving(source) as url:
        seen, received = answers(url, b"GET /api/frame/0 HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n")
    assert seen == [500]
    assert b"content-security-policy" in received
    assert b"a defect" not in received


@pytest.mark.parametrize(
    ("shown", "status"),
    [
        (f"Bearer {TOKEN}", 200),
        (f"bearer {TOKEN}", 200),
        (f"Bearer  {TOKEN}", 200),
        (TOKEN, 401),
        (f"Basic {TOKEN}", 401),
        (f"Bearer{TOKEN}", 401),
        (f"Bearer {TOKEN} x", 401),
        ("Bearer", 401),
        (f"Bearer {TOKEN[:-1]}", 401),
    ],
)
def test_a_token_is_shown_as_a_bearer_shows_it(shown: str, status: int) -> None:
    assert client(played(), TOKEN).get("/api/now", headers={"authorization": shown}).status_code == status


def test_ten_thousand_silent_connections_keep_nobody_out_and_all_but_the_newest_give_way(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(readers, "REQUEST_S", 600.0)  # it is not their time that is up
    most = raise_open_files(11_000) - 1000
    with serving(played()) as url, ExitStack() as opened:
        host, port = url.removeprefix("http://").rstrip("/").split(":")
        stream = opened.enter_context(httpx.Client(timeout=60))
        events = opened.enter_context(stream.stream("GET", f"{url}api/stream")).iter_lines()
        next(events)
        silent = []
        for _ in range(most):
            link = socket.create_connection((host, int(port)), timeout=60)
            silent.append(opened.enter_context(link))
        wait_for(lambda: httpx.get(f"{url}health", timeout=60).status_code == 200)
        assert all(is_over(link) for link in silent[: most - http_front.MOST_READERS]), (
            "who is silent longest gives way"
        )
        assert next(events) is not None, "a reader that has an answer under way does not"


def raise_open_files(wanted: int) -> int:
    """How many files this process may open from now on: ``wanted``, as far as the machine allows it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, most), hard))
    return most


def is_over(link: socket.socket) -> bool:
    """Whether the server has closed it; waits for that."""
    try:
        return link.recv(1) == b""
    except ConnectionResetError:
        return True
