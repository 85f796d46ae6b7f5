"""Check host, origin and token of each request, and refuse requests that do not come from the user's own page.

A page of another server can send requests to this one from the user's browser. Through a name that it points to
127.0.0.1 (DNS rebinding) it could also read the answers; the Host header gives it away. A request from another page
carries that page's Origin, and the cookie is not sent with it (SameSite=Strict).
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import socket
from contextlib import suppress
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from tornado.httputil import HTTPServerRequest
from tornado.web import Application, RequestHandler

LOOPBACK = ("127.0.0.1", "localhost", "::1")
WILDCARD_HOSTS = ("0.0.0.0", "::", "")  # addresses that stand for all of this machine's
KEEP_PLACE = '<script>location.replace("./" + location.hash)</script>'  # a refresh alone would lose what stands after #
REDIRECT_PAGE = '<!doctype html><meta http-equiv="refresh" content="0;url={}"><title>frictrack</title>'


@dataclass(frozen=True)
class RequestGuard:
    """Decide which requests may reach the page.

    Parameters
    ----------
    token : str
        Secret in the address of the page when it is opened for the first time.
    host : str
        Address on which the page is served. If it is not the loopback interface, every address and name of this
        machine is accepted as well: an attacker's name is not an address.
    names : tuple of str
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
        """Value of the cookie: a hash of the token, valid as long as the token."""
        return hmac.new(self.token.encode(), b"frictrack page", hashlib.sha256).hexdigest()

    def cookie(self, request: HTTPServerRequest) -> str:
        """Name of the cookie, with the port: all ports of a host share their cookies."""
        return f"frictrack-{_netloc(request.host)[1] or 80}"

    def fault(self, request: HTTPServerRequest) -> str:
        """Check a request.

        Returns
        -------
        str
            Why the request is refused, in one sentence; "" if it is accepted.

        """
        if not self._is_own(_netloc(request.host)[0]):
            return (
                f'Expected the name of this machine as the host but got "{request.host}"; '
                "start `frictrack app --name NAME` to accept another name."
            )
        origin = request.headers.get("Origin")
        if origin is not None and origin.lower().partition("://")[2] != request.host.lower():
            return f'Expected a request from the page itself but got one from "{origin}".'
        held = request.cookies.get(self.cookie(request))
        if not self.has_token(request) and not _same(held.value if held else "", self.secret):
            return "Expected the address with its token; copy it from the terminal where frictrack app was started."
        return ""

    def has_token(self, request: HTTPServerRequest) -> bool:
        """Whether the address of a request carries the token."""
        given = request.query_arguments.get("token", [b""])[-1]
        return _same(given.decode(errors="replace"), self.token)

    def _is_own(self, host: str) -> bool:
        """Whether a host is a name or an address of this machine."""
        if host in LOOPBACK or host in self.names:
            return True
        if self.is_local:
            return False
        own = {self.host, socket.gethostname(), socket.getfqdn()} - set(WILDCARD_HOSTS)
        return host in {name.lower() for name in own} or _is_address(host)


class GuardedApplication(Application):
    """Check every request to a server first: pages, WebSocket, static files, downloads and uploads."""

    def __init__(self, guard: RequestGuard, addresses: list[Any], **settings: Any) -> None:
        super().__init__(addresses, **settings)
        self.guard = guard

    def find_handler(self, request: HTTPServerRequest, **more: Any) -> Any:
        """Answer what the guard refuses, and the page when its address has the token (Tornado's interface)."""
        fault = self.guard.fault(request)
        is_plain = request.method == "GET" and "Upgrade" not in request.headers
        if fault or (is_plain and self.guard.has_token(request)):
            return self.get_handler_delegate(request, GuardHandler, {"guard": self.guard, "fault": fault})
        return super().find_handler(request, **more)


class GuardHandler(RequestHandler):
    """Answer a refused request; set the cookie of a browser that has the token, and forward it to the bare address.

    The page forwards by itself. After a redirect from a link on another page, the browser would not send the cookie.
    """

    def initialize(self, guard: RequestGuard, fault: str) -> None:
        """Store the guard, and why the request is refused."""
        self.guard, self.fault = guard, fault

    def prepare(self) -> None:
        """Answer before the request is processed."""
        if self.fault:
            self.set_status(403)
            self.set_header("Content-Type", "text/plain; charset=utf-8")
            self.finish(self.fault)
            return
        name = self.guard.cookie(self.request)
        self.set_cookie(name, self.guard.secret, path="/", httponly=True, samesite="Strict")
        self.set_header("Referrer-Policy", "no-referrer")
        self.set_header("Cache-Control", "no-store")
        self.finish(KEEP_PLACE + REDIRECT_PAGE.format("./"))


def address_of(host: str, port: int, token: str = "") -> str:
    """Address of the page.

    Examples
    --------
    >>> address_of("::1", 5006, "abc")
    'http://[::1]:5006/?token=abc'

    """
    named = f"[{host}]" if ":" in host else host
    return f"http://{named}:{port}/" + (f"?token={token}" if token else "")


def _netloc(host: str) -> tuple[str, int | None]:
    """Host and port of a Host header; an empty host if it is invalid."""
    try:
        found = urlsplit(f"//{host}")
        return (found.hostname or "").rstrip("."), found.port
    except ValueError:
        return "", None


def _is_address(host: str) -> bool:
    with suppress(ValueError):
        return bool(ipaddress.ip_address(host))
    return False


def _same(given: str, wanted: str) -> bool:
    return hmac.compare_digest(given.encode(), wanted.encode())
