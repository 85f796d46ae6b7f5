"""The tracking benchmark: its bound is what the best estimator reaches, its figures are what they are called."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from frictrack.simulate.rendering import render_clean

sys.path.insert(0, str(Path(__file__).parents[1] / "pipelines" / "benchmarks"))

from tracking import conditions
from tracking.measures import judge, locking, pool


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(conditions, "FOLDER", tmp_path)
    return tmp_path


def known_template(name: str, film: conditions.Condition) -> np.ndarray:
    """Errors of x (n,) px of one least-squares step from the truth on the noise-free picture, gain and offset free."""
    path, camera, target = conditions.scene(name, 0, len(film.x))
    target, h = replace(target, course=False), 0.02
    steps = [(0, 0), (h, 0), (-h, 0), (0, h), (0, -h)]
    moved = [
        render_clean(lambda t, s=s: (path(t)[0] + s[0], path(t)[1] + s[1]), camera, target, len(film.x)) for s in steps
    ]
    errors = []
    for frame, x, y, *clean in zip(film.frames, film.x, film.y, *moved, strict=True):
        here, right, left, down, up = (camera.mean(c) for c in clean)
        cut = conditions._window(x, y)
        columns = [(right - left) / (2 * h), (down - up) / (2 * h), here, np.ones_like(here)]
        sigma = camera.noise(clean[0])[cut].ravel()
        design = np.stack([c[cut].ravel() / sigma for c in columns], axis=1)
        errors.append(np.linalg.lstsq(design, (frame - here)[cut].ravel() / sigma, rcond=None)[0][0])
    return np.array(errors)


@pytest.mark.few(1)
@pytest.mark.parametrize("name", ["nominal", "lowlight"])
def test_the_bound_is_what_the_known_template_reaches(folder, name):
    film = conditions.condition(name, 0, 30)
    errors = known_template(name, film)
    assert errors.std() / film.bound == pytest.approx(1.0, abs=0.39)  # three of 1 / sqrt(2 n)
    assert abs(errors.mean()) < 4 * film.bound / np.sqrt(30)  # the truth has no offset


def test_a_film_is_rendered_once_and_travels_what_the_conditions_say(folder):
    film = conditions.condition("nominal", 1, 20)
    stamp = film.film.stat().st_mtime_ns
    assert conditions.condition("nominal", 1, 20).film.stat().st_mtime_ns == stamp
    assert np.array_equal(film.frames, conditions.condition("nominal", 1, 20).frames)
    x = conditions.truth("nominal", 1, 600)["x"]
    assert x[-1] - x[0] == pytest.approx(743, abs=2)
    v = np.diff(x) / 2
    assert np.diff(v).max() < 0  # decelerates all the way
    assert film.rectangle == (19, 34, 83, 53)


def test_a_compressed_film_comes_as_it_is_decoded(folder):
    film, raw = (conditions.condition(name, 0, 5) for name in ("mjpg", "nominal"))
    assert film.film.suffix == ".avi"
    gap = film.frames.astype(float) - raw.frames
    assert 0.3 < gap.std() < 4


def test_lost_silent_and_worst_are_counted_apart():
    x = np.linspace(0, 40, 200)
    found = x + 0.3
    found[10] += 5  # off and not given up
    found[20] = np.nan  # given up
    judged = judge(found, x, 1e-3, 1.0)
    assert (judged.lost, judged.silent) == (2, 1)
    assert judged.worst == pytest.approx(5.3)
    assert np.nanmax(np.abs(judged.error)) < 1e-12  # the constant is removed


def test_locking_is_the_amplitude_above_noise():
    rng = np.random.default_rng(0)
    x = np.cumsum(rng.uniform(0.5, 1.9, 5000))
    noise = 1.4e-3 * rng.standard_normal(5000)
    square, floor = locking(0.6e-3 * np.sin(2 * np.pi * x + 0.3) + noise, x)
    assert floor == pytest.approx((1.4e-3) ** 2 * 8 / 5000, rel=0.1)
    assert np.sqrt(square - floor) == pytest.approx(0.6e-3, rel=0.1)


def test_white_noise_at_the_bound_gives_ones():
    rng = np.random.default_rng(0)
    x, bound = np.linspace(0, 740, 600), 1.4e-3
    films = [judge(x + bound * rng.standard_normal(600), x, bound, 0.1, np.full(600, bound)) for _ in range(20)]
    figures = pool(films)
    assert figures["rms_over_bound"] == pytest.approx(1, abs=0.03)
    assert figures["z_rms"] == pytest.approx(1, abs=0.03)
    assert figures["acceleration_over_white"] == pytest.approx(1, abs=0.1)
    assert figures["acceleration_m_s2"] == pytest.approx(0.037, abs=0.004)  # as published for this bound
    assert figures["frames_per_s"] == pytest.approx(6000)
