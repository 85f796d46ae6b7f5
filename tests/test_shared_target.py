"""A target learnt from one film is used in the films that show the same, and only there."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from frictrack.flow import open_study
from frictrack.flow.stages import run_pipelines
from frictrack.recording import open_recording
from frictrack.records import Array
from frictrack.tracking import Areas, TargetModel, learn_target, track_same_target

SAMPLES = Path(__file__).parents[1] / "sample_videos"
PX_PER_M = 2000.0
FRAMES = 60


@pytest.fixture(scope="module")
def known() -> TargetModel:
    return learn_target(open_recording(SAMPLES / "slow.avi", fps=4000))


def true_px(name: str) -> Array:
    runs = json.loads((SAMPLES / "truth.json").read_text("utf-8"))["runs"]
    return PX_PER_M * np.array(next(run["x_m"] for run in runs if run["name"] == name))


def changed_film(folder: Path, change: Callable[[Array], Array]) -> Path:
    frames = [change(frame) for frame in open_recording(SAMPLES / "fast.avi", fps=4000).frames(0, FRAMES)]
    tifffile.imwrite(folder / "film.tif", np.stack(frames).astype(np.uint8))
    return folder / "film.tif"


def test_films_of_one_body_are_tracked_at_one_point_to_the_noise(known: TargetModel) -> None:
    offsets = []
    for name in ("slow", "fast", "to_a_stop"):
        shared = track_same_target(open_recording(SAMPLES / f"{name}.avi", fps=4000), Areas(), known)
        assert shared is not None
        track, _ = shared
        error = (track.x_px - true_px(name))[track.found]
        assert np.std(error) < 1.1 * np.median(track.sigma_px[track.found])
        offsets.append(float(np.mean(error)))
    assert np.ptp(offsets) < 0.0005  # px; with a target learnt from each film, 0.004


def test_the_order_of_the_runs_does_not_choose_the_film_that_all_follow(tmp_path: Path) -> None:
    for names in (("slow", "fast", "to_a_stop"), ("to_a_stop", "slow", "fast")):
        runs = "".join(f'[[run]]\nvideo = "{(SAMPLES / name).as_posix()}.avi"\n' for name in names)
        (tmp_path / "study.toml").write_text(f'[camera]\nfps = 4000\nscale = "0.5 mm/px"\n[study]\nmass = 0.35\n{runs}')
        pipelines = run_pipelines(open_study(tmp_path / "study.toml"))
        followed = {p.run.name: p.anchor.run.name if p.anchor else None for p in pipelines}
        assert followed == {"fast": None, "slow": "fast", "to_a_stop": "fast"}


def larger(frame: Array) -> Array:
    return np.asarray(cv2.resize(frame, None, fx=1.03, fy=1.03, interpolation=cv2.INTER_AREA))


def blurred(frame: Array) -> Array:
    return np.asarray(cv2.GaussianBlur(frame, (0, 0), 0.8))


def lit_from_the_side(frame: Array) -> Array:
    return frame * (1 + 0.2 * np.sin(np.arange(frame.shape[1]) / 40.0))


@pytest.mark.few(1)
@pytest.mark.parametrize("change", [larger, blurred, lit_from_the_side])
def test_a_film_in_which_the_target_looks_different_learns_its_own(
    known: TargetModel, tmp_path: Path, change: Callable[[Array], Array]
) -> None:
    assert track_same_target(open_recording(changed_film(tmp_path, np.asarray), fps=4000), Areas(), known)
    assert track_same_target(open_recording(changed_film(tmp_path, change), fps=4000), Areas(), known) is None
