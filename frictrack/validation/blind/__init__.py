"""Test the diagnosis blindly: write studies of known, sealed truth, diagnose them, and count what was right.

    from frictrack.validation.blind import make, score
    make(Path("blind"), n=42)           # studies and their sealed truth
    score(Path("blind"))                # shares of effects named first, false alarms, misses, ... with intervals

A study is drawn at random and a hidden effect is scaled to a size that an ideal detector can just see
(`truth_sampling`, `ideal_detector`), its tables or films are written, and each diagnosis becomes an
`Outcome`. Effects that fit as well as the hidden one (`equivalent_effects`) count as correct within a group.
The study file does not reveal the truth.
"""

from __future__ import annotations

import base64
import hashlib
import json
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pydantic import TypeAdapter
from scipy.interpolate import CubicSpline

from frictrack.base.errors import FrictrackError, UsageError
from frictrack.base.files import replace_text
from frictrack.base.workers import run_parallel
from frictrack.flow import Progress, no_progress
from frictrack.records import Array
from frictrack.results import to_builtins
from frictrack.simulate import Trajectory
from frictrack.simulate.rendering import Camera, Oscillation, Surface, Target, render, write_film
from frictrack.validation.blind.outcome import Outcome, judge_study, read_outcome, tally
from frictrack.validation.blind.truth import RunTruth, Truth
from frictrack.validation.blind.truth_sampling import KINDS, draw_truth

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
    own = None if shake is None else (shake["amplitude"] / truth.pitch, shake["frequency"], shake["phase"])
    return Camera(
        fps=truth.fps,
        width=FILM_WIDTH_PX,
        height=FILM_HEIGHT_PX,
        scale=truth.pitch,
        full_well=FULL_WELL_E,
        read_noise=READ_NOISE_E,
        shake_x=None if own is None else Oscillation(*own),
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
        raise UsageError(f"expected the folder of `frictrack blind make` but found no {SEAL_FILE} in {folder}")
    body = json.loads(path.read_text(encoding="utf-8"))
    now = file_hashes(folder)
    changed = [name for name, digest in body["files"].items() if now.get(name) != digest]
    if changed:
        raise FrictrackError(
            f"expected the studies as they were made but {', '.join(changed[:3])} changed since; "
            "make them again in another folder"
        )
    return TypeAdapter(dict[str, Truth]).validate_json(zlib.decompress(base64.b64decode(body["sealed"])))


def file_hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of each table, film and study file, by path within the folder."""
    files = sorted(p for p in folder.glob("*/*") if p.suffix in SEALED_SUFFIXES)
    return {p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


STUDIES_PER_KIND_TABLES = {"one": 200, "none": 100, "two": 60, "foreign": 60}
STUDIES_PER_KIND_FILMS = {"one": 20, "none": 10, "fault": 10}
STUDIES_OF_ONE_KIND = 60
OUTCOMES_FOLDER = "outcomes"


def make(  # noqa: PLR0913 - named settings
    folder: Path | str,
    n: int | None = None,
    *,
    seed: int = 0,
    film: bool = False,
    kind: str | None = None,
    workers: int | None = None,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Write studies of known truth into a new folder and seal the truth.

    Parameters
    ----------
    folder
        New or empty folder.
    n
        Number of studies; by default 420 with tables or 40 with films, or 60 of one kind.
    seed
        Seed of all draws.
    film
        Whether to render films instead of writing tables.
    kind
        Kind of all studies ("one", "none", "two", "three", "foreign" or "fault"); None for a mixture.
    workers
        Number of processes; by default as many as `run_parallel` chooses.
    progress
        Called with the number of studies done, the number of all and a text.

    Returns
    -------
    dict
        JSON of the command: studies, seed, film, seal, output.

    Raises
    ------
    FrictrackError
        If the folder contains files, n is below 1, or the kind is unknown (usage).

    """
    if kind is not None and kind not in KINDS:
        raise UsageError(f'expected one of the kinds {", ".join(KINDS)} but got "{kind}"')
    mixture = STUDIES_PER_KIND_FILMS if film else STUDIES_PER_KIND_TABLES
    of = mixture if kind is None else {kind: STUDIES_OF_ONE_KIND}
    n = sum(of.values()) if n is None else n
    folder = Path(folder)
    if n < 1:
        raise UsageError(f"expected at least one study but got --n {n}")
    if folder.exists() and any(folder.iterdir()):
        raise UsageError(f"expected a new or empty folder but {folder} contains files; give another folder")
    folder.mkdir(parents=True, exist_ok=True)
    jobs = _plan_studies(n, of, seed)
    names = [f"study_{i + 1:0{len(str(n))}d}" for i in range(n)]
    work = {name: partial(_make_study, folder / name, *job, film=film) for name, job in zip(names, jobs, strict=True)}
    truths = dict(_run_with_progress(work, workers, progress))
    seal(folder, {name: truths[name] for name in names})
    return {"studies": n, "seed": seed, "film": film, "seal": str(folder / SEAL_FILE), "output": str(folder)}


def _plan_studies(n: int, of: dict[str, int], seed: int) -> list[tuple[int, str, int]]:
    """Seed, kind and turn of each study, with kinds shuffled so that neither order nor name reveals them."""
    shares = {kind: n * count / sum(of.values()) for kind, count in of.items()}
    counts = {kind: int(share) for kind, share in shares.items()}
    short = sorted(shares, key=lambda kind: counts[kind] - shares[kind])[: n - sum(counts.values())]
    counts |= {kind: counts[kind] + 1 for kind in short}
    kinds = [kind for kind, count in counts.items() for _ in range(count)]
    rng = np.random.default_rng([seed, 11])
    rng.shuffle(kinds)
    seeds = rng.choice(2**31, n, replace=False)
    first_turn = {kind: int(rng.integers(100)) for kind in of}
    done: Counter[str] = Counter()
    out = []
    for own, kind in zip(seeds, kinds, strict=True):
        out.append((int(own), kind, first_turn[kind] + done[kind]))
        done[kind] += 1
    return out


def _make_study(folder: Path, seed: int, kind: str, turn: int, *, film: bool) -> Truth:
    """Draw and write one study."""
    truth = draw_truth(seed, kind, turn, film=film)
    write_study(truth, folder)
    return truth


def score(
    folder: Path | str, *, seed: int = 0, workers: int | None = None, progress: Progress = no_progress
) -> dict[str, Any]:
    """Open the sealed truth, diagnose each study, add the named effects, and count what was right.

    Each outcome is stored in the folder at once, so an interrupted call continues where it stopped.

    Parameters
    ----------
    folder
        Folder written by `make`.
    seed
        Seed of the diagnoses.
    workers, progress
        As in `make`.

    Returns
    -------
    dict
        JSON of the command; `tally` describes it. It is also written to score.json, with all outcomes.

    Raises
    ------
    FrictrackError
        If there is no sealed truth, or if files changed since it was sealed.

    """
    folder = Path(folder)
    truths = open_seal(folder)
    key = sha256((folder / SEAL_FILE).read_bytes()).hexdigest()[:16] + f" seed {seed}"
    kept = folder / OUTCOMES_FOLDER
    kept.mkdir(exist_ok=True)
    rows = {name: row for name in truths if (row := _read_kept(kept / f"{name}.json", key)) is not None}
    work = {
        name: partial(judge_study, name, truth, folder / name, seed)
        for name, truth in truths.items()
        if name not in rows
    }
    for name, row in _run_with_progress(work, workers, progress):
        rows[name] = row
        _write_json(kept / f"{name}.json", {"key": key, "outcome": _to_json(row)})
    counted = tally([rows[name] for name in truths])
    result: dict[str, Any] = to_builtins({"output": str(folder), "seed": seed} | counted)
    _write_json(folder / "score.json", result | {"outcomes": [_to_json(rows[name]) for name in truths]})
    return result


def _to_json(row: Outcome) -> dict[str, Any]:
    """Outcome as JSON."""
    values: dict[str, Any] = to_builtins(asdict(row))
    return {"alike" if key == "equivalents" else key: value for key, value in values.items()}  # key in existing files


def _read_kept(path: Path, key: str) -> Outcome | None:
    """Stored outcome; None if there is none, or only one of other studies or another seed."""
    if not path.is_file():
        return None
    stored = json.loads(path.read_text(encoding="utf-8"))
    return read_outcome(stored["outcome"]) if stored["key"] == key else None


def _write_json(path: Path, value: Any) -> None:
    """Replace a JSON file atomically."""
    replace_text(path, json.dumps(value, indent=1, ensure_ascii=False))


def _run_with_progress(
    work: dict[str, partial[Any]], workers: int | None, progress: Progress
) -> Iterator[tuple[str, Any]]:
    """Yield names and results as they finish, and report the progress."""
    progress(0, len(work), "studies")
    for done, pair in enumerate(run_parallel(work, workers), 1):
        progress(done, len(work), "studies")
        yield pair
