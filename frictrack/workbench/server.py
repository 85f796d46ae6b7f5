"""Serve the page to its own user only: the address carries a token."""

from __future__ import annotations

import secrets
import sys
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

import panel as pn

from frictrack.errors import FrictrackError
from frictrack.workbench.guard import LOOPBACK, RequestGuard, address_of, clean_names, protect
from frictrack.workbench.page import Page


def serve(
    path: Path,
    *,
    host: str = LOOPBACK[0],
    port: int = 5006,
    token: str | None = None,
    names: Sequence[str] = (),
    show: bool = True,
) -> None:
    """Serve the workbench of a study file (which may not be there yet) until interrupted.

    It asks for a token, a new one when none is given, and for one of its own `names` as the host. Raises
    `FrictrackError` where the port is taken, or the folder of the study is not there.
    """
    path = path / "study.toml" if path.is_dir() else path
    if not path.parent.is_dir():
        raise FrictrackError(f"expected a folder {path.parent} but there is none", usage=True)
    path = path.resolve()
    guard = RequestGuard(token or secrets.token_urlsafe(24), host, clean_names(names))
    server = _server(path, guard, port)
    address = address_of(host, server.port or port, quote(guard.token, safe=""))
    sys.stderr.write(f"frictrack workbench of {path}\n  {address}\n  Ctrl-C ends it; work that goes on is not lost\n")
    if show:
        server.io_loop.add_callback(_browse, address)
    try:
        server.start()
        server.io_loop.start()
    except KeyboardInterrupt:
        server.stop()


def _server(path: Path, guard: RequestGuard, port: int) -> pn.io.server.Server:
    """The server of a page, guarded, not yet started."""
    pn.extension(inline=True, notifications=False)
    try:
        server = pn.serve(
            {"/": lambda: Page(path).serve()},
            title="frictrack",
            location=False,  # Panel cannot read an address of IPv6, and the page does not use its own
            address=guard.host,
            port=port,
            websocket_origin=["*"],  # the guard compares the origin with the host
            show=False,
            start=False,
        )
    except OSError as e:
        raise FrictrackError(f"cannot serve on {guard.host}:{port}: {e.strerror}; give another --port") from e
    protect(server._tornado, guard)
    return server


def _browse(address: str) -> None:
    import webbrowser  # noqa: PLC0415

    webbrowser.open(address)
