"""The addresses of films, plots and pictures."""

from __future__ import annotations

import asyncio
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from frictrack.errors import FrictrackError
from frictrack.workbench.actions import need_plain_name, try_effect
from frictrack.workbench.downloads import CONTENT_TYPES, make_download, page_figure
from frictrack.workbench.errors import MissingError
from frictrack.workbench.films import FilmFile, film_file
from frictrack.workbench.handlers import Api
from frictrack.workbench.live_study import LiveStudy

YEAR_S = 31_536_000
PART_BYTES = 262_144  # of a download that are read at once


class FilmApi(Api):
    """A request about a film: of a run, or of a file in the folder of the study."""

    async def film(self) -> FilmFile:
        """The film that the address names.

        Raises
        ------
        FrictrackError
            If there is no such run or file.

        """
        run, file = self.get_query_argument("run", ""), self.get_query_argument("file", "")
        return await asyncio.to_thread(_find_film, self.live, run, file)


def _find_film(live: LiveStudy, run: str, file: str) -> FilmFile:
    study = live.snapshot.study if live.snapshot else None
    if run:
        table = next((one for one in study.runs if one.name == run), None) if study else None
        if table is None or table.video is None:
            raise MissingError(f'expected a run with a film but got "{run}"; reload the page')
        if not isinstance(table.video, Path):
            raise MissingError(f"expected a film of this machine but {table.video} is an address; fetch it to see it")
        return film_file(table.video, table.fps)
    return film_file(live.path.parent / need_plain_name(file))


class FilmHandler(FilmApi):
    """Number of frames, size and rate of a film."""

    async def get(self) -> None:
        """Answer with frames, width, height, fps and version."""
        self.answer(await asyncio.wrap_future(self.live.films.open(await self.film()).info()))


class FrameHandler(FilmApi):
    """One frame of a film as a JPEG."""

    async def get(self) -> None:
        """Answer with the picture; the browser keeps it if the address has the version of the film."""
        number = self.get_query_argument("n", "0")
        if not re.fullmatch(r"-?[0-9]{1,18}", number):
            raise FrictrackError(f'expected the number of a frame but got "{number[:40]}"', usage=True)
        file = await self.film()
        picture = await asyncio.wrap_future(self.live.films.open(file).frame(int(number)))
        if self.get_query_argument("v", "") == file.version:
            self.set_header("Cache-Control", f"private, max-age={YEAR_S}, immutable")
        self.set_header("Content-Type", "image/jpeg")
        self.finish(picture)


class PlotsHandler(Api):
    """Scene and columns of linked plots."""

    async def get(self) -> None:
        """Answer with the packed plots of a view."""
        query = {key: self.get_query_argument(key, "") for key in ("view", "run", "cutoff", "model", "background")}
        snapshot = await self.live.read_snapshot()
        self.send(await asyncio.to_thread(packed_plots, snapshot, query))

    def send(self, packed: bytes) -> None:
        """Send packed plots."""
        self.set_header("Content-Type", "application/octet-stream")
        self.finish(packed)


def packed_plots(snapshot: Any, query: Mapping[str, str]) -> bytes:
    """Prepare the plots of a view.

    Parameters
    ----------
    snapshot : Snapshot
        The study and its results as they were read last.
    query : dict
        "view" ("track", "motion" or "compare"), "run", "cutoff" in Hz, "model" and "background"; "" for none.

    Returns
    -------
    bytes
        See `PlotData.pack`.

    Raises
    ------
    MissingError
        If there is no such run or model.
    FrictrackError
        If there is no such view.

    """
    from frictrack.flow import preview_motion  # noqa: PLC0415 - loads the science
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
        raise FrictrackError(f"expected the view track, motion or compare but got {view!r}", usage=True)
    if not cutoff:
        return plot_data.motion_plots(run, index=index).pack()
    frequency = _frequency(cutoff)
    return plot_data.motion_plots(run, preview_motion(run, frequency), f"at {frequency:.3g} Hz", index).pack()


def _named(items: Sequence[Any], name: str, what: str) -> Any:
    """Find an item by its name."""
    found = next((one for one in items if one.name == name), None)
    if found is None:
        raise MissingError(f'expected a {what} but there is none named "{name}"; reload the page')
    return found


def _frequency(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise FrictrackError(f"expected a cut-off frequency above 0 Hz but got {text!r}", usage=True)
    return value


class CandidateHandler(PlotsHandler):
    """The curve of the current model with one more effect."""

    async def get(self) -> None:
        """Answer with the packed curve; 202 while it is being fitted, which begins with the first request."""
        from frictrack.workbench.summaries import candidate_curves  # noqa: PLC0415

        name, snapshot = self.get_query_argument("name", ""), await self.live.read_snapshot()
        if snapshot is None or snapshot.results is None or snapshot.results.current is None:
            raise MissingError("expected a fitted model but there is none yet; press Run")
        curves = await self.live.read(candidate_curves, snapshot, name)
        if curves is None:
            await self.live.write(try_effect, name)
            self.set_status(202)
            self.answer({"pending": True})
        else:
            self.send(curves.pack())


class PictureHandler(Api):
    """Pictures that are made from the results."""

    async def sheet(self) -> tuple[bytes, str]:
        """The contact sheet of a run."""
        from frictrack.flow import contact_sheet_path  # noqa: PLC0415

        run, snapshot = self.get_query_argument("run", ""), await self.live.read_snapshot()
        study: Any = snapshot.study if snapshot else None
        path = contact_sheet_path(study, _named(study.runs if study else (), run, "run of the study").name)
        if not path.exists():
            raise MissingError(f"expected the contact sheet {path.name} but it does not exist; track the film first")
        return await asyncio.to_thread(path.read_bytes), "image/png"

    async def figure(self) -> tuple[bytes, str]:
        """A figure that Matplotlib draws."""
        name, snapshot = self.get_query_argument("name", ""), await self.live.read_snapshot()
        return await self.live.draw(page_figure, name, snapshot), "image/svg+xml"

    async def get(self, kind: str) -> None:
        """Answer with the picture."""
        content, kind = await (self.sheet() if kind == "sheet" else self.figure())
        self.set_header("Content-Type", kind)
        self.finish(content)


class DownloadHandler(Api):
    """A file to keep."""

    async def get(self) -> None:
        """Send the file in parts."""
        what, form = self.get_query_argument("what", ""), self.get_query_argument("format", "svg")
        snapshot = await self.live.read_snapshot()
        reason = None if self.get_query_argument("anyway", "") else self.live.state["report"]["outdated"]
        file = await self.live.draw(make_download, what, snapshot, form, reason)
        try:
            self.set_header("Content-Type", CONTENT_TYPES[Path(what).suffix])
            self.set_header("Content-Disposition", f'attachment; filename="{what}"')
            while part := await asyncio.to_thread(file.read, PART_BYTES):
                self.write(part)
                await self.flush()
        finally:
            file.close()
