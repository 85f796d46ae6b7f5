"""Write a study of known truth: tables or films, and a study file that does not reveal the truth."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from frictrack.blind.film_rendering import render_run
from frictrack.blind.truth import RunTruth, Truth
from frictrack.records import Array
from frictrack.simulate import Trajectory
from frictrack.simulate.rendering import Oscillation


def write_study(truth: Truth, folder: Path) -> None:
    """Write the study file, and a table or a film of each run.

    Parameters
    ----------
    truth
        Truth of the study; its seed also seeds the noise.
    folder
        Folder to write; created if it does not exist.

    """
    rng = np.random.default_rng([truth.seed, 7])
    folder.mkdir(parents=True, exist_ok=True)
    for run in truth.runs:
        if truth.film:
            render_run(truth, run, folder / f"{run.name}.avi", rng)
        else:
            run_table(truth, run, rng).to_csv(folder / f"{run.name}.csv", index=False, float_format="%.9g")
    (folder / "study.toml").write_text("\n".join(study_lines(truth, folder.name)) + "\n", encoding="utf-8")


def run_table(truth: Truth, run: RunTruth, rng: np.random.Generator) -> pd.DataFrame:
    """Simulate the measured table of one run: the true motion with white noise.

    Parameters
    ----------
    truth, run
        Truth of the study, and of the run.
    rng
        Source of the noise.

    Returns
    -------
    DataFrame
        t_s and x_m; where the study measures them sigma_m, y_m and drive_N.

    """
    trajectory = truth.trajectory(run)
    noise = truth.noise * rng.standard_normal(len(trajectory.t))
    return pd.DataFrame(
        {"t_s": trajectory.t, "x_m": trajectory.x + trajectory.shift + noise}
        | _other_signals(truth, run, trajectory, rng)
    )


def _other_signals(truth: Truth, run: RunTruth, trajectory: Trajectory, rng: np.random.Generator) -> dict[str, Array]:
    """Columns of stated noise, vertical motion and drive, where the study has them."""
    out = {"sigma_m": np.full(len(trajectory.t), truth.noise)} if truth.stated else {}
    if truth.lift is not None:
        noise_y = truth.noise * rng.standard_normal(len(trajectory.t))
        out["y_m"] = Oscillation(*truth.lift, run.phase)(trajectory.t) + noise_y
    if truth.push:
        out["drive_N"] = truth.drive(run)(trajectory.t)
    return out


def study_lines(truth: Truth, name: str) -> Iterator[str]:
    """Lines of the study file: masses, base law, camera and runs."""
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
        if run.earlier:
            yield f"pause = {run.earlier[-1][0]:.6g}"
        if truth.clamp is not None:
            yield f"clamp_x = {truth.clamp:.6g}"
