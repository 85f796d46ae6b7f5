"""Serve the page to its own user only: its address contains a token."""

from __future__ import annotations

import asyncio
import logging
import os
import secrets
import sys
import tempfile
import webbrowser
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

from tornado.httpserver import HTTPServer
from tornado.netutil import bind_sockets
from tornado.web import Application

from frictrack.base.errors import FrictrackError, UsageError
from frictrack.workbench.guard import LOOPBACK, REDIRECT_PAGE, GuardedApplication, RequestGuard, address_of
from frictrack.workbench.handlers import ANSWERS, STATIC, AnswerHandler, EventsHandler, PageFiles, UnknownHandler
from frictrack.workbench.live_study import LiveStudy
from frictrack.workbench.uploads import UploadHandler

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
        *((rf"/api/{n}", AnswerHandler, more | {"method": how, "act": act}) for n, (how, act) in ANSWERS.items()),
        (r"/api/events", EventsHandler, more),
        (r"/api/upload", UploadHandler, more),
        (r"/static/(.*)", PageFiles, {"path": str(STATIC)}),
        (r"/()", PageFiles, {"path": str(STATIC), "default_filename": "index.html"}),
        (r".*", UnknownHandler, more),
    ]
    return GuardedApplication(guard, addresses, websocket_ping_interval=PING_INTERVAL_S)
