"""Stated deviations of positions in compressed films, and of targets too sharp for the sensor, against truth."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import tifffile
from scipy.special import erf

from frictrack.recording import open_recording
from frictrack.tracking import track

H, W, SIDE = 80, 320, 48


def _drawn(n: int, *, fine: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Frames (n, H, W) of a textured plate that slows down, and its place (n,) px; `fine`: of squares of so many px."""
    rng, k = np.random.default_rng(3), np.arange(n)
    x = 45 + min(1.5, 250 / n) * (k - 0.35 * k**2 / n)
    rows, columns = np.arange(H)[:, None] - 0.5, np.arange(W + 1) - 0.5
    if fine:
        squares = rng.choice([-50.0, 50.0], (SIDE // fine, SIDE // fine)).repeat(fine, axis=0)
        integral = np.concatenate([np.zeros((SIDE, 1)), np.cumsum(squares.repeat(fine, axis=1), axis=1)], axis=1)
    else:
        spread = np.exp(-45 * (np.fft.fftfreq(64)[:, None] ** 2 + np.fft.rfftfreq(64) ** 2))
        waves = np.fft.rfft2(rng.normal(size=(64, 64))) * spread
    frames = np.empty((n, H, W), np.uint8)
    top = (H - SIDE) // 2
    for i, place in enumerate(x):
        light = np.full((H, W), 60.0)
        if fine:  # every pixel is the mean of what lies between its edges
            edges = np.clip(columns - place + SIDE / 2, 0, SIDE)
            sums = np.array([np.interp(edges, np.arange(SIDE + 1), row) for row in integral])
            covered = np.diff(edges)
            light[top : top + SIDE] += 90 * covered + np.diff(sums, axis=1)
        else:
            first = int(place) - 32
            moved = np.fft.irfft2(waves * np.exp(-2j * np.pi * np.fft.rfftfreq(64) * (place - int(place))), (64, 64))
            plate = np.zeros((H, W))
            plate[H // 2 - 32 : H // 2 + 32, max(first, 0) : first + 64] = 90 + 220 * moved[:, max(-first, 0) :]
            across = erf(columns[:-1] + 0.5 - place + SIDE / 2) - erf(columns[:-1] + 0.5 - place - SIDE / 2)
            light += plate * across * (erf(rows + 0.5 - top) - erf(rows + 0.5 - top - SIDE)) / 4
        frames[i] = np.clip(np.rint(light + rng.normal(0, 2, (H, W))), 0, 255)
    return frames, x


def _z(path, x):
    found = track(open_recording(path, fps=1000), [int(x[0]) - SIDE // 2 + 2, (H - SIDE) // 2 + 2, SIDE - 4, SIDE - 4])
    error = found.x_px - x
    error -= np.nanmean(error)
    return np.sqrt(np.nanmean(error**2 / (found.sigma_px**2 + found.systematic**2))), found


@pytest.mark.parametrize("codec", ["mp4v", "MJPG"])
def test_positions_in_compressed_films_err_by_what_is_stated(tmp_path, codec):
    frames, x = _drawn(160)
    path = tmp_path / ("film.mp4" if codec == "mp4v" else "film.avi")
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 30, (W, H), isColor=True)
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    writer.release()
    z, found = _z(path, x)
    assert 0.7 < z < 1.4
    assert any("codec" in note for note in found.notes) == (codec == "mp4v")


@pytest.mark.parametrize(("n", "fine"), [(60, 0), (60, 4), (140, 4)])
def test_few_frames_and_sharp_targets_err_by_what_is_stated(tmp_path, n, fine):
    frames, x = _drawn(n, fine=fine)
    tifffile.imwrite(tmp_path / "film.tif", frames)
    z, found = _z(tmp_path / "film.tif", x)
    assert 0.7 < z < 1.4
    assert not any("codec" in note for note in found.notes)
