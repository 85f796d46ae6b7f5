"""Describe every run: its film and shapes, how well it was measured, frames to look at, smoothing and free section."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, TypedDict

from frictrack.base.number_format import format_number
from frictrack.flow import contact_sheet_path
from frictrack.measure.repairing import suspect_spans
from frictrack.present.report import failed_checks, is_good
from frictrack.records import CutoffTradeOff
from frictrack.results import RunResults, to_builtins
from frictrack.settings.filters import FILTER_WORDS, FILTERS, STRUCTURAL
from frictrack.settings.filters import SETTINGS as FILTER_SETTINGS
from frictrack.study import RunTable, Study
from frictrack.workbench.summaries.fields import KEYS, NAMES, Field, missing_fields, run_fields, study_fields
from frictrack.workbench.summaries.snapshot import Snapshot, file_version, surveyed_source

MAX_CACHED_RUNS = 1000
MAX_SUSPECT_SPANS = 50


class RunSummary(TypedDict):
    """One run of the study; see `summarise_runs`.

    Attributes
    ----------
    name, file, kind, index
        Name of the run, its recording, "film" or "table", and its place in the study file.
    film
        frames, width, height, fps and version (changes with the content) of a film; None for a table.
    fields
        Mass, frame rate and scale of this run.
    shapes
        Target, reference, ruler and excluded areas of the study file, and the target that was found.
    repairs
        Repaired spans of frames.
    n_frames_lost
        Frames in which the target was not found.
    suspect
        Spans of frames to look at.
    state
        "new", "tracked" or "measured".
    checks
        Checks of the time base: check, value, verdict, ok.
    notes, warnings
        Sentences.
    has_sheet
        Whether the contact sheet of the tracked target exists.
    motion
        Smoothing, free section and cut-off; None before the run is measured.

    """

    name: str
    file: str
    kind: str
    index: int
    film: dict[str, Any] | None
    fields: dict[str, Field]
    shapes: dict[str, Any]
    repairs: list[dict[str, Any]]
    n_frames_lost: int
    suspect: list[dict[str, int | str]]
    state: str
    checks: list[dict[str, Any]]
    notes: list[str]
    warnings: list[str]
    has_sheet: bool
    motion: dict[str, Any] | None


def summarise_runs(snapshot: Snapshot) -> list[RunSummary]:
    """Describe every run of the study file.

    Parameters
    ----------
    snapshot
        The study as its files are.

    """
    if snapshot.study is None:
        return []
    measured = {run.name: run for run in snapshot.results.runs} if snapshot.results else {}
    study = snapshot.study
    return [_run(snapshot, study, i, run, measured.get(run.name)) for i, run in enumerate(study.runs)]


def _run(snapshot: Snapshot, study: Study, index: int, run: RunTable, results: RunResults | None) -> RunSummary:
    sheet = contact_sheet_path(study, run.name)
    measured = _measured_part(results) if results else {}
    return RunSummary(
        name=run.name,
        file=_file_name(run, study),
        kind="film" if run.video else "table",
        index=index,
        film=_film(run, results),
        fields=run_fields(snapshot, run),
        shapes=_shapes(run, results),
        repairs=[repair.to_dict() for repair in run.repair],
        n_frames_lost=measured.get("n_frames_lost", 0),
        suspect=measured.get("suspect", []),
        state="measured" if results else "tracked" if sheet.exists() else "new",
        checks=measured.get("checks", []),
        notes=measured.get("notes", []),
        warnings=measured.get("warnings", []),
        has_sheet=bool(run.video) and sheet.exists(),
        motion=measured.get("motion"),
    )


def _file_name(run: RunTable, study: Study) -> str:
    source = run.source
    if isinstance(source, Path) and source.is_relative_to(study.folder):
        return source.relative_to(study.folder).as_posix()
    return str(source)


def _film(run: RunTable, results: RunResults | None) -> dict[str, Any] | None:
    """Return frames, size, frame rate and version of a film; None for a table."""
    if not run.video:
        return None
    seen = surveyed_source(run.video)
    stored = results.film if results else None
    fps = stored.fps if stored else run.fps or (seen.fps if seen else None)
    return {
        "frames": seen.n_frames if seen else stored.n_frames if stored else 0,
        "width": seen.shape[1] if seen else 0,
        "height": seen.shape[0] if seen else 0,
        "fps": fps,
        "version": file_version(run.video),
    }


def _shapes(run: RunTable, results: RunResults | None) -> dict[str, Any]:
    """Return the shapes of the study file, px: None where nothing was drawn; and the target that was found."""
    ruler = run.scale.get("points") if isinstance(run.scale, dict) and "length" in run.scale else None
    track = results.track if results else None
    found: dict[str, Any] = to_builtins(
        {
            "target": run.target if isinstance(run.target, tuple) else None,
            "reference": run.reference if isinstance(run.reference, tuple) else None,
            "ruler": ruler,
            "exclude": run.exclude,
            "obstacles": run.obstacles,
            "found": track.target if track else None,
            "template": run.template or 0,
        }
    )
    return found


# --- what depends on stored results only


@lru_cache(maxsize=MAX_CACHED_RUNS)
def _measured_part(run: RunResults) -> dict[str, Any]:
    """Describe a measured run; `RunResults` are compared by identity, so that an unchanged run is described once."""
    found: dict[str, Any] = to_builtins(
        {
            "n_frames_lost": 0 if run.track is None else int((~run.track.found).sum()),
            "suspect": suspect_frames(run),
            "checks": _checks(run),
            "notes": list(run.notes),
            "warnings": _warnings(run),
            "motion": _motion(run),
        }
    )
    return found


def suspect_frames(run: RunResults) -> list[dict[str, int | str]]:
    """List the spans of frames of a film that a person should look at.

    Parameters
    ----------
    run
        The run; one without a film has none.

    Returns
    -------
    list of dict
        "from" and "to", numbers of frames in the film, both included, and "words"; at most `MAX_SUSPECT_SPANS`.

    """
    if run.track is None:
        return []
    spans = suspect_spans(run.track, run.tracks.get("backward"))[:MAX_SUSPECT_SPANS]
    return [{"from": span.first, "to": span.last, "words": span.words} for span in spans]


def _checks(run: RunResults) -> list[dict[str, Any]]:
    """Return the checks of the time base of a film, the frame rate first."""
    if run.film is None:
        return []
    rate = ("frame rate while filming", f"{run.film.fps:g} /s", "forces are proportional to its square")
    rows = [{"check": check, "value": value, "verdict": verdict} for check, value, verdict in (rate, *run.film.audit)]
    return [{**row, "ok": row is rows[0] or is_good(row["verdict"])} for row in rows]


def _warnings(run: RunResults) -> list[str]:
    """Return the failed self-checks of a film and the warnings of the smoothing."""
    found = failed_checks(run) if run.quality else []
    return [*found, *(run.cutoff.warnings if run.cutoff else ())]


def _motion(run: RunResults) -> dict[str, Any]:
    return {
        "smoothed_by": run.filtered.reason,
        "filters": {name: {"words": FILTER_WORDS[name], "takes": takes} for name, takes in FILTERS.items()},
        "filter": {"filter": STRUCTURAL} | {k: run.settings[k] for k in FILTER_SETTINGS if k in run.settings},
        "free": _free(run),
        "cutoff": _cutoff(run, run.cutoff) if run.cutoff else None,
    }


def _free(run: RunResults) -> dict[str, Any] | None:
    """Return the free section, ms, and why it begins and ends there; None if no force is known."""
    friction = run.friction
    if friction is None:
        return None
    t = 1e3 * friction.t[friction.free]
    ends = (float(t[0]), float(t[-1])) if len(t) else (None, None)
    return {"from_ms": ends[0], "to_ms": ends[1], "reason": friction.reason}


def _cutoff(run: RunResults, trade: CutoffTradeOff) -> dict[str, Any]:
    """Return the cut-off frequencies to choose from, each with the noise that passes and the signal that is lost."""
    factor, unit = (run.mass, "N") if run.mass else (1.0, "m/s²")
    return {
        "asked": run.settings.get("cutoff"),
        "chosen": trade.chosen,
        "options": [round(float(f), 1) for f in trade.frequency],
        "noise": [float(f"{factor * v:.4g}") for v in trade.noise],
        "lost": [float(f"{factor * v:.4g}") for v in trade.lost],
        "unit": unit,
        "separated": factor * trade.structural,
        "words": (
            f"total error with trend, vibrations and events separated: {format_number(factor * trade.structural)} "
            f"{unit}"
        ),
    }


class Readiness(TypedDict):
    """Whether Run can be pressed; the missing fields by name; and what to do, as a sentence."""

    can_run: bool
    missing: list[str]
    words: str


def readiness(snapshot: Snapshot, runs: Sequence[RunSummary]) -> Readiness:
    """Say what is missing before Run.

    Parameters
    ----------
    snapshot
        The study as its files are.
    runs
        Its runs.

    """
    if snapshot.error:
        return Readiness(can_run=False, missing=[], words="Correct the study file to run.")
    if snapshot.study is None:
        some = any(not seen.problem for seen in snapshot.recordings)
        words = "Use the recordings of this folder to run." if some else "Drop recordings here to run."
        return Readiness(can_run=False, missing=[], words=words)
    if not runs:
        return Readiness(can_run=False, missing=["Recordings"], words="Add a recording to run.")
    missing = missing_fields(snapshot)
    wrong = [NAMES[key] for key in KEYS if _is_wrong(key, study_fields(snapshot), runs) and NAMES[key] not in missing]
    if missing:
        return Readiness(can_run=False, missing=missing, words=f"Enter {_listed(missing)} to run.")
    if wrong:
        return Readiness(can_run=False, missing=wrong, words=f"Correct {_listed(wrong)} to run.")
    return Readiness(can_run=True, missing=[], words="Run measures the films, fits the model and names what it lacks.")


def _is_wrong(key: str, common: dict[str, Field], runs: Sequence[RunSummary]) -> bool:
    return any(fields[key]["error"] for fields in (common, *(run["fields"] for run in runs)))


def _listed(names: Sequence[str]) -> str:
    """Write names of fields as in a sentence.

    Examples
    --------
    >>> _listed(["Mass", "Frame rate", "Scale"])
    'the mass, the frame rate and the scale'

    """
    words = [f"the {name[:1].lower()}{name[1:]}" for name in names]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
