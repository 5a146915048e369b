# SPDX-License-Identifier: Apache-2.0
"""Who may ask the server: its own page alone, from this machine or with the token.

A page of another site must neither read the skin nor command it. A browser says in ``Origin`` which
page asks, and in ``Host`` which name it asked for: a foreign name that was made to lead here (DNS
rebinding) is refused, and so is a foreign page. On other addresses than loopback there are names
that nobody here can know; there the token in the address takes the place of the check of ``Host``.
"""

import ipaddress
import secrets
from collections.abc import Collection
from typing import Final
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS: Final = {
    "content-security-policy": _POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",  # the address may hold the token
    "cache-control": "no-store",  # a page of one version never meets a server of another
}
_READS: Final = ("GET", "HEAD")


def is_loopback(host: str) -> bool:
    """Whether nobody but this machine reaches that address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class Guard:
    """ASGI middleware that refuses strangers.

    host: the address listened at. token: what has to be in the query; None: on loopback, where the
    name in ``Host`` is checked instead. Its port is not: it is another one through an SSH tunnel.
    public: paths that need no token, because a page asks for its own parts without one.
    """

    def __init__(self, app: ASGIApp, host: str, token: str | None, public: Collection[str]) -> None:
        self._app = app
        self._public = public
        self._token = token
        self._names = {host, "localhost", "127.0.0.1", "::1"}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer 403 to a stranger, and let everybody else through."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        refusal = self._refusal(scope)
        if scope["type"] == "websocket":
            if refusal:
                await send({"type": "websocket.close", "code": 1008, "reason": refusal})
            else:
                await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
            await send(message)

        answer = PlainTextResponse(f"{refusal}\n", 403) if refusal else self._app
        await answer(scope, receive, send_with_headers)

    def _refusal(self, scope: Scope) -> str:
        headers = Headers(scope=scope)
        host, origin = headers.get("host", ""), headers.get("origin")
        if self._token is None:
            if _name(host) not in self._names:
                return "this page is at 127.0.0.1, and by no other name"
        elif scope["path"] not in self._public and not self._is_known(scope):
            return "open the address that 'ohmskin view' has printed, with its token"
        changes = scope["type"] == "websocket" or scope["method"] not in _READS
        if (changes or origin is not None) and origin != f"http://{host}":
            return "only this page itself may ask that"
        return ""

    def _is_known(self, scope: Scope) -> bool:
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        assert self._token is not None
        return secrets.compare_digest(given.encode(), self._token.encode())


def _name(host: str) -> str | None:
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None
