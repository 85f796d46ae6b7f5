"""Interlaced films: two fields of half a frame each are found from the lines; progressive films are left alone."""

from __future__ import annotations

import numpy as np
import pytest
from film import Film, block_film

import frictrack as ft

FRAMES = 40


def films(step, *, y=None):
    """A block that moves by `step` px per frame, seen progressively and with odd lines half a frame late."""
    x = 60 + (0 if step > 0 else 300) + step * np.arange(2 * FRAMES) / 2
    y = None if y is None else np.repeat(y, 2)
    fields = block_film(x, y, size=(60, 90))
    progressive = Film(lambda i: fields.frame(2 * i), FRAMES, fields.shape)

    def woven(i):
        picture = fields.frame(2 * i).copy()
        picture[1::2] = fields.frame(2 * i + 1)[1::2]
        return picture

    top = (fields.shape[0] - 1) / 2 if y is None else y[0]
    return progressive, Film(woven, FRAMES, fields.shape), [int(x[0]) - 45, int(top) - 30, 90, 60]


def notes(film, target, **known):
    return [note for note in ft.track(film, target, **known).notes if "interlaced" in note]


@pytest.mark.few(1)
@pytest.mark.parametrize("step", [1.5, -3.0, 6.0])
def test_odd_lines_half_a_frame_late_are_found(step):
    progressive, interlaced, target = films(step)
    assert notes(progressive, target) == []
    (note,) = notes(interlaced, target)
    assert "separate the fields" in note


@pytest.mark.slow
def test_a_target_that_also_moves_across_the_lines_is_judged_by_the_lines_of_the_film():
    progressive, interlaced, target = films(3.0, y=50 + 0.7 * np.arange(FRAMES))
    assert notes(progressive, target) == []
    assert len(notes(interlaced, target)) == 1


def test_nothing_is_said_of_a_slow_target():
    _, interlaced, target = films(0.3)
    assert notes(interlaced, target) == []
