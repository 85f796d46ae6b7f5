"""The server of the workbench: on this machine alone unless told otherwise, and then only with a token."""

from __future__ import annotations

import secrets
import sys
from pathlib import Path
from typing import Any

import panel as pn
from bokeh.server.auth_provider import AuthProvider
from tornado.web import RequestHandler

from frictrack.errors import FrictrackError
from frictrack.workbench.page import Page

HERE = "127.0.0.1"
COOKIE = "frictrack"


class Token(AuthProvider):
    """Who comes with ``?token=...`` gets a cookie; who has neither sees a page that says what to do."""

    def __init__(self, token: str) -> None:
        self.token = token
        super().__init__()

    @property
    def get_user(self) -> Any:
        """Who asks, when they may."""

        def user(handler: RequestHandler) -> str | None:
            given = handler.get_argument("token", "")
            if given and secrets.compare_digest(given.encode(), self.token.encode()):
                handler.set_signed_cookie(COOKIE, self.token, httponly=True, samesite="Strict")
                return "user"
            kept = handler.get_signed_cookie(COOKIE) or b""
            return "user" if secrets.compare_digest(kept, self.token.encode()) else None

        return user

    @property
    def get_user_async(self) -> None:
        """Nobody has to be asked."""

    @property
    def login_url(self) -> str:
        """Where one is sent who has no token."""
        return "/login"

    @property
    def get_login_url(self) -> None:
        """It is always the same one."""

    @property
    def login_handler(self) -> type[RequestHandler]:
        """The page that says what is missing."""
        return _Refused

    @property
    def logout_url(self) -> None:
        """A token is valid as long as the server runs."""

    @property
    def logout_handler(self) -> None:
        """See `logout_url`."""


class _Refused(RequestHandler):
    def get(self) -> None:
        self.set_status(403)
        self.finish("Expected the address with its token: copy it from where frictrack app was started.")


def serve(path: Path, *, host: str = HERE, port: int = 5006, token: str | None = None, show: bool = True) -> None:
    """Serve the workbench of a study file (which may not be there yet) until interrupted.

    On another `host` than this machine it asks for a token, a new one when none is given. Raises `FrictrackError`
    where the port is taken, or the folder of the study is not there.
    """
    path = path / "study.toml" if path.is_dir() else path
    if not path.parent.is_dir():
        raise FrictrackError(f"expected a folder {path.parent} but there is none", usage=True)
    path = path.resolve()
    alone = host in (HERE, "localhost")
    token = token or (None if alone else secrets.token_urlsafe(16))
    guard: dict[str, Any] = {}
    if token is not None:
        guard = {"auth_provider": Token(token), "cookie_secret": secrets.token_hex(32)}
    pn.extension(inline=True, notifications=False)
    try:
        server = pn.serve(
            {"/": lambda: Page(path).serve()},
            title="frictrack",
            address=host,
            port=port,
            websocket_origin=[f"{HERE}:{port}", f"localhost:{port}"] if alone else ["*"],
            show=False,
            start=False,
            **guard,
        )
    except OSError as e:
        raise FrictrackError(f"cannot serve on {host}:{port}: {e.strerror}; give another --port") from e
    address = f"http://{host}:{port}/" + (f"?token={token}" if token else "")
    sys.stderr.write(f"frictrack workbench of {path}\n  {address}\n  Ctrl-C ends it; work that goes on is not lost\n")
    if show:
        server.io_loop.add_callback(_browse, address)
    try:
        server.start()
        server.io_loop.start()
    except KeyboardInterrupt:
        server.stop()


def _browse(address: str) -> None:
    import webbrowser  # noqa: PLC0415

    webbrowser.open(address)
