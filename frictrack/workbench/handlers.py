"""The addresses of the page: its files, the state of the study, changes and jobs.

Films, plots and downloads are in `data_handlers`.
"""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

from tornado.iostream import StreamClosedError
from tornado.web import HTTPError, RequestHandler, StaticFileHandler
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from frictrack.errors import FrictrackError
from frictrack.workbench.actions import cancel, change, check, copy_sample, list_effects, start_job, take_in
from frictrack.workbench.errors import MissingError, OutdatedError
from frictrack.workbench.live_study import LiveStudy, to_json

MAX_UNREAD_S = 20.0  # that a tab may leave a message unread
STATIC = Path(__file__).parent / "static"
SECURITY = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; style-src 'self' 'unsafe-inline'; "
    "connect-src 'self'; object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class PageFiles(StaticFileHandler):
    """The page and its modules; the browser asks each time whether they have changed."""

    def set_default_headers(self) -> None:
        """Set the headers of every answer."""
        for name, value in SECURITY.items():
            self.set_header(name, value)

    def set_extra_headers(self, path: str) -> None:
        """Let the browser ask each time (Tornado's interface)."""
        self.set_header("Cache-Control", "no-cache")

    def compute_etag(self) -> str | None:
        """Time and size of the file (Tornado's interface)."""
        assert self.absolute_path is not None
        stat = Path(self.absolute_path).stat()
        return f'"{stat.st_mtime_ns:x}-{stat.st_size:x}"'

    def parse_url_path(self, url_path: str) -> str:
        """Path of the file (Tornado's interface); a NUL stands in none."""
        if "\0" in url_path:
            raise HTTPError(404)
        return super().parse_url_path(url_path)

    def write_error(self, status_code: int, **more: Any) -> None:
        """Answer that there is no such file."""
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish("Expected a file of the page but there is none of this name; open the page again.")


class Api(RequestHandler):
    """A request with an answer in JSON; an error is one sentence under `error`."""

    def initialize(self, live: LiveStudy) -> None:
        """Store the study."""
        self.live = live

    def set_default_headers(self) -> None:
        """Set the headers of every answer."""
        for name, value in SECURITY.items():
            self.set_header(name, value)
        self.set_header("Cache-Control", "no-store")

    def answer(self, value: Any) -> None:
        """Send a value, or a text that is JSON already."""
        self.set_header("Content-Type", "application/json; charset=utf-8")
        self.finish(value if isinstance(value, str) else to_json(value))

    def log_exception(self, kind: Any, error: Any, trace: Any) -> None:
        """Write only errors of the program itself to the terminal; the others are told to the user, if still there."""
        if not isinstance(error, FrictrackError | OSError | HTTPError | StreamClosedError):
            super().log_exception(kind, error, trace)

    def write_error(self, status_code: int, **more: Any) -> None:
        """Answer with the sentence of the error."""
        error = more.get("exc_info", (None, None, None))[1]
        status, words = describe_error(error, status_code)
        self.set_status(status)
        self.answer({"error": words})

    def body(self) -> dict[str, Any]:
        """The JSON object of the request.

        Raises
        ------
        FrictrackError
            If the body is no JSON object.

        """
        try:
            found = json.loads(self.request.body or b"{}")
        except (ValueError, RecursionError):
            found = None
        if not isinstance(found, dict):
            raise FrictrackError("expected a JSON object but got another body; reload the page", usage=True)
        return found


def describe_error(error: Any, status: int) -> tuple[int, str]:
    """Status and sentence of an error.

    Parameters
    ----------
    error : Exception or None
        What was raised.
    status : int
        Status if the error does not tell one.

    """
    if isinstance(error, OutdatedError):
        return 409, str(error)
    if isinstance(error, FrictrackError):
        return 404 if isinstance(error, MissingError) else 400, str(error)
    if isinstance(error, HTTPError):
        return status, _describe_status(status)
    if isinstance(error, OSError):
        return 400, f"a file cannot be read or written: {error.strerror or error}; check the disk, then repeat"
    return status, f"the server met an unexpected error ({type(error).__name__}: {error}); reload the page"


