"""The addresses of the page and what answers them."""

from __future__ import annotations

from typing import Any

from frictrack.workbench.actions import cancel, change, copy_sample, start_job, take_in
from frictrack.workbench.handlers import (
    STATIC,
    ActionHandler,
    CandidateHandler,
    CheckHandler,
    DownloadHandler,
    EffectsHandler,
    EventsHandler,
    FilmHandler,
    FrameHandler,
    GlossaryHandler,
    PageFiles,
    PictureHandler,
    PlotsHandler,
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
    more: dict[str, Any] = {"live": live}
    return [
        (r"/api/state", StateHandler, more),
        (r"/api/events", EventsHandler, more),
        (r"/api/effects", EffectsHandler, more),
        (r"/api/glossary", GlossaryHandler, more),
        (r"/api/check", CheckHandler, more),
        (r"/api/study", ActionHandler, more | {"act": take_in, "keys": ("recordings", "fields")}),
        (r"/api/sample", ActionHandler, more | {"act": copy_sample}),
        (r"/api/do", ActionHandler, more | {"act": change, "keys": ("do", "arguments", "seen")}),
        (r"/api/job", ActionHandler, more | {"act": start_job, "keys": ("do", "arguments", "seen")}),
        (r"/api/cancel", ActionHandler, more | {"act": cancel}),
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
