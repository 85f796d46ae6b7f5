"""The addresses of the page and what answers them."""

from __future__ import annotations

from typing import Any

from frictrack.workbench.handlers import (
    STATIC,
    CancelHandler,
    CandidateHandler,
    ChangeHandler,
    CheckHandler,
    DownloadHandler,
    EffectsHandler,
    EventsHandler,
    FilmHandler,
    FrameHandler,
    GlossaryHandler,
    NewStudyHandler,
    PageFiles,
    PictureHandler,
    PlotsHandler,
    SampleHandler,
    StartJobHandler,
    StateHandler,
    UnknownHandler,
)
from frictrack.workbench.live_study import LiveStudy
from frictrack.workbench.uploads import UploadHandler


def routes(live: LiveStudy) -> list[Any]:
    """Addresses and their handlers.

    Parameters
    ----------
    live : LiveStudy
        The study.

    """
    more = {"live": live}
    return [
        (r"/api/state", StateHandler, more),
        (r"/api/events", EventsHandler, more),
        (r"/api/effects", EffectsHandler, more),
        (r"/api/glossary", GlossaryHandler, more),
        (r"/api/check", CheckHandler, more),
        (r"/api/study", NewStudyHandler, more),
        (r"/api/sample", SampleHandler, more),
        (r"/api/do", ChangeHandler, more),
        (r"/api/job", StartJobHandler, more),
        (r"/api/cancel", CancelHandler, more),
        (r"/api/upload", UploadHandler, more),
        (r"/api/film", FilmHandler, more),
        (r"/api/frame", FrameHandler, more),
        (r"/api/plots", PlotsHandler, more),
        (r"/api/candidate", CandidateHandler, more),
        (r"/api/(sheet|figure)", PictureHandler, more),
        (r"/api/download", DownloadHandler, more),
        (r"/static/(.*)", PageFiles, {"path": str(STATIC)}),
        (r"/()", PageFiles, {"path": str(STATIC), "default_filename": "index.html"}),
        (r".*", UnknownHandler, more),
    ]
