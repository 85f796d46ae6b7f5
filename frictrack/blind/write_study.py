"""A drawn truth becomes a study that says nothing of it: tables or films, and a study file."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from frictrack.blind.render_run import render_run
from frictrack.blind.truth import RunTruth, Truth
from frictrack.records import Array
from frictrack.simulate import Trajectory
from frictrack.simulate.rendering import Oscillation


def write_study(truth: Truth, folder: Path) -> None:
    """Tables (t_s, x_m, and what was measured beside) or films of a study, and its study file."""
    rng = np.random.default_rng([truth.seed, 7])
    folder.mkdir(parents=True, exist_ok=True)
    for run in truth.runs:
        if truth.film:
            render_run(truth, run, folder / f"{run.name}.avi", rng)
        else:
            run_table(truth, run, rng).to_csv(folder / f"{run.name}.csv", index=False, float_format="%.9g")
    (folder / "study.toml").write_text("\n".join(study_lines(truth, folder.name)) + "\n", encoding="utf-8")


def run_table(truth: Truth, run: RunTruth, rng: np.random.Generator) -> pd.DataFrame:
    """What a tracker of white noise would have given of one run."""
    slide = truth.slide(run)
    noise = truth.noise * rng.standard_normal(len(slide.t))
    return pd.DataFrame({"t_s": slide.t, "x_m": slide.x + slide.shift + noise} | _other_signals(truth, run, slide, rng))


def _other_signals(truth: Truth, run: RunTruth, slide: Trajectory, rng: np.random.Generator) -> dict[str, Array]:
    """Stated noise, vertical motion and drive, where the study has them."""
    out = {"sigma_m": np.full(len(slide.t), truth.noise)} if truth.stated else {}
    if truth.lift is not None:
        across = truth.noise * rng.standard_normal(len(slide.t))
        out["y_m"] = Oscillation(*truth.lift, run.phase)(slide.t) + across
    if truth.push:
        out["drive_N"] = truth.drive(run)(slide.t)
    return out


def study_lines(truth: Truth, name: str) -> Iterator[str]:
    """The study file: masses, base law, camera and runs."""
    yield from (
        "[study]",
        f'name = "{name}"',
        f"mass = {truth.mass:.6g}",
        f"model = {json.dumps(list(truth.model))}",
        "",
        "[camera]",
        f"fps = {truth.fps:g}",
        f'scale = "{truth.pitch * 1e3:.6g} mm/px"',
    )
    for run in truth.runs:
        source = f'video = "{run.name}.avi"' if truth.film else f'table = "{run.name}.csv"'
        yield from ("", "[[run]]", f'name = "{run.name}"', source)
        if run.mass_ratio != 1.0:
            yield f"mass = {truth.mass * run.mass_ratio:.6g}"
        if truth.clamp is not None:
            yield f"clamp_x = {truth.clamp:.6g}"
