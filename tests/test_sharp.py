"""A target sharper than the sensor resolves, drawn exactly: every pixel is the mean of what lies between its edges."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from film import block_film
from scipy.fft import dct

from frictrack.diagnose.examination import peak_locking_errors, slow_errors
from frictrack.measure.calibration import calibrate
from frictrack.recording import open_recording
from frictrack.records import Array, Track
from frictrack.simulate.rendering import write_film
from frictrack.tracking import learn_target, track
from frictrack.tracking.subpixel_fit import SubpixelFit
from frictrack.tracking.template import BAND_LIMIT, SUPER_RESOLUTION_BAND
from frictrack.tracking.template_learning import (
    learn_template,
    peak_locking_correction,
    smooth_path,
    template_from_frame,
)

FINE = 16  # cells of the drawing per pixel
SIZE = 40, 48  # px
NOISE = 2.0  # grey values
FRAMES = 240


def _drawing() -> Array:
    """Integral of a plate with a quartered disc over everything left of and above a cell's corner."""
    h, w = SIZE
    y, x = ((np.arange(n * FINE) + 0.5) / FINE - n / 2 for n in (h, w))
    quartered = (x > 0) ^ (y > 0)[:, None]
    plate = np.where(np.hypot(x, y[:, None]) < 13, np.where(quartered, 220.0, 20.0), 110.0)
    whole = np.zeros((h * FINE + 1, w * FINE + 1))
    whole[1:, 1:] = np.cumsum(np.cumsum(plate, axis=0), axis=1) / FINE**2
    return whole


def _row(whole: Array, edges: Array) -> Array:
    """The integral up to these places along x, linear between cells."""
    u = np.clip((edges + SIZE[1] / 2) * FINE, 0, whole.shape[1] - 1 - 1e-9)
    i = u.astype(int)
    return whole[:, i] * (1 - (u - i)) + whole[:, i + 1] * (u - i)


def _film(folder: Path, x: Array) -> Path:
    whole, rng = _drawing(), np.random.default_rng(1)
    height, width = 56, 280
    frames = np.empty((len(x), height, width), np.uint8)
    for k, place in enumerate(x):
        frame = np.full((height, width), 60.0) + 15 * np.sin(np.arange(width) / 37)
        first = int(place) - SIZE[1] // 2 - 1
        edges = np.arange(first, first + SIZE[1] + 3) - 0.5 - place
        top = (height - SIZE[0]) // 2
        seen = np.diff(_row(whole, edges)[::FINE], axis=0)
        shown = slice(first, first + len(edges) - 1)
        cover = np.diff(np.clip(edges, -SIZE[1] / 2, SIZE[1] / 2))
        part = frame[top : top + SIZE[0], shown]
        frame[top : top + SIZE[0], shown] = part * (1 - cover) + np.diff(seen, axis=1)
        frames[k] = np.clip(np.rint(frame + NOISE * rng.standard_normal(frame.shape)), 0, 255)
    path = folder / "sharp.tif"
    tifffile.imwrite(path, frames)
    return path


@pytest.mark.few(1)
@pytest.mark.parametrize("speed", [0.6, -0.57])
def test_places_of_a_sharp_target_are_not_drawn_to_the_pixels(tmp_path: Path, speed: float) -> None:
    t = np.arange(FRAMES)
    x = (50.3 if speed > 0 else 220.3) + speed * t + 2e-4 * t**2
    found = track(open_recording(_film(tmp_path, x), fps=4000), [int(x[0]) - 24, 8, 48, 40])
    off = found.x_px - x
    off -= np.nanmedian(off)
    by_place = [np.nanmedian(off[np.floor(10 * (x % 1)) == k]) for k in range(10)]
    assert np.ptp(by_place) < 0.008  # 0.04 px with a picture that has no waves shorter than two pixels
    assert np.sqrt(np.nanmean(off**2)) < 0.004


def test_noise_is_not_learnt_as_fine_structure() -> None:
    rng, (h, w) = np.random.default_rng(3), (40, 64)
    y, x = np.mgrid[:h, :w].astype(float)
    waves = [(30.0, 0.05, 0.11, 0.3), (20.0, 0.21, -0.07, 1.1), (15.0, -0.31, 0.16, 2.0)]  # all longer than two pixels

    def picture(shift: float) -> Array:
        return 100 + sum(a * np.sin(2 * np.pi * (f * (x - shift) + g * y) + q) for a, f, g, q in waves)

    shifts = rng.uniform(-0.5, 0.5, 200)
    cuts = np.stack([picture(p) + 5 * rng.standard_normal((h, w)) for p in shifts])
    one, zero = np.ones(200), np.zeros(200)
    places = SubpixelFit(np.stack([shifts, zero], 1), zero, np.ones((200, 2)), one, one, 100 * one, one, one > 0)
    plain = replace(template_from_frame(picture(0.0)), level=100.0)
    found = learn_template(cuts, places, plain.widened((BAND_LIMIT, SUPER_RESOLUTION_BAND)))
    slopes = (found.design(np.zeros((1, 2)))[0, 2] @ found.basis_images).reshape(h, w)[4:-4, 4:-4]
    true = (picture(1e-4) - picture(-1e-4))[4:-4, 4:-4] / 2e-4
    assert np.mean(slopes**2) == pytest.approx(np.mean(true**2), rel=0.02)  # 1.09 times that if noise had slopes
    assert np.mean(1 / found.weight) == pytest.approx(25.0, rel=0.02)


