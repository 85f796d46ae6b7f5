"""Make the studies that are timed: five runs of 700 frames with nothing, one effect or a foreign cause hidden."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from diagnosis.studies import BARE, recorded

from frictrack.base.errors import FrictrackError
from frictrack.records import Run
from frictrack.validation.blind import write_study
from frictrack.validation.blind.truth import Truth
from frictrack.validation.blind.truth_sampling import LAWS, candidates, draw_truth

RUNS, FRAMES = 5, 700
MAX_SEEDS = 20  # tried until a study of this size is found


def effects_to_hide() -> list[str]:
    """Names of all effects that a blind study can hide."""
    return list(dict.fromkeys(name for law, _ in LAWS for name in candidates("one", law)))


def foreign_causes() -> list[str]:
    """Names of the causes outside the library."""
    return candidates("foreign", ())


def draw_study(kind: str, turn: int) -> Truth:
    """Draw a blind study and keep its first five runs, the first 700 frames of each.

    Raises
    ------
    FrictrackError
        If no seed gives one.

    """
    for seed in range(MAX_SEEDS):
        try:
            truth = draw_truth(1000 * (turn + 1) + seed, kind, turn)
        except FrictrackError:
            continue
        runs = tuple(replace(run, frames=min(run.frames, FRAMES)) for run in truth.runs[:RUNS])
        return replace(truth, runs=runs)
    raise FrictrackError(f"expected a study of kind {kind}, turn {turn}, but no seed gave one")


def recorded_runs(truth: Truth, seed: int = 0) -> list[Run]:
    """Runs that a camera of white noise records of a study."""
    return recorded(truth, np.random.default_rng([seed, 3]))


def study_of_tables(folder: Path) -> Path:
    """Write the study with nothing hidden as tables; return the study file."""
    runs = tuple(replace(run, frames=FRAMES) for run in BARE.runs)
    write_study(replace(BARE, runs=runs), folder)
    return folder / "study.toml"
