"""Serve the page to its own user only: its address contains a token."""

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
    """Serve the workbench of a study until interrupted.

    Parameters
    ----------
    path : Path
        Study file, which need not exist yet, or its folder.
    host : str
        Address on which to serve.
    port : int
        Port.
    token : str, optional
        Token in the address of the page; a new one by default.
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
        raise FrictrackError(f"expected the folder {path.parent} but it does not exist", usage=True)
    path = path.resolve()
    guard = RequestGuard(token or secrets.token_urlsafe(24), host, clean_names(names))
    server = _server(path, guard, port)
    address = address_of(host, server.port or port, quote(guard.token, safe=""))
    sys.stderr.write(f"frictrack workbench of {path}\n  {address}\n  press Ctrl-C to stop; running jobs continue\n")
    if show:
        server.io_loop.add_callback(_browse, address)
    try:
        server.start()
        server.io_loop.start()
    except KeyboardInterrupt:
        server.stop()


def _server(path: Path, guard: RequestGuard, port: int) -> pn.io.server.Server:
    """Create the server of a page with its guard; it is not started."""
    pn.extension(inline=True, notifications=False)
    try:
        server = pn.serve(
            {"/": lambda: Page(path).serve()},
            title="frictrack",
            location=False,  # Panel cannot parse IPv6 addresses, and the page does not need its address
            address=guard.host,
            port=port,
            websocket_origin=["*"],  # the guard compares the origin with the host
            show=False,
            start=False,
        )
    except OSError as e:
        raise FrictrackError(f"cannot serve on {guard.host}:{port}: {e.strerror}; choose another --port") from e
    protect(server._tornado, guard)
    return server


def _browse(address: str) -> None:
    import webbrowser  # noqa: PLC0415

    webbrowser.open(address)
