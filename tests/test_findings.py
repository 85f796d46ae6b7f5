"""What the run says of its own measurement, against data whose faults are known."""

from __future__ import annotations

import numpy as np
import pytest

from frictrack.tracking.findings import key_frames


def key_frame_data(jump, period=15, n=600):
    rng = np.random.default_rng(8)
    at = np.arange(n) % period == 4
    change = 2 + 0.3 * rng.random(n) + 0.8 * at + np.linspace(0, 1, n)
    x = np.cumsum(np.linspace(0.2, 2, n)) + 0.02 * rng.standard_normal(n) + jump * np.cumsum(at)
    return change, x, 0.02 * rng.standard_normal(n)


def test_key_frames_that_move_the_target():
    (note,) = key_frames(*key_frame_data(0.1))
    assert note.startswith("positions jump by 0.1")
    assert note.endswith("px every 15th frame (key frames of the codec)")


def test_key_frames_that_do_not_move_it():
    (note,) = key_frames(*key_frame_data(0.0))
    assert note.startswith(
        "the picture jumps every 15th frame (key frames of the codec); positions jump with it by less"
    )


@pytest.mark.parametrize("flicker", [0.0, 1.0])
def test_no_key_frames_are_seen_in_noise_or_flicker(flicker):
    rng = np.random.default_rng(9)
    i = np.arange(600)
    change = 2 + 0.3 * rng.random(600) + flicker * np.abs(np.sin(np.pi * i / 15))
    assert key_frames(change, 0.02 * rng.standard_normal(600), 0.02 * rng.standard_normal(600)) == ()
