"""Write a study of known truth: tables or films, a study file that does not reveal the truth, and the sealed truth."""

from __future__ import annotations

import base64
import hashlib
import json
import zlib
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.interpolate import CubicSpline

from frictrack.base.errors import FrictrackError
from frictrack.records import Array
from frictrack.simulate import Trajectory
from frictrack.simulate.rendering import Camera, Oscillation, Surface, Target, render, write_film
from frictrack.validation.blind.truth import RunTruth, Truth, read_truth

FILM_WIDTH_PX, FILM_HEIGHT_PX = 480, 72  # px
BLOCK_SIZE_PX = (76.0, 48.0)  # px
FULL_WELL_E, READ_NOISE_E = 3500.0, 50.0  # electrons: a short exposure in a dim room
WALL = Surface(size=5.0, level=0.3, contrast=0.2, seed=2)  # more contrast than the noise, so that it shows a shake
SEAL_FILE = "seal.json"
SEALED_SUFFIXES = (".csv", ".toml", ".avi")


def render_run(truth: Truth, run: RunTruth, path: Path, rng: np.random.Generator) -> None:
    """Render one run with the hidden effects of its truth.

    `truth`, `run`: truth of the study, and of the run.
    """
    trajectory, camera = truth.trajectory(run), _camera(truth, run)
    drawn = 0.0 if "camera_shake" in run.values else trajectory.shift  # a shake moves the whole picture instead
    x = (trajectory.x + drawn) / truth.pitch
    spline = CubicSpline(trajectory.t, x)
    y = FILM_HEIGHT_PX / 2 - 3

    def position(t: Array) -> tuple[Array, Array]:
        return spline(t), np.full(np.shape(t), y)

    # the picture's y points down
    rotation = None if truth.turn is None else Oscillation(-truth.turn[0], truth.turn[1], run.phase)
    target = Target(width=BLOCK_SIZE_PX[0], height=BLOCK_SIZE_PX[1], background=WALL, rotation=rotation)
    write_film(render(position, camera, target, rng, n_frames=len(x)), path, camera.fps)


def _camera(truth: Truth, run: RunTruth) -> Camera:
    """Camera of one run, with its shake."""
    shake = run.values.get("camera_shake")
    shake_x = None
    if shake is not None:
        shake_x = Oscillation(shake["amplitude"] / truth.pitch, shake["frequency"], shake["phase"])
    return Camera(
        fps=truth.fps,
        width=FILM_WIDTH_PX,
        height=FILM_HEIGHT_PX,
        scale=truth.pitch,
        full_well=FULL_WELL_E,
        read_noise=READ_NOISE_E,
        shake_x=shake_x,
    )


def write_study(truth: Truth, folder: Path) -> None:
    """Write the study file, and a table or a film of each run.

    `truth`: truth of the study; its seed also seeds the noise; `folder`: folder to write; created if it does not exist.
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

    `truth`, `run`: truth of the study, and of the run. Returns t_s and x_m; where the study measures them sigma_m, y_m
    and drive_N.
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


def seal(folder: Path, truths: dict[str, Truth]) -> None:
    """Write the truth of all studies, encoded so that nobody reads it by accident, with a checksum of each file.

    `folder`: folder with one sub-folder per study; `truths`: truth by name of the study.
    """
    text = json.dumps({name: asdict(t) for name, t in truths.items()})
    packed = base64.b64encode(zlib.compress(text.encode(), 9)).decode()
    body = {"studies": len(truths), "sealed": packed, "files": file_hashes(folder)}
    (folder / SEAL_FILE).write_text(json.dumps(body, indent=1), encoding="utf-8")


def open_seal(folder: Path) -> dict[str, Truth]:
    """Read the sealed truth and verify the checksums.

    Returns the truth by name of the study. Raises FrictrackError if there is no sealed truth (usage), or if a file
    changed.
    """
    path = folder / SEAL_FILE
    if not path.is_file():
        raise FrictrackError(
            f"expected the folder of `frictrack blind make` but found no {SEAL_FILE} in {folder}", usage=True
        )
    body = json.loads(path.read_text(encoding="utf-8"))
    now = file_hashes(folder)
    changed = [name for name, digest in body["files"].items() if now.get(name) != digest]
    if changed:
        raise FrictrackError(
            f"expected the studies as they were made but {', '.join(changed[:3])} changed since; "
            "make them again in another folder"
        )
    raw = json.loads(zlib.decompress(base64.b64decode(body["sealed"])))
    return {name: read_truth(entry) for name, entry in raw.items()}


def file_hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of each table, film and study file, by path within the folder."""
    files = sorted(p for p in folder.glob("*/*") if p.suffix in SEALED_SUFFIXES)
    return {p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}
