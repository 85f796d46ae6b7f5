"""The addresses of the page: its files, the state of the study, changes, jobs, films, plots, downloads and uploads."""

from __future__ import annotations

import asyncio
import filecmp
import json
import math
import re
import shutil
import zipfile
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from io import BytesIO
from mimetypes import guess_type
from pathlib import Path
from tempfile import SpooledTemporaryFile
from typing import IO, TYPE_CHECKING, Any, BinaryIO

from tornado.iostream import StreamClosedError
from tornado.web import HTTPError, RequestHandler, StaticFileHandler, stream_request_body
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from frictrack import flow
from frictrack.base.errors import FrictrackError, UsageError
from frictrack.base.files import atomic_write
from frictrack.workbench import MissingError, OutdatedError, actions
from frictrack.workbench.films import FilmFile, film_file
from frictrack.workbench.live_study import LiveStudy, to_json

if TYPE_CHECKING:
    from frictrack.results import Results

MAX_UNREAD_S = 20.0  # that a tab may leave a message unread
STATIC = Path(__file__).parent / "static"
SECURITY = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; style-src 'self' 'unsafe-inline'; "
    "connect-src 'self'; object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}


Act = Callable[["Api"], Awaitable[None]]


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

    def asked(self, key: str, default: str = "") -> str:
        """A part of the address."""
        return self.get_query_argument(key, default)

    def send(self, content: bytes, kind: str = "application/octet-stream") -> None:
        """Send bytes."""
        self.set_header("Content-Type", kind)
        self.finish(content)

    def body(self) -> dict[str, Any]:
        """The JSON object of the request."""
        try:
            found = json.loads(self.request.body or b"{}")
        except (ValueError, RecursionError):
            found = None
        if not isinstance(found, dict):
            raise UsageError("expected a JSON object but got another body; reload the page")
        return found


def describe_error(error: Any, status: int) -> tuple[int, str]:
    """Status and sentence of an error."""
    if isinstance(error, OutdatedError):
        return 409, str(error)
    if isinstance(error, FrictrackError):
        return 404 if isinstance(error, MissingError) else 400, str(error)
    if isinstance(error, HTTPError):
        reasons = {404: "there is none of this name", 405: "it does not answer this method"}
        reason = reasons.get(status, f"the request is not valid ({status})")
        return status, f"expected an address of the page but {reason}; reload it"
    if isinstance(error, OSError):
        return 400, f"a file cannot be read or written: {error.strerror or error}; check the disk, then repeat"
    return status, f"the server met an unexpected error ({type(error).__name__}: {error}); reload the page"


class UnknownHandler(Api):
    """An address that is none of the page."""

    def prepare(self) -> None:
        """Say that there is no such address."""
        raise HTTPError(404)


class AnswerHandler(Api):
    """A request that a function answers: GET changes nothing, POST has a JSON object."""

    def initialize(self, live: LiveStudy, answer: tuple[str, Act]) -> None:  # type: ignore[override]
        """Store the study, and what `ANSWERS` holds: the method of the request, and what answers."""
        super().initialize(live)
        method, self.act = answer
        self.SUPPORTED_METHODS = (method,)

    async def get(self) -> None:
        """Answer."""
        await self.act(self)

    post = get


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


async def _state(api: Api) -> None:
    """The newest state of the study."""
    api.answer(await api.live.state_json())


async def _effects(api: Api) -> None:
    """The catalogue of effects, with those that the study defines, and the searches with their settings."""
    from frictrack.workbench.summaries import effect_library, searches  # noqa: PLC0415 - loads NumPy

    snapshot = await api.live.read_snapshot()
    study = snapshot.study if snapshot else None
    api.answer({"effects": await api.live.read(effect_library, study), "searches": searches(study)})


async def _glossary(api: Api) -> None:
    """Words that the page explains, their meanings, and the pattern that finds them in a text."""
    from frictrack.base.glossary import hover_pattern, hover_words  # noqa: PLC0415

    api.answer({"meanings": hover_words(), "pattern": hover_pattern().pattern})


async def _check(api: Api) -> None:
    """How numbers are read as they are being typed; nothing is written."""
    given = api.body()
    api.answer({"fields": await api.live.read(actions.check, api.live.snapshot, given.get("fields"), given.get("run"))})


def _action(act: Callable[..., Any], *keys: str) -> Act:
    """What changes the study or its work, with the keys of the request that are its arguments."""

    async def answer(api: Api) -> None:
        given = api.body()
        api.answer(await api.live.write(act, *(given.get(key) for key in keys)))

    return answer


YEAR_S = 31_536_000
PART_BYTES = 262_144  # of a download that are read at once


