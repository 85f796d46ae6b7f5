"""Make the studies that are timed: five runs of 700 frames with nothing, one effect or a foreign cause hidden."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from diagnosis.studies import BARE

import frictrack as ft
from frictrack.blind.study_files import run_table, write_study
from frictrack.blind.truth import RunTruth, Truth
from frictrack.blind.truth_sampling import LAWS, candidates, draw_truth
from frictrack.errors import FrictrackError
from frictrack.records import Displacement, Run

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
    rng = np.random.default_rng([seed, 3])
    return [_recorded_run(truth, run, rng) for run in truth.runs]


def _recorded_run(truth: Truth, run: RunTruth, rng: np.random.Generator) -> Run:
    data = run_table(truth, run, rng)
    n = len(data)
    columns = {name: data[name].to_numpy() if name in data else np.full(n, np.nan) for name in ("y_m", "sigma_m")}
    sigma = columns["sigma_m"] if "sigma_m" in data else np.full(n, truth.noise)
    displacement = Displacement(
        data["t_s"].to_numpy(),
        data["x_m"].to_numpy(),
        columns["y_m"],
        np.full(n, np.nan),
        sigma,
        np.full(n, np.nan),
        np.ones(n, dtype=bool),
        pixel_pitch=truth.pitch,
    )
    motion = ft.differentiate(ft.low_pass(displacement))
    return Run(displacement, motion, mass=truth.mass * run.mass_ratio, name=run.name)


def study_of_tables(folder: Path) -> Path:
    """Write the study with nothing hidden as tables; return the study file."""
    runs = tuple(replace(run, frames=FRAMES) for run in BARE.runs)
    write_study(replace(BARE, runs=runs), folder)
    return folder / "study.toml"