def _describe_status(status: int) -> str:
    """What is wrong with a request itself."""
    reasons = {404: "there is none of this name", 405: "it does not answer this method"}
    return (
        f"expected an address of the page but {reasons.get(status, f'the request is not valid ({status})')}; reload it"
    )


class UnknownHandler(Api):
    """An address that is none of the page."""

    def prepare(self) -> None:
        """Say that there is no such address."""
        raise HTTPError(404)


class StateHandler(Api):
    """The state of the study."""

    async def get(self) -> None:
        """Answer with the newest state."""
        self.answer(await self.live.state_json())


class EventsHandler(WebSocketHandler):
    """Messages to one tab: a new state after every change, and the progress of jobs."""

    def initialize(self, live: LiveStudy) -> None:
        """Store the study."""
        self.live = live
        self.end = lambda: None
        self._waiting: dict[str, str] = {}  # newest message of each kind, until the tab has read the one before
        self._sending: asyncio.Future[None] | None = None

    def open(self, *arguments: str, **more: str) -> None:
        """Say which server this is, then send every change."""
        self.set_nodelay(True)
        self.send(to_json({"type": "hello", "server": self.live.server}))
        self.end = self.live.listen(self.send)

    def send(self, message: str) -> None:
        """Send a message; a tab that does not read gets the newest of each kind when it reads again."""
        self._waiting[message.partition(",")[0]] = message
        if self._sending is None or self._sending.done():
            self._sending = asyncio.ensure_future(self._send_waiting())

    async def _send_waiting(self) -> None:
        """Send one message after the other; a tab that is closed, or does not read for long, is forgotten."""
        try:
            while self._waiting:
                message = self._waiting.pop(next(iter(self._waiting)))
                await asyncio.wait_for(self.write_message(message), MAX_UNREAD_S)
        except (WebSocketClosedError, TimeoutError):
            self.end()
            self.close()

    def on_message(self, message: str | bytes) -> None:
        """Answer a ping."""
        self.send('{"type":"pong"}')

    def on_close(self) -> None:
        """Forget the tab."""
        self.end()


class EffectsHandler(Api):
    """The catalogue of effects, with those that the study defines."""

    async def get(self) -> None:
        """Answer with all effects."""
        self.answer({"effects": await self.live.read(list_effects, self.live.snapshot)})


class CheckHandler(Api):
    """Numbers as they are being typed."""

    async def post(self) -> None:
        """Answer how they are read; nothing is written."""
        given = self.body()
        self.answer({"fields": await self.live.read(check, self.live.snapshot, given.get("fields"), given.get("run"))})


class NewStudyHandler(Api):
    """Recordings for the study; without a study file, it is written."""

    async def post(self) -> None:
        """Take recordings into the study."""
        given = self.body()
        self.answer(await self.live.write(take_in, given.get("recordings"), given.get("fields")))


class SampleHandler(Api):
    """The sample study."""

    async def post(self) -> None:
        """Copy the sample films and their study file into the folder."""
        self.answer(await self.live.write(copy_sample))


class ChangeHandler(Api):
    """A quick change of the study."""

    async def post(self) -> None:
        """Make the change; work that it makes useless is cancelled."""
        given = self.body()
        self.answer(await self.live.write(change, given.get("do"), given.get("arguments"), given.get("seen")))


class StartJobHandler(Api):
    """A long job."""

    async def post(self) -> None:
        """Start it; a running job that it makes useless is cancelled."""
        given = self.body()
        self.answer(await self.live.write(start_job, given.get("do"), given.get("arguments"), given.get("seen")))


class CancelHandler(Api):
    """The running job."""

    async def post(self) -> None:
        """Cancel it; finished steps are kept."""
        self.answer(await self.live.write(cancel))