def test_a_smooth_path_is_kept_and_what_repeats_from_pixel_to_pixel_is_not() -> None:
    frames = np.arange(200)
    true = np.stack([10 + 1.3 * frames + 2e-4 * frames**2, np.full(200, 5.0)], axis=1)
    drawn = true + 0.05 * np.sin(2 * np.pi * true)
    path = smooth_path(frames, drawn, frames)
    known = np.isfinite(path.position[:, 0])
    assert known.mean() > 0.8
    assert not np.isfinite(path.position[:, 1]).any()
    assert np.max(np.abs(path.position[known, 0] - true[known, 0])) < 0.01
    assert list(path.axes) == [True, False]


def test_what_repeats_from_pixel_to_pixel_is_told_and_the_motion_is_kept() -> None:
    rng, frames = np.random.default_rng(2), np.arange(400)
    true = np.stack([10 + 1.3 * frames - 4e-4 * frames**2, np.full(400, 5.2)], axis=1)
    true[:, 0] += 0.2 * np.sin(2 * np.pi * frames / 90)  # the mass shakes
    seen = true + 0.003 * rng.standard_normal(true.shape)
    off, size = peak_locking_correction(frames, seen + 0.02 * np.sin(2 * np.pi * seen + 0.4))
    wanted = 0.02 * np.sin(2 * np.pi * true[:, 0] + 0.4)
    assert np.max(np.abs(off[:, 0] - wanted)) < 0.002
    assert abs(size[0] - 0.02) < 0.001
    assert not off[:, 1].any()
    assert np.max(np.abs(peak_locking_correction(frames, seen)[0])) < 0.002


def test_a_shake_is_not_taken_for_what_draws_places_to_the_pixels() -> None:
    frames, rng = np.arange(156), np.random.default_rng(1)
    true = 280 - 2.26 * frames + 6e-4 * frames**2
    shaken = true + 0.17 * np.sin(2 * np.pi * 283 * frames / 4000 + 1.0) + 0.005 * rng.standard_normal(156)
    places = np.stack([shaken, np.full(156, 30.0)], axis=1)
    assert not peak_locking_correction(frames, places)[0].any()  # 0.03 px, where the shake keeps step with the pixels
    assert not smooth_path(frames, places, frames).axes.any()


def test_what_stays_off_slowly_is_as_large_in_every_octave_and_goes_with_the_pitch() -> None:
    errors = slow_errors((512, 400), np.random.default_rng(3))
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(1, abs=0.02)
    energy = np.sum(dct(errors, axis=0, norm="ortho") ** 2, axis=1)
    octaves = [energy[2**k : 2 ** (k + 1)].sum() for k in range(1, 6)]
    assert np.ptp(octaves) < 0.3 * np.mean(octaves)
    t = np.arange(50) / 4000
    seen = Track(t, 3 + 400 * t, 0 * t, 0 * t, 0.01 + 0 * t, 0.01 + 0 * t, 1 + 0 * t, np.full(50, ""), systematic=1e-3)
    assert calibrate(seen, "0.5 mm/px").systematic == pytest.approx(0.5e-6)


@pytest.mark.parametrize(("step", "slow"), [(2.0, True), (2.137, False)])
def test_errors_that_repeat_from_pixel_to_pixel_are_slow_at_a_whole_number_of_pixels_per_frame(step: float, slow: bool):
    frames = np.arange(240)
    errors = peak_locking_errors(5.3 + step * frames - 2e-4 * (frames - 120.0) ** 2, 400, np.random.default_rng(2))
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(1, abs=0.05)
    calm = errors[100:140].mean(axis=0)  # white noise would come to 0.16
    assert (np.std(calm) > 0.5) == slow


@pytest.mark.slow
def test_the_blocks_of_a_codec_teach_no_short_waves(tmp_path: Path) -> None:
    i = np.arange(260)
    blocks = block_film(60 + 1.3 * i - 0.0012 * i**2, seed=10)
    write_film(blocks.frames(), tmp_path / "blocks.avi", 4000.0, 10)
    known = learn_target(open_recording(tmp_path / "blocks.avi", fps=4000), [15, 34, 90, 60])
    assert known.template.bands == (BAND_LIMIT, BAND_LIMIT)
