"""Prediction of a run from the others: the held-out error beside the noise."""

from __future__ import annotations

import numpy as np
import pytest

import frictrack as ft
from frictrack.records import Displacement

FPS, NOISE_M, F_C, MASS = 4000, 5e-6, 2.0, 0.35
T = np.arange(400) / FPS


def slide(speed, late, seed):
    """A slide under Coulomb friction in closed form; from frame `late` on the camera is one frame late."""
    t = T + (np.arange(len(T)) >= late) / FPS
    x = speed * t - 0.5 * F_C / MASS * t**2 + NOISE_M * np.random.default_rng(seed).standard_normal(len(t))
    nan, one = np.full(len(T), np.nan), np.ones(len(T))
    displacement = Displacement(T, x, nan, nan, NOISE_M * one, nan, one == 1)
    return ft.Run(displacement, ft.differentiate(ft.low_pass(displacement)), mass=MASS, name=f"run{seed}")


@pytest.mark.few(1)
@pytest.mark.parametrize("seed", [0, 24, 27])
def test_a_dropped_frame_can_be_held_out_wherever_it_falls(seed):
    """The time of a dropped frame shows in one frame at most, an even or an odd one; both predict at the noise."""
    runs = [slide(3.0, 150 + seed, seed), slide(4.0, 201 + seed, seed + 1), slide(5.0, len(T), seed + 2)]
    errors = ft.fit("coulomb,dropped_frame", runs).errors
    assert errors["heldout"] == "run"
    assert errors["heldout_rms_um"] == pytest.approx(1e6 * NOISE_M, rel=0.05)


@pytest.mark.slow
def test_a_model_without_the_dropped_frame_fails_where_it_is_held_out():
    runs = [slide(3.0, 150, 0), slide(4.0, 201, 1), slide(5.0, len(T), 2)]
    assert ft.fit("coulomb", runs).errors["heldout_rms_um"] > 20 * 1e6 * NOISE_M