async def _film(api: Api) -> None:
    """Frames, width, height, rate and version of a film."""
    api.answer(await asyncio.wrap_future(api.live.films.open(await asyncio.to_thread(_find_film, api)).info()))


async def _frame(api: Api) -> None:
    """One frame of a film as a JPEG; the browser keeps it if the address has the version of the film."""
    number = api.asked("n", "0")
    if not re.fullmatch(r"-?[0-9]{1,18}", number):
        raise UsageError(f'expected the number of a frame but got "{number[:40]}"')
    file = await asyncio.to_thread(_find_film, api)
    picture = await asyncio.wrap_future(api.live.films.open(file).frame(int(number)))
    if api.asked("v") == file.version:
        api.set_header("Cache-Control", f"private, max-age={YEAR_S}, immutable")
    api.send(picture, "image/jpeg")


def _find_film(api: Api) -> FilmFile:
    """The film that the address names: of a run, or of a file in the folder of the study."""
    live, run, file = api.live, api.asked("run"), api.asked("file")
    study = live.snapshot.study if live.snapshot else None
    if not run:
        return film_file(live.path.parent / actions.need_plain_name(file))
    table = next((one for one in study.runs if one.name == run), None) if study else None
    if table is None or table.video is None:
        raise MissingError(f'expected a run with a film but got "{run}"; reload the page')
    if not isinstance(table.video, Path):
        raise MissingError(f"expected a film of this machine but {table.video} is an address; fetch it to see it")
    return film_file(table.video, table.fps)


async def _plots(api: Api) -> None:
    """The packed plots of a view."""
    query = {key: api.asked(key) for key in ("view", "run", "cutoff", "model", "background")}
    api.send(await asyncio.to_thread(packed_plots, await api.live.read_snapshot(), query))


def packed_plots(snapshot: Any, query: Mapping[str, str]) -> bytes:
    """Prepare the plots of a view."""
    from frictrack.workbench import plot_data  # noqa: PLC0415

    results = snapshot.results if snapshot else None
    if results is None:
        raise MissingError("expected results but there are none yet; press Run")
    view, cutoff = query["view"], query["cutoff"]
    if view == "compare":
        model = _named(results.models, query["model"], "model") if query["model"] else results.current
        background = _named(results.models, query["background"], "model") if query["background"] else None
        if model is None:
            raise MissingError("expected a fitted model but there is none yet; press Run")
        return plot_data.comparison_plots(results, model, background).pack()
    run = _named(results.runs, query["run"], "measured run")
    index = [one.name for one in snapshot.study.runs].index(run.name)
    if view == "track":
        return plot_data.track_plots(run, index).pack()
    if view != "motion":
        raise UsageError(f"expected the view track, motion or compare but got {view!r}")
    if not cutoff:
        return plot_data.motion_plots(run, index=index).pack()
    frequency = _frequency(cutoff)
    return plot_data.motion_plots(run, flow.preview_motion(run, frequency), f"at {frequency:.3g} Hz", index).pack()


def _named(items: Sequence[Any], name: str, what: str) -> Any:
    """Find an item by its name."""
    found = next((one for one in items if one.name == name), None)
    if found is None:
        raise MissingError(f'expected a {what} but there is none named "{name}"; reload the page')
    return found


def _frequency(text: str) -> float:
    with suppress(ValueError):
        if 0 < (value := float(text)) < math.inf:
            return value
    raise UsageError(f"expected a cut-off frequency above 0 Hz but got {text!r}")


async def _candidate(api: Api) -> None:
    """The curve of the current model with one more effect; 202 while it is fitted, from the first request on."""
    from frictrack.workbench.summaries import candidate_curves  # noqa: PLC0415

    name, snapshot = api.asked("name"), await api.live.read_snapshot()
    if snapshot is None or snapshot.results is None or snapshot.results.current is None:
        raise MissingError("expected a fitted model but there is none yet; press Run")
    curves = await api.live.read(candidate_curves, snapshot, name)
    if curves is not None:
        api.send(curves.pack())
        return
    await api.live.write(actions.try_effect, name)
    api.set_status(202)
    api.answer({"pending": True})


# --- files that are made of the results

DOWNLOADS = ("report.html", "report.pdf", "tables.zip", "hdf5.zip", "repeat.py", "figures.zip")
FIGURE_FORMATS = ("svg", "png", "pdf")
MEMORY_BYTES = 20_000_000  # of a file that is made; a larger one goes to the disk
Content = IO[bytes]


