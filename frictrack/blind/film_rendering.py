"""Render the films of a blind study: a small block in front of a wall, with the faults that a film can have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from frictrack.blind.truth import RunTruth, Truth
from frictrack.records import Array
from frictrack.simulate import Trajectory
from frictrack.simulate.rendering import Camera, Oscillation, Surface, Target, render, write_film

FILM_WIDTH_PX, FILM_HEIGHT_PX = 480, 72  # px
BLOCK_SIZE_PX = (76.0, 48.0)  # px
FULL_WELL_E, READ_NOISE_E = 3500.0, 50.0  # electrons: a short exposure in a dim room
WALL = Surface(size=5.0, level=0.3, contrast=0.2, seed=2)  # more contrast than the noise, so that it shows a shake


def render_run(truth: Truth, run: RunTruth, path: Path, rng: np.random.Generator) -> None:
    """Render one run with the hidden effects of its truth.

    Parameters
    ----------
    truth, run
        Truth of the study, and of the run.
    path
        Film to write.
    rng
        Source of the noise.

    """
    trajectory, camera = truth.trajectory(run), _camera(truth, run)
    x = (trajectory.x + _drawn_shift(truth, run, trajectory)) / truth.pitch
    spline = CubicSpline(trajectory.t, x)
    y = FILM_HEIGHT_PX / 2 - 3

    def position(t: Array) -> tuple[Array, Array]:
        return spline(t), np.full(np.shape(t), y)

    target = Target(width=BLOCK_SIZE_PX[0], height=BLOCK_SIZE_PX[1], background=WALL, rotation=_rotation(truth, run))
    write_film(render(position, camera, target, rng, n_frames=len(x)), path, camera.fps)


def _drawn_shift(truth: Truth, run: RunTruth, trajectory: Trajectory) -> Array:
    """Shift (n,), m, to draw into the block's place; a camera shake moves the whole picture instead."""
    return np.zeros_like(trajectory.shift) if "camera_shake" in run.values else trajectory.shift


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


def _rotation(truth: Truth, run: RunTruth) -> Oscillation | None:
    """Angle of the target in the picture, whose y points down; None if it does not rotate."""
    return None if truth.turn is None else Oscillation(-truth.turn[0], truth.turn[1], run.phase)
