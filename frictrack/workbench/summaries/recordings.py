"""List the recordings in the folder of the study: what they hold, and which of them cannot be used."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypedDict

from frictrack.workbench.summaries.snapshot import Snapshot


class RecordingEntry(TypedDict):
    """One recording.

    Attributes
    ----------
    name, kind
        File name, and "film" or "table".
    words
        What it holds, in a few words.
    frames, width, height, fps
        Of a film, px and 1/s; None if unknown.
    in_study
        Whether a run of the study uses it.
    skipped
        Why it cannot be used; None if it can.

    """

    name: str
    kind: str
    words: str
    frames: int | None
    width: int | None
    height: int | None
    fps: float | None
    in_study: bool
    skipped: str | None


def list_recordings(snapshot: Snapshot) -> list[RecordingEntry]:
    """List the recordings in the folder of the study file.

    Parameters
    ----------
    snapshot
        The study as its files are.

    """
    runs = snapshot.study.runs if snapshot.study else ()
    used = {run.source.resolve() for run in runs if isinstance(run.source, Path)}
    return [
        RecordingEntry(
            name=seen.path.name,
            kind="table" if seen.is_table else "film",
            words=seen.words,
            frames=seen.n_frames or None,
            width=seen.shape[1] or None,
            height=seen.shape[0] or None,
            fps=seen.fps,
            in_study=seen.path.resolve() in used,
            skipped=_why_skipped(seen.problem, seen.columns_to_confirm),
        )
        for seen in snapshot.recordings
    ]


def _why_skipped(problem: str, columns: Sequence[str]) -> str | None:
    if problem:
        return problem
    return f"expected headers with units but got none; name them in the study file: {columns[0]}" if columns else None