def make_download(what: str, snapshot: Any, form: str = "svg", outdated: str | None = None) -> Content:
    """Make a file for download."""
    if what not in DOWNLOADS or form not in FIGURE_FORMATS:
        known = f"{', '.join(DOWNLOADS)} (figures as {', '.join(FIGURE_FORMATS)})"
        raise UsageError(f"expected one of the files {known} but got {what!r} as {form!r}")
    if snapshot is None or snapshot.study is None or (snapshot.results is None and what != "repeat.py"):
        raise MissingError(f"expected results for {what} but there are none; press Run first")
    if what.startswith("report") and outdated:
        raise OutdatedError(f"{outdated.rstrip('.')}; write it again or download it as it is")
    from frictrack.present import export  # noqa: PLC0415

    results: Results = snapshot.results
    if what == "repeat.py":
        return BytesIO(flow.replay_script(snapshot.study).encode())
    if what == "tables.zip":
        return zip_files((path.name, path) for path in export.write(results, "csv"))
    if what == "hdf5.zip":
        return zip_files((path.name, path) for path in sorted(results.output.glob("[!.]*.h5")))
    from frictrack.present import plots, report  # noqa: PLC0415 - loads Matplotlib

    if what == "figures.zip":
        figures = plots.study_figures(results)
        return zip_files((f"{name}.{form}", plots.file_content(draw(), form)) for name, draw in figures)
    path = results.output / "report.html"
    if not path.exists():
        raise MissingError(f"expected the report {path} but it does not exist; write it first")
    return (report.print_pdf(path) if what == "report.pdf" else path).open("rb")


