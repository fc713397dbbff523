"""Who may look: every request is checked before anything is answered, and every answer says what a page may do."""

from __future__ import annotations

import hmac
from collections.abc import Sequence
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

COOKIE = "dsse-token"
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)
SECURITY_HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}
LAST = {"connection": "close"}  # after an answer to what may have a body, of which nobody waits for the rest


@dataclass(frozen=True)
class Guard:
    """Lets in what asks for one of ``hosts`` (``name:port``), reads only, and shows ``token`` if there is one.

    A page of another site that a browser is led to can neither read the API (Origin) nor reach it under a name of its
    own (Host), which is how pages attack servers on loopback.
    """

    app: ASGIApp
    hosts: Sequence[str]
    token: str | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(SECURITY_HEADERS)
            await send(message)

        answer = self._find_rejection(scope) or self.app
        await answer(scope, receive, send_guarded)

    def _find_rejection(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        if headers.get("host", "").lower() not in self.hosts:
            return PlainTextResponse(f"this page is called {self.hosts[0]}; ask for it under that name\n", 421)
        if not {_host_of(origin) for origin in headers.getlist("origin")} <= set(self.hosts):
            return PlainTextResponse("other sites cannot ask for this page\n", 403)
        if scope["method"] not in ("GET", "HEAD"):
            return PlainTextResponse("this page can only be read\n", 405, {"allow": "GET, HEAD", **LAST})
        if headers.get("content-length", "0") != "0" or "transfer-encoding" in headers:
            return PlainTextResponse("who reads this page has nothing to send\n", 400, LAST)
        return self._find_missing_token(scope, headers)

    def _find_missing_token(self, scope: Scope, headers: Headers) -> Response | None:
        if self.token is None:
            return None
        shown = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        if scope["path"] == "/" and self._is_token(shown):
            response = RedirectResponse("/", 303)
            response.set_cookie(COOKIE, shown, httponly=True, secure=True, samesite="strict")
            return response
        kept = _read_cookie(headers.get("cookie", ""))
        scheme, _, bearer = headers.get("authorization", "").partition(" ")
        if self._is_token(kept) or (scheme.lower() == "bearer" and self._is_token(bearer.strip())):
            return None
        return PlainTextResponse("open /?token=TOKEN once, or send the header Authorization: Bearer TOKEN\n", 401)

    def _is_token(self, shown: str) -> bool:
        return hmac.compare_digest(shown.encode(), (self.token or "").encode())


def _host_of(origin: str) -> str:
    """``name:port`` of an origin; empty if it has none."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""


def _read_cookie(header: str) -> str:
    try:
        found = SimpleCookie(header).get(COOKIE)
    except CookieError:
        return ""
    return found.value if found else ""
