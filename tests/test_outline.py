"""The target's own size as the scale: drawn bodies of known width, textured and plain, square and round."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from frictrack.base.errors import FrictrackError
from frictrack.measure.calibration import calibrate, plane_map
from frictrack.measure.calibration.pictures import target_width
from frictrack.records import Track

SIZE = (130, 330)
FINE = 3
RIGHT = np.array([1.0, 0.0])


class Film:
    """Frames in memory."""

    shape = SIZE

    def __init__(self, frames):
        self.frames = frames

    def frame(self, i):
        return self.frames[i]


def filmed(width, height, *, disc=False, texture=18.0, contrast=80.0, angle=0.0, n=32, seed=0):
    """A body that slides over a mottled background above a floor, and its track; edges fall between pixels."""
    rng = np.random.default_rng(seed)
    h, w = SIZE
    back = 110 + 18 * mottled(rng, (h, w), 3)
    if not disc and angle == 0:
        back[100:] = 60
    skin = mottled(rng, (220, 220), 2).astype(np.float32)
    y = 99.5 - height / 2 if not disc and angle == 0 else 64.2
    x = 70.3 + 5.137 * np.arange(n)
    frames = [frame(back, skin, (x_i, y), (width, height), (disc, texture, contrast, angle)) for x_i in x]
    frames = [np.clip(np.rint(f + rng.normal(0, 2, f.shape)), 0, 255).astype(np.uint8) for f in frames]
    one = np.ones(n)
    corner = np.rint([x[0] - width / 2 + 2, y - height / 2 + 2])  # as found by itself: a little inside the outline
    track = Track(
        t=np.arange(n) / 4000, x_px=x, y_px=y * one, angle=0 * one, sigma_px=0.005 * one, sigma_y_px=0.005 * one,
        score=one, reason=np.full(n, ""), target=(*corner, float(width // 1 - 4), float(height // 1 - 4)),
    )  # fmt: skip
    return Film(frames), track


def mottled(rng, shape, grain):
    rough = cv2.GaussianBlur(rng.normal(0, 1, shape), (0, 0), grain)
    return rough / rough.std()


def frame(back, skin, at, size, look):
    disc, texture, contrast, angle = look
    h, w = SIZE
    v, u = ((np.arange(s * FINE) - (FINE - 1) / 2) / FINE - c for s, c in ((h, at[1]), (w, at[0])))
    u, v = np.meshgrid(u, v)
    along, across = u * np.cos(angle) + v * np.sin(angle), v * np.cos(angle) - u * np.sin(angle)
    inside = np.hypot(u, v) <= size[0] / 2 if disc else (np.abs(along) <= size[0] / 2) & (np.abs(across) <= size[1] / 2)
    grain = cv2.remap(skin, (along + 110).astype(np.float32), (across + 110).astype(np.float32), cv2.INTER_LINEAR)
    behind = cv2.resize(back, (w * FINE, h * FINE), interpolation=cv2.INTER_LINEAR)
    seen = np.where(inside, 110 + contrast + texture * grain, behind).astype(np.float32)
    return cv2.GaussianBlur(seen, (0, 0), 0.8 * FINE).reshape(h, FINE, w, FINE).mean(axis=(1, 3))


@pytest.mark.few(2)
@pytest.mark.parametrize(
    "look",
    [
        {"width": 60.37, "height": 40.0},
        {"width": 60.37, "height": 40.0, "texture": 0.0},
        {"width": 55.81, "height": 36.0, "contrast": -70.0, "seed": 1},
        {"width": 60.37, "height": 60.0, "disc": True, "texture": 0.0},
        {"width": 48.2, "height": 48.0, "disc": True, "seed": 2},
    ],
    ids=["textured", "plain", "dark", "disc", "textured disc"],
)
def test_width_of_a_body(look):
    film, track = filmed(**look)
    width = target_width(track, RIGHT, film)
    assert abs(np.linalg.norm(np.diff(width.ends, axis=0)) - look["width"]) < 2.5 * width.std
    assert width.std < 0.3
    assert ("diameter" in width.used) == look.get("disc", False)


def test_both_edges_of_a_noiseless_picture_have_the_error_of_light_and_focus():
    """Each edge may be off by 0.15 px however clear it is, and the width has two of them."""
    columns = np.exp(-0.5 * (np.arange(90) - 44.5) ** 8 / 25.0**8)  # the same profile in every row
    track = filmed(50.0, 30.0, n=2)[1]
    drawn = replace(track, target=(0.0, 0.0, 50.0, 30.0), picture=np.tile(60 + 100 * columns, (50, 1)))
    assert target_width(drawn, RIGHT).std == pytest.approx(np.hypot(0.15, 0.15), rel=1e-6)


@pytest.mark.slow
def test_the_stated_deviation_is_that_of_many_bodies():
    z = []
    for seed in range(12):
        film, track = filmed(40 + 1.37 * seed, 30.0 + 6 * (seed % 4), n=20, seed=seed)
        width = target_width(track, RIGHT, film)
        z.append((np.linalg.norm(np.diff(width.ends, axis=0)) - (40 + 1.37 * seed)) / width.std)
    assert np.sqrt(np.mean(np.square(z))) < 1.3


def test_along_a_course_that_is_not_level():
    film, track = filmed(60.37, 40.0, texture=0.0, angle=0.2)
    along = np.array([np.cos(0.2), np.sin(0.2)])
    assert np.linalg.norm(np.diff(target_width(track, along, film).ends, axis=0)) == pytest.approx(60.37, abs=0.4)


def test_scale_by_the_target():
    film, track = filmed(60.37, 40.0)
    made = plane_map({"target": "40.0 +/- 0.1 mm"}, track=track, film=film)
    d = calibrate(track, made)
    assert d.pixel_pitch == pytest.approx(0.040 / 60.37, rel=2.5 * d.relative_scale_error)
    assert 0.0025 < d.relative_scale_error < 0.006
    assert np.ptp(d.x) == pytest.approx(np.ptp(track.x_px) * 0.040 / 60.37, rel=2.5 * d.relative_scale_error)
    assert d.notes[0].startswith("scale by the target's size of 40 mm, 60.")
    assert "from edge to edge (straight: the middle chord)" in d.notes[0]


def test_no_outline_no_scale():
    film, track = filmed(60.37, 40.0, contrast=0.0)
    with pytest.raises(FrictrackError, match="the target's outline does not stand out from the background"):
        plane_map({"target": "40 mm"}, track=track, film=film)
    with pytest.raises(FrictrackError, match="expected a track for a scale by the target's size but got none"):
        plane_map({"target": "40 mm"})
    with pytest.raises(FrictrackError, match="expected a track with its target's rectangle"):
        plane_map({"target": "40 mm"}, track=track)


def test_a_target_that_fills_the_picture_gives_no_scale():
    film, track = filmed(60.37, 40.0)
    film.frames = [f[50:110, :] for f in film.frames]
    film.shape = (60, 330)
    track = replace(track, y_px=track.y_px - 50)
    with pytest.raises(FrictrackError, match="nowhere in the film with a rim of background"):
        plane_map({"target": "40 mm"}, track=track, film=film)
