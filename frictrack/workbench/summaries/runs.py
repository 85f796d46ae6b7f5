"""Describe every run: its film and shapes, how well it was measured, frames to look at, smoothing and free section."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from frictrack.base.number_format import format_number, join_words, lower_first, upper_first
from frictrack.flow import contact_sheet_path
from frictrack.measure.repairing import suspect_spans
from frictrack.present.report import failed_checks, is_good
from frictrack.records import CutoffTradeOff
from frictrack.results import RunResults
from frictrack.results.verdicts import describe_lost
from frictrack.settings.filters import FILTER_WORDS, FILTERS, STRUCTURAL
from frictrack.settings.filters import SETTINGS as FILTER_SETTINGS
from frictrack.study import RunTable, Study
from frictrack.workbench.summaries.fields import KEYS, NAMES, missing_fields, study_fields
from frictrack.workbench.summaries.snapshot import Snapshot, file_version, surveyed_source

MAX_CACHED_RUNS = 1000
MAX_SUSPECT_SPANS = 50
NOT_MEASURED: dict[str, Any] = {
    **{"n_frames_lost": 0, "lost_words": "", "motion": None},
    **{key: [] for key in ("suspect", "checks", "notes", "warnings")},
}


def summarise_runs(snapshot: Snapshot) -> list[dict[str, Any]]:
    """Describe every run of the study file."""
    if snapshot.study is None:
        return []
    measured = {run.name: run for run in snapshot.results.runs} if snapshot.results else {}
    study = snapshot.study
    return [_run(snapshot, study, i, run, measured.get(run.name)) for i, run in enumerate(study.runs)]


def _run(snapshot: Snapshot, study: Study, index: int, run: RunTable, results: RunResults | None) -> dict[str, Any]:
    sheet = contact_sheet_path(study, run.name)
    return {
        "name": run.name,
        "file": _file_name(run, study),
        "kind": "film" if run.video else "table",
        "index": index,
        "film": _film(run, results),
        "fields": study_fields(snapshot, run),
        "shapes": _shapes(run, results),
        "repairs": [repair.to_dict() for repair in run.repair],
        "state": "measured" if results else "tracked" if sheet.exists() else "new",
        "has_sheet": bool(run.video) and sheet.exists(),
        **(_measured_part(results) if results else NOT_MEASURED),
    }


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
    return {
        "target": run.target if isinstance(run.target, tuple) else None,
        "reference": run.reference if isinstance(run.reference, tuple) else None,
        "ruler": ruler,
        "exclude": run.exclude,
        "obstacles": run.obstacles,
        "found": track.target if track else None,
        "template": run.template or 0,
    }


# --- what depends on stored results only


@lru_cache(maxsize=MAX_CACHED_RUNS)
def _measured_part(run: RunResults) -> dict[str, Any]:
    """Describe a measured run; `RunResults` are compared by identity, so that an unchanged run is described once."""
    checks = failed_checks(run) if run.quality else []
    lost = 0 if run.track is None else int((~run.track.found).sum())
    return {
        "n_frames_lost": lost,
        "lost_words": "" if run.track is None else f"{upper_first(describe_lost(lost, len(run.track)))}.",
        "suspect": suspect_frames(run),
        "checks": _checks(run),
        "notes": list(run.notes),
        "warnings": [*checks, *(run.cutoff.warnings if run.cutoff else ())],
        "motion": _motion(run),
    }


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


def _motion(run: RunResults) -> dict[str, Any]:
    """Describe smoothing, free section (ms, and why it begins and ends there) and cut-off."""
    friction, free = run.friction, None
    if friction is not None:
        t = 1e3 * friction.t[friction.free]
        begin, end = (float(t[0]), float(t[-1])) if len(t) else (None, None)
        free = {"from_ms": begin, "to_ms": end, "reason": friction.reason}
    return {
        "smoothed_by": run.filtered.reason,
        "filters": {name: {"words": FILTER_WORDS[name], "takes": takes} for name, takes in FILTERS.items()},
        "filter": {"filter": STRUCTURAL} | {k: run.settings[k] for k in FILTER_SETTINGS if k in run.settings},
        "free": free,
        "cutoff": _cutoff(run, run.cutoff) if run.cutoff else None,
    }


def _cutoff(run: RunResults, trade: CutoffTradeOff) -> dict[str, Any]:
    """Return the cut-off frequencies to choose from, each with the noise that passes and the signal that is lost."""
    factor, unit = (run.mass, "N") if run.mass else (1.0, "m/s²")
    separated = factor * trade.structural
    return {
        "asked": run.settings.get("cutoff"),
        "chosen": trade.chosen,
        "options": [round(float(f), 1) for f in trade.frequency],
        "noise": [float(f"{factor * v:.4g}") for v in trade.noise],
        "lost": [float(f"{factor * v:.4g}") for v in trade.lost],
        "unit": unit,
        "separated": separated,
        "words": f"total error with trend, vibrations and events separated {format_number(separated)} {unit}",
    }


def readiness(snapshot: Snapshot, runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Say whether Run can be pressed: can_run, the missing fields by name, and what to do, as a sentence (words)."""
    missing, words = _what_is_missing(snapshot, runs)
    if words is None:
        done = "Run measures the films, fits the model and names what it lacks."
        return {"can_run": True, "missing": [], "words": done}
    return {"can_run": False, "missing": missing, "words": words}


def _what_is_missing(snapshot: Snapshot, runs: Sequence[Mapping[str, Any]]) -> tuple[list[str], str | None]:
    """Names of fields to fill in or to correct, and what to do; None if nothing is missing."""
    if snapshot.error:
        return [], "Correct the study file to run."
    if snapshot.study is None:
        some = any(not seen.problem for seen in snapshot.recordings)
        return [], "Use the recordings of this folder to run." if some else "Drop recordings here to run."
    if not runs:
        return ["Recordings"], "Add a recording to run."
    if missing := missing_fields(snapshot):
        return missing, f"Enter {_listed(missing)} to run."
    every = [study_fields(snapshot), *(run["fields"] for run in runs)]
    wrong = [NAMES[key] for key in KEYS if any(fields[key]["error"] for fields in every)]
    return wrong, f"Correct {_listed(wrong)} to run." if wrong else None


def _listed(names: Sequence[str]) -> str:
    return join_words([f"the {lower_first(name)}" for name in names])
