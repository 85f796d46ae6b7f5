"""Serve a study as a local web page. The page computes nothing; it calls `flow` and shows its results.

    frictrack app STUDY

The state is in the study's files. Long jobs run in their own processes (`jobs`, `job_process`). No request leaves
the machine.
"""

from __future__ import annotations

from frictrack.base.errors import FrictrackError


class OutdatedError(FrictrackError):
    """The study has changed since the page was drawn, or a file is older than the model (status 409)."""


class BusyError(OutdatedError):
    """Other work that is still of use is running (status 409)."""


class MissingError(FrictrackError):
    """A film, a run or a result is not there (status 404)."""
