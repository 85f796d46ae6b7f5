"""What a study has come to, read from its HDF5 files alone: nothing is measured, fitted or checked again.

    results = stored(open_study("study.toml"))

A run that was not measured to its end is left out, a model that was not diagnosed has no diagnosis.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from frictrack import store
from frictrack.flow.beside import known, sensor_rows
from frictrack.flow.budgets import budgeted
from frictrack.flow.ledger import Ledger
from frictrack.flow.quality import quality
from frictrack.flow.stages import RunWork, copied, silent
from frictrack.flow.tried import Tried, model_results
from frictrack.motion import derivatives, low_pass
from frictrack.records import Array, Happenings
from frictrack.results import ModelResults, Results, RunResults, plain
from frictrack.study import Study
from frictrack.version import __version__

ASIDE = ("cutoff", "friction", "events")  # stages that a fit does not need


def stored(study: Study) -> Results:
    """Runs, models, comparison and diagnosis as they lie in the results folder, however old."""
    works = [RunWork(study, run, kept=True) for run in study.runs]
    tried = Tried(study, works, silent, Ledger(study.output))
    with store.snapshot(tried.path, *(work.path for work in works)):
        models = tuple(tried.results(group) for group in tried.groups)
        current = next((model for model in models if model.current), None)
        has_papers = "papers" in store.names(tried.path)
        return Results(
            name=study.name,
            path=study.path,
            output=study.output,
            version=__version__,
            runs=_with_copies([work for work in works if _is_measured(work)]),
            models=models,
            comparison=_summary(tried, "comparison"),
            diagnosis=current.diagnosis if current else None,
            figures=current.figures if current else {},
            papers=tried.results("papers") if has_papers else None,
            outdated=tuple(_outdated(works, tried)),
        )


def _with_copies(works: list[RunWork]) -> tuple[RunResults, ...]:
    """The runs, and which of them are the same recording."""
    twice = copied(works)
    runs = [run_results(work) for work in works]
    return tuple(replace(r, notes=(*r.notes, twice[r.name])) if r.name in twice else r for r in runs)


def attempted(path: Path) -> ModelResults:
    """The model of an attempt."""
    return model_results(path, store.names(path, "models")[0])


def previewed(run: RunResults, cutoff: float) -> Array:
    """What x, v and a (3, n) of a run would be with a plain low-pass at a cut-off, Hz; nothing is stored."""
    along = replace(run.displacement, y=np.full(len(run.displacement), np.nan))  # across costs as much again
    beside = None if run.sensors is None else known(run.sensors)
    return derivatives(low_pass(along, cutoff, acceleration=beside))


def _is_measured(work: RunWork) -> bool:
    """Whether all is there on which anything else rests."""
    return all(work.is_current(name) for name in work.stages if name not in ASIDE)


def _outdated(works: list[RunWork], tried: Tried) -> Iterator[str]:
    """Keys of the runs that were made from others than the study file has now, and the model, where that holds for it.

    The files that they name are not opened: whether their content changed is only seen when the work is done again.
    """
    runs: dict[str, list[str]] = {}
    for work in works:
        for key in work.changed():
            runs.setdefault(key, []).append(work.run.name)
    for key, names in runs.items():
        yield key if len(names) == len(works) else f"{key} of {', '.join(names)}"
    if tried.is_stale():
        yield "what the model was fitted to"


def _summary(tried: Tried, group: str) -> Any:
    there = group in store.names(tried.path)
    return json.loads(store.read(tried.path, group)["summary"]) if there else None


def run_results(work: RunWork) -> RunResults:
    """Every stage of one run that was made, all that is known of it."""
    done = {name: work.get(name) for name in work.stages if work.is_current(name)}
    seen = _quality(done)
    notes = [note for name in ("recording", "track", "displacement") for note in getattr(done.get(name), "notes", ())]
    notes += sensor_rows(work)["notes"]
    return RunResults(
        name=work.run.name,
        source=work.written(work.run.source),
        displacement=done["displacement"],
        filtered=done["filtered"],
        motion=done["motion"],
        happenings=done.get("events", Happenings()),
        cutoff=done.get("cutoff"),
        friction=done.get("friction"),
        film=done.get("recording"),
        track=done.get("track"),
        tracks=done.get("tracks", {}),
        sensors=done["sensors"],
        quality=seen,
        budget=budgeted(work, seen),
        role=work.run.role,
        group=work.run.group,
        settings={k: work.written(v) for k, v in work.run if v not in (None, "", {}, [])},
        hashes={name: work.key(name) for name in done},
        notes=tuple(dict.fromkeys(notes)),
    )


def _quality(done: dict[str, Any]) -> dict[str, Any]:
    """What a film says of its own measurement; nothing for a table."""
    if "track" not in done:
        return {}
    found: dict[str, Any] = plain(
        quality(done["recording"], done["track"], done["tracks"], done["displacement"].pixel_pitch)
    )
    return found
