"""Guard of the page: it checks every request before an answer, and adds security headers to every answer."""

from __future__ import annotations

import hmac
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from coordinator.watch.http_front import Front

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


@dataclass(frozen=True)
class Guard:
    """Passes to ``app`` the requests that ``front`` accepts and that carry ``token``, if there is one."""

    app: ASGIApp
    front: Front
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
        if found := self.front.find_rejection(scope["method"], headers.items()):
            return PlainTextResponse(found.text, found.status, found.headers)
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


def _read_cookie(header: str) -> str:
    try:
        found = SimpleCookie(header).get(COOKIE)
    except CookieError:
        return ""
    return found.value if found else ""
