"""Check host, origin and token of each request, and refuse those that do not come from the user's own page.

A page of another server can send requests to this one from the user's browser. Through a name that it points to
127.0.0.1 (DNS rebinding) it could also read the answers; the Host header gives it away. A request from another page
carries that page's Origin, and the cookie is not sent with it (SameSite=Strict).
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import socket
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from tornado.httputil import HTTPServerRequest
from tornado.routing import Matcher, Rule
from tornado.web import Application, RequestHandler

LOOPBACK = ("127.0.0.1", "localhost", "::1")
WILDCARD_HOSTS = ("0.0.0.0", "::", "")  # addresses that stand for all of this machine's
REDIRECT_PAGE = '<!doctype html><meta http-equiv="refresh" content="0;url={}"><title>frictrack</title>'


@dataclass(frozen=True)
class RequestGuard:
    """Who may reach the page.

    Parameters
    ----------
    token
        What the address of the page carries when it is opened for the first time.
    host
        Address on which the page is served. On another one than the loopback interface, every address of this
        machine and its own names are accepted as well: no foreign name can be an address.
    names
        Further names of this machine, such as that of a proxy.

    """

    token: str
    host: str = LOOPBACK[0]
    names: tuple[str, ...] = ()

    @property
    def is_local(self) -> bool:
        """Whether the page is served on the loopback interface."""
        return self.host in LOOPBACK

    @property
    def secret(self) -> str:
        """Value of the cookie; it holds as long as the token, and does not give it away."""
        return hmac.new(self.token.encode(), b"frictrack page", hashlib.sha256).hexdigest()

    def cookie(self, request: HTTPServerRequest) -> str:
        """Name of the cookie, one per port: all ports of a host share their cookies."""
        return f"frictrack-{_netloc(request.host)[1] or 80}"

    def fault(self, request: HTTPServerRequest) -> str:
        """Why a request is refused, in one sentence; empty where it is not."""
        if not self._is_own(_netloc(request.host)[0]):
            return (
                f'Expected the name of this machine as the host but got "{request.host}"; '
                "`frictrack app --name NAME` accepts a further one."
            )
        origin = request.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc.lower() != request.host.lower():
            return f'Expected a request of the page itself but got one of "{origin}".'
        if not self.has_token(request) and not _same(self._cookie_value(request), self.secret):
            return "Expected the address with its token: copy it from where frictrack app was started."
        return ""

    def has_token(self, request: HTTPServerRequest) -> bool:
        """Whether the address of a request carries the token."""
        given = request.query_arguments.get("token", [b""])[-1]
        return _same(given.decode(errors="replace"), self.token)

    def _cookie_value(self, request: HTTPServerRequest) -> str:
        held = request.cookies.get(self.cookie(request))
        return held.value if held else ""

    def _is_own(self, host: str) -> bool:
        """Whether a host is this machine as the user knows it."""
        if host in LOOPBACK or host in self.names:
            return True
        if self.is_local:
            return False
        own = {self.host, socket.gethostname(), socket.getfqdn()} - set(WILDCARD_HOSTS)
        return host in {name.lower() for name in own} or _is_address(host)


class RefusedRequest(Matcher):
    """Match every request that the guard refuses."""

    def __init__(self, guard: RequestGuard) -> None:
        self.guard = guard

    def match(self, request: HTTPServerRequest) -> dict[str, Any] | None:
        """What the handler needs, as Tornado wants it."""
        fault = self.guard.fault(request)
        return {"target_kwargs": {"fault": fault}} if fault else None


class TokenRequest(Matcher):
    """Match the page when its address carries the token."""

    def __init__(self, guard: RequestGuard) -> None:
        self.guard = guard

    def match(self, request: HTTPServerRequest) -> dict[str, Any] | None:
        """What the handler needs, as Tornado wants it."""
        plain = request.method == "GET" and "Upgrade" not in request.headers
        return {"target_kwargs": {"guard": self.guard}} if plain and self.guard.has_token(request) else None


class RefusalHandler(RequestHandler):
    """Refuse whatever was asked for."""

    def initialize(self, fault: str) -> None:
        """Keep the sentence."""
        self.fault = fault

    def prepare(self) -> None:
        """Answer before anything of the request is looked at."""
        self.set_status(403)
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(self.fault)


class TokenHandler(RequestHandler):
    """Give the cookie to a browser that has the token, and send it on to the address without one.

    It is not redirected: a browser that followed a link of another page would not send the cookie then.
    """

    def initialize(self, guard: RequestGuard) -> None:
        """Keep the guard."""
        self.guard = guard

    def get(self) -> None:
        """Set the cookie."""
        name = self.guard.cookie(self.request)
        self.set_cookie(name, self.guard.secret, path="/", httponly=True, samesite="Strict")
        self.set_header("Referrer-Policy", "no-referrer")
        self.set_header("Cache-Control", "no-store")
        self.finish(REDIRECT_PAGE.format("./"))


def protect(application: Application, guard: RequestGuard) -> None:
    """Put the guard before every handler of a server: pages, WebSocket, static files, downloads and uploads."""
    application.default_router.rules[:0] = [
        Rule(RefusedRequest(guard), RefusalHandler),
        Rule(TokenRequest(guard), TokenHandler),
    ]


def address_of(host: str, port: int, token: str = "") -> str:
    """Address under which the page is opened."""
    named = f"[{host}]" if ":" in host else host
    return f"http://{named}:{port}/" + (f"?token={token}" if token else "")


def clean_names(names: Iterable[str]) -> tuple[str, ...]:
    """Names as the guard compares them."""
    return tuple(name.strip().lower() for name in names)


def _netloc(host: str) -> tuple[str, int | None]:
    """Host and port of a Host header; an empty host where it is none."""
    try:
        found = urlsplit(f"//{host}")
        return (found.hostname or "").rstrip("."), found.port
    except ValueError:
        return "", None


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _same(given: str, wanted: str) -> bool:
    return hmac.compare_digest(given.encode(), wanted.encode())