def zip_files(files: Iterator[tuple[str, bytes | Path]]) -> Content:
    """Pack files into one ZIP archive."""
    sheet: Any = SpooledTemporaryFile(MEMORY_BYTES)  # noqa: SIM115 - the caller closes it
    with zipfile.ZipFile(sheet, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files:
            if isinstance(content, Path):
                archive.write(content, name)
            else:
                archive.writestr(name, content)
    sheet.seek(0)
    return sheet


# Kinds of figures of the page: name in the list of figures, and how the page draws it.
PAGE_FIGURES: dict[str, tuple[str, dict[str, Any]]] = {
    "law": ("law", {"title": False, "width": 4.8}),
    "search": ("convergence", {}),
    "cutoff": ("cutoff", {}),
    "filters": ("filters", {}),
}


def page_figure(name: str, snapshot: Any) -> bytes:
    """Draw a figure that the page shows."""
    from frictrack.present import plots  # noqa: PLC0415

    kind, _, which = name.partition(":")
    listed, options = PAGE_FIGURES.get(kind, ("", {}))
    results = snapshot.results if snapshot else None
    draw = dict(plots.study_figures(results)).get(f"{listed} {which}") if results else None
    if results and kind == "scan" and plots.has_scan(curves := results.figures.get(which, {})):
        draw, options = plots.scan, {"effect": which, "curves": curves, "width": 5.0}  # the list has the best only
    if draw is None:
        raise MissingError(f'expected a figure of the results but there is none named "{name}"; reload the page')
    return plots.file_content(draw(**options), "svg")


async def _sheet(api: Api) -> None:
    """The contact sheet of a run."""
    snapshot = await api.live.read_snapshot()
    study: Any = snapshot.study if snapshot else None
    run = _named(study.runs if study else (), api.asked("run"), "run of the study")
    path = flow.contact_sheet_path(study, run.name)
    if not path.exists():
        raise MissingError(f"expected the contact sheet {path.name} but it does not exist; track the film first")
    api.send(await asyncio.to_thread(path.read_bytes), "image/png")


async def _figure(api: Api) -> None:
    """A figure that Matplotlib draws."""
    api.send(await api.live.draw(page_figure, api.asked("name"), await api.live.read_snapshot()), "image/svg+xml")


async def _download(api: Api) -> None:
    """A file to keep, sent in parts."""
    what, snapshot = api.asked("what"), await api.live.read_snapshot()
    reason = None if api.asked("anyway") else api.live.state["report"]["outdated"]
    file = await api.live.draw(make_download, what, snapshot, api.asked("format", "svg"), reason)
    try:
        api.set_header("Content-Type", guess_type(what)[0] or "application/octet-stream")
        api.set_header("Content-Disposition", f'attachment; filename="{what}"')
        while part := await asyncio.to_thread(file.read, PART_BYTES):
            api.write(part)
            await api.flush()
    finally:
        file.close()


ANSWERS: dict[str, tuple[str, Act]] = {
    "state": ("GET", _state),
    "effects": ("GET", _effects),
    "glossary": ("GET", _glossary),
    "film": ("GET", _film),
    "frame": ("GET", _frame),
    "plots": ("GET", _plots),
    "candidate": ("GET", _candidate),
    "sheet": ("GET", _sheet),
    "figure": ("GET", _figure),
    "download": ("GET", _download),
    "check": ("POST", _check),
    "study": ("POST", _action(actions.take_in, "recordings", "fields")),
    "sample": ("POST", _action(actions.copy_sample)),
    "do": ("POST", _action(actions.change, "do", "arguments", "seen")),
    "job": ("POST", _action(actions.start_job, "do", "arguments", "seen")),
    "cancel": ("POST", _action(actions.cancel)),
}  # by address, below /api


MAX_UPLOAD_BYTES = 2_000_000_000  # larger recordings are to be copied into the folder
MAX_NAME_BYTES = 200  # file systems allow 255
WRITE_BYTES = 1_000_000  # that are collected before they are written


class _SameFileError(Exception):
    """The file that arrived is there already."""


@contextmanager
def receive_file(folder: Path, name: str) -> Iterator[BinaryIO]:
    """Open a file that arrives in parts. It appears in a folder when the block ends, or not at all.

    Parameters
    ----------
    folder : Path
        Folder of the study.
    name : str
        Name that the browser sent. Only its last part is used, so that the file stays in the folder.

    Raises
    ------
    FrictrackError
        If it is no valid file name.
    OutdatedError
        If another file of that name exists.

    """
    path = folder / stored_name(name)
    if path.is_symlink() or path.is_dir():
        raise FrictrackError(f'expected the file name of a recording but got "{name}"')
    with suppress(_SameFileError), atomic_write(path) as part:
        with part.open("wb") as file:
            yield file
        if path.exists():
            if not filecmp.cmp(part, path, shallow=False):
                raise OutdatedError(f"{path.name} exists with different content; rename one of the files")
            raise _SameFileError


def stored_name(name: str) -> str:
    r"""Name under which an uploaded file is stored.

    Parameters
    ----------
    name : str
        Name that the browser sent.

    Raises
    ------
    FrictrackError
        If it is no valid file name.

    Examples
    --------
    >>> stored_name("C:\\films\\fast.avi")
    'fast.avi'

    """
    last = Path(name.replace("\\", "/")).name
    fits = last.isprintable() and len(last.encode(errors="replace")) <= MAX_NAME_BYTES and not last.startswith(".")
    if not last or not fits:
        raise FrictrackError(f'expected the file name of a recording but got "{name}"')
    return last


@stream_request_body
class UploadHandler(Api):
    """A recording that is dropped on the page; it is written to the disk while it arrives."""

    async def prepare(self) -> None:
        """Check name and size before the first part."""
        self._file: BinaryIO | None = None
        self._held, self._stack = bytearray(), ExitStack()
        if self.request.method != "POST":
            return
        self.request.connection.set_max_body_size(MAX_UPLOAD_BYTES + 1)  # type: ignore[union-attr]
        folder, length = self.live.path.parent, self.request.headers.get("Content-Length", "0")
        if not re.fullmatch(r"[0-9]{1,18}", length):
            raise UsageError(f'expected the number of bytes as Content-Length but got "{length[:40]}"')
        size = int(length)
        free = await asyncio.to_thread(lambda: shutil.disk_usage(folder).free)
        self._name = name = stored_name(self.get_query_argument("name", ""))
        if size > MAX_UPLOAD_BYTES:
            raise FrictrackError(f"{name} is larger than 2 GB; copy it into {folder} instead")
        if size > free:
            raise FrictrackError(
                f"{name} needs {size / 1e6:.0f} MB but the disk of {folder} has {free / 1e6:.0f} MB free"
            )
        self._file = await asyncio.to_thread(self._stack.enter_context, receive_file(folder, name))

    async def data_received(self, chunk: bytes) -> None:
        """Write the next part; the connection waits for the disk."""
        self._held += chunk
        if len(self._held) >= WRITE_BYTES:
            await self._flush()

    async def _flush(self) -> None:
        part, self._held = self._held, bytearray()
        if self._file is not None:
            await asyncio.to_thread(self._file.write, part)

    async def post(self) -> None:
        """Answer with the name of the stored file."""
        await self._flush()
        await asyncio.to_thread(self._stack.close)
        self.live.look_now()
        self.answer({"name": self._name})

    def on_connection_close(self) -> None:
        """Remove what has arrived of a file that will not be completed."""
        self.on_finish()

    def on_finish(self) -> None:
        """Remove what has arrived if an error ended the request."""
        with suppress(InterruptedError, FrictrackError):
            error = InterruptedError("the upload was not completed")
            getattr(self, "_stack", ExitStack()).__exit__(InterruptedError, error, None)
