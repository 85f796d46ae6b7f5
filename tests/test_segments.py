"""A long film is tracked in segments: in several processes with the same numbers, also where the target is hidden."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from film import block_film

from frictrack.base import workers
from frictrack.cli import main
from frictrack.flow import Session, open_study
from frictrack.recording import Recording, open_recording
from frictrack.records import Array, Track
from frictrack.tracking import batch_tracker, followed_target, track

N, SEGMENT = 360, 100
SIZE, SHAPE = (24, 36), (48, 160)
HIDDEN = slice(SEGMENT - 5, SEGMENT + 15)  # frames over the end of the first segment
X = 40 + 80 * np.sin(np.arange(N) / 115) ** 2


class OtherProcesses:
    """Workers that get a copy of everything, as processes do."""

    def __init__(self) -> None:
        self.tasks = 0

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        self.tasks += 1
        future: Future[Any] = Future()
        future.set_result(pickle.loads(pickle.dumps(function(*pickle.loads(pickle.dumps(arguments))))))
        return future

    def capacity(self) -> int:
        return 2


@pytest.fixture(scope="module")
def frames() -> Array:
    return np.stack([*block_film(X, size=SIZE, shape=SHAPE).frames()])


def written(folder: Path, frames: Array) -> Recording:
    tifffile.imwrite(folder / "film.tif", frames)
    return open_recording(folder / "film.tif", fps=4000)


def target() -> list[int]:
    return [round(X[0] - SIZE[1] / 2), (SHAPE[0] - SIZE[0]) // 2, SIZE[1], SIZE[0]]


def same(one: Track, other: Track) -> bool:
    pairs = [(getattr(one, f.name), getattr(other, f.name)) for f in fields(Track)]
    arrays = [(a, b) for a, b in pairs if isinstance(a, np.ndarray)]
    return len(arrays) > 6 and all(np.array_equal(a, b, equal_nan=a.dtype.kind == "f") for a, b in arrays)


def test_several_processes_give_the_same_positions(tmp_path: Path, frames: Array, monkeypatch: Any) -> None:
    film = written(tmp_path, frames)
    whole = track(film, target())
    for room in (batch_tracker, followed_target):
        monkeypatch.setattr(room, "SEGMENT_FRAMES", SEGMENT)
    pool = OtherProcesses()
    alone, parallel = track(film, target()), track(film, target(), pool=pool)
    assert pool.tasks >= N // SEGMENT
    assert same(alone, parallel)
    error = alone.x_px - X
    assert alone.found.all()
    assert np.std(error) < 1.2 * np.median(alone.sigma_px)
    assert np.max(np.abs(alone.x_px - whole.x_px)) < 0.2 * np.median(whole.sigma_px)


def test_a_target_that_is_hidden_between_two_segments_is_found_again(
    tmp_path: Path, frames: Array, monkeypatch: Any
) -> None:
    hidden = frames.copy()
    hidden[HIDDEN] = np.roll(frames[0], 90, axis=1)[:, ::-1]  # the scene alone, mirrored
    hidden[HIDDEN, 8:-8] = 110
    film = written(tmp_path, hidden)
    for room in (batch_tracker, followed_target):
        monkeypatch.setattr(room, "SEGMENT_FRAMES", SEGMENT)
    alone, parallel = track(film, target()), track(film, target(), pool=OtherProcesses())
    assert same(alone, parallel)
    assert not alone.found[HIDDEN].any()
    seen = np.delete(np.arange(N), np.r_[HIDDEN])
    assert alone.found[seen].mean() > 0.98
    error = alone.x_px[seen] - X[seen]
    assert np.nanmax(np.abs(error - np.nanmedian(error))) < 0.02


def study_of_film(folder: Path, frames: Array) -> Path:
    folder.mkdir()
    written(folder, frames)
    keys = ("[study]", 'mass = "0.35 kg"', "[camera]", "fps = 4000", 'scale = "0.5 mm/px"', "[[run]]", 'name = "a"')
    text = "\n".join((*keys, 'video = "film.tif"', f"target = {target()}"))
    (folder / "study.toml").write_text(text + "\n")
    return folder / "study.toml"


@pytest.mark.slow
def test_all_tracks_of_a_long_film_are_shared_between_processes(
    tmp_path: Path, frames: Array, monkeypatch: Any
) -> None:
    for room in (batch_tracker, followed_target):
        monkeypatch.setattr(room, "SEGMENT_FRAMES", SEGMENT)
    pool, opened = OtherProcesses(), []

    @contextmanager
    def processes(count: int) -> Iterator[OtherProcesses]:
        opened.append(count)
        yield pool

    monkeypatch.setattr(workers, "local_workers", processes)
    one, several = study_of_film(tmp_path / "one", frames), study_of_film(tmp_path / "several", frames)
    _run("track", str(one))
    assert not opened
    _run("track", str(several), "--workers", "2")
    assert opened == [2]
    assert pool.tasks >= 3 * (N // SEGMENT)  # followed, measured, followed backward
    (alone,), (parallel,) = Session(open_study(one)).runs, Session(open_study(several)).runs
    assert same(alone.get("track"), parallel.get("track"))
    assert same(alone.get("tracks")["backward"], parallel.get("tracks")["backward"])


def _run(*command: str) -> None:
    with pytest.raises(SystemExit) as ended:
        main(command)
    assert not ended.value.code
