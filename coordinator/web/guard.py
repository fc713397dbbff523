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
SAID_ALWAYS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}


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
                MutableHeaders(scope=message).update(SAID_ALWAYS)
            await send(message)

        answer = self._find_rejection(scope) or self.app
        await answer(scope, receive, send_guarded)

    def _find_rejection(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        if headers.get("host", "").lower() not in self.hosts:
            return PlainTextResponse(f"this page is called {self.hosts[0]}; ask for it under that name\n", 421)
        origin = headers.get("origin")
        if origin is not None and urlsplit(origin).netloc.lower() not in self.hosts:
            return PlainTextResponse("other sites cannot ask for this page\n", 403)
        if scope["method"] not in ("GET", "HEAD"):
            return PlainTextResponse("this page can only be read\n", 405, {"allow": "GET, HEAD"})
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
        bearer = headers.get("authorization", "").removeprefix("Bearer ")
        if self._is_token(kept) or self._is_token(bearer):
            return None
        return PlainTextResponse("open /?token=TOKEN once, or send the header Authorization: Bearer TOKEN\n", 401)

    def _is_token(self, shown: str) -> bool:
        return hmac.compare_digest(shown.encode(), (self.token or "").encode())


def _read_cookie(header: str) -> str:
    try:
        found = SimpleCookie(header).get(COOKIE)
    except CookieError:
        return ""
    return found.value if found else ""
