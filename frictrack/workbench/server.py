"""Serve the page to its own user only: check host, origin and token of each request."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import ipaddress
import logging
import os
import secrets
import socket
import sys
import tempfile
import webbrowser
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPServerRequest
from tornado.netutil import bind_sockets
from tornado.web import Application, RequestHandler

from frictrack.base.errors import FrictrackError, UsageError
from frictrack.workbench import handlers
from frictrack.workbench.live_study import LiveStudy

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
        if self.host in LOOPBACK:
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


MAX_BODY_BYTES = 4_000_000  # of a request that is no upload
SHOWN_S = 60.0  # that a browser has to read the file which forwards it to the page
PING_INTERVAL_S = 20.0  # of WebSockets: a tab that does not answer is forgotten


def serve(
    path: Path,
    *,
    host: str = LOOPBACK[0],
    port: int = 5006,
    token: str | None = None,
    names: Sequence[str] = (),
    show: bool = True,
) -> None:
    """Serve the workbench of a study until interrupted.

    Parameters
    ----------
    path : Path
        Study file, which need not exist yet, or its folder.
    host : str
        Address on which to serve.
    port : int
        Port; 0 for any free one.
    token : str, optional
        Token in the address of the page; a new one by default. Other users do not see it: the browser is started with
        a file that only its owner can read, not with the address.
    names : sequence of str
        Further host names that are accepted.
    show : bool
        Whether to open a browser.

    Raises
    ------
    FrictrackError
        If the port is in use, or if the folder of the study does not exist.

    """
    path = path / "study.toml" if path.is_dir() else path
    if not path.parent.is_dir():
        raise UsageError(f"expected the folder {path.parent} but it does not exist")
    guard = RequestGuard(token or secrets.token_urlsafe(24), host, tuple(name.strip().lower() for name in names))
    with suppress(KeyboardInterrupt):
        asyncio.run(_serve(path.resolve(), guard, port, show))


async def _serve(path: Path, guard: RequestGuard, port: int, show: bool) -> None:
    live = LiveStudy(path)
    server = HTTPServer(application(live, guard), max_body_size=MAX_BODY_BYTES)
    try:
        sockets = bind_sockets(port, guard.host)
    except OSError as e:
        live.close()
        raise FrictrackError(f"cannot serve on {guard.host}:{port}: {e.strerror}; choose another --port") from e
    server.add_sockets(sockets)
    address = address_of(guard.host, sockets[0].getsockname()[1], quote(guard.token, safe=""))
    sys.stderr.write(f"frictrack workbench of {path}\n  {address}\n  press Ctrl-C to stop; running jobs continue\n")
    shown = asyncio.create_task(open_browser(address) if show else asyncio.sleep(0))
    try:
        await live.watch()
    finally:
        shown.cancel()
        server.stop()
        live.close()


async def open_browser(address: str) -> None:
    """Open an address in the browser by a file that forwards to it: every user can see with what programs are started.

    Only its owner can read the file, which is removed after `SHOWN_S`.

    Parameters
    ----------
    address : str
        Address of the page, with the token.

    """
    sandboxed = Path("/snap").is_dir()  # browsers of Snap read neither /tmp nor hidden folders
    with suppress(OSError):  # the address stands in the terminal
        handle, name = tempfile.mkstemp(prefix="frictrack-", suffix=".html", dir=Path.home() if sandboxed else None)
        try:
            with os.fdopen(handle, "w", encoding="ascii") as file:
                file.write(REDIRECT_PAGE.format(address))
            await asyncio.to_thread(webbrowser.open, Path(name).as_uri())
            await asyncio.sleep(SHOWN_S)
        finally:
            Path(name).unlink(missing_ok=True)


def application(live: LiveStudy, guard: RequestGuard) -> Application:
    """Create the application of a page, in which the guard checks every request."""
    logging.getLogger("tornado.access").setLevel(logging.ERROR)  # refusals and missing films are told to the page
    more: dict[str, Any] = {"live": live}
    addresses: list[Any] = [
        *((rf"/api/{n}", handlers.AnswerHandler, more | {"answer": one}) for n, one in handlers.ANSWERS.items()),
        (r"/api/events", handlers.EventsHandler, more),
        (r"/api/upload", handlers.UploadHandler, more),
        (r"/static/(.*)", handlers.PageFiles, {"path": str(handlers.STATIC)}),
        (r"/()", handlers.PageFiles, {"path": str(handlers.STATIC), "default_filename": "index.html"}),
        (r".*", handlers.UnknownHandler, more),
    ]
    return GuardedApplication(guard, addresses, websocket_ping_interval=PING_INTERVAL_S)
