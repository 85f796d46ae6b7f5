"""What one looks at: the contact sheet."""

from __future__ import annotations

import subprocess
import sys

import cv2
import numpy as np
import pytest
from blocks import SHAPE, SLIDE, N, a_film

from frictrack.base.errors import FrictrackError
from frictrack.records import Track
from frictrack.tracking import contact_sheet, overlay_video, target_line, track
from frictrack.tracking.show import COLOURS, Canvas, corners


def a_track(x, name="target", angle=0.0, lost=()):
    """A track of a block, as the tracker would return it."""
    n = len(x)
    one, y = np.full(n, 0.003), np.full(n, 31.5)
    places = np.array(x, dtype=float)
    places[list(lost)] = np.nan
    reason = np.array(["gone" if i in lost else "" for i in range(n)])
    where = (float(round(x[0] - 24)), 13.0, 48.0, 36.0)
    return Track(np.arange(n) / 4000, places, y, angle * one / 0.003, one, one, one, reason, name, where)


def near(picture, colour, tolerance=40):
    """Pixels (rows, columns) of about this colour (B, G, R)."""
    return np.nonzero(np.all(np.abs(picture.astype(int) - colour) < tolerance, axis=2))


def test_contact_sheet(tmp_path):
    recording = a_film(SLIDE)
    result = track(recording)
    path = contact_sheet(recording, result, tmp_path / "sheet.png")
    picture = cv2.imread(str(path))
    assert picture.shape[1] == 1280
    assert 300 < picture.shape[0] < 1400
    orange = np.all(np.abs(picture.astype(int) - (0x1C, 0x9F, 0xFF)) < 30, axis=2)
    assert orange.sum() > 500  # the rectangles
    assert target_line(result).startswith("target = [")


def test_axes_of_the_sheet_are_named(tmp_path, monkeypatch):
    written = []
    monkeypatch.setattr(Canvas, "text", lambda self, at, text, *_, **__: written.append((text, at)))
    contact_sheet(a_film(SLIDE), a_track(SLIDE), tmp_path / "sheet.png")
    names = [text for text, _ in written]
    assert names.count("x / px") == names.count("y / px") == 6
    at = {text: place for text, place in written[:20]}
    assert at["x / px"][0] > max(x for text, (x, y) in written[:20] if text.isdigit() and y == at["x / px"][1])


def test_the_sheet_shows_the_target_where_it_is(tmp_path):
    recording, track_of_block = a_film(SLIDE), a_track(SLIDE)
    picture = cv2.imread(str(contact_sheet(recording, track_of_block, tmp_path / "sheet.png")))
    rows, columns = near(picture, (0x1C, 0x9F, 0xFF), 60)
    left, width = 45, (1280 - 45 - 13 - 58) / 2  # of the first panel, px
    scale = width / SHAPE[1]
    first = columns[(columns < left + width) & (rows < np.min(rows) + 20)]
    assert np.min(first) == pytest.approx(left + scale * (SLIDE[0] - 24 + 0.5), abs=3)
    assert np.max(first) == pytest.approx(left + scale * (SLIDE[0] + 24 + 0.5), abs=3)


def test_a_sheet_is_drawn_without_matplotlib():
    code = "import sys, frictrack.tracking.show; print('matplotlib' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_contact_sheet_with_a_reference(tmp_path):
    recording, base = a_film(SLIDE), a_track(np.full(N, 200.0), "reference")
    plain = cv2.imread(str(contact_sheet(recording, a_track(SLIDE), tmp_path / "a.png")))
    both = cv2.imread(str(contact_sheet(recording, a_track(SLIDE), tmp_path / "b.png", [base])))
    green = (0x5A, 0xDC, 0x78)
    assert len(near(plain, green)[0]) < 20
    assert len(near(both, green)[0]) > 500


def frames_of(path):
    film = cv2.VideoCapture(str(path))
    found = []
    while True:
        ok, frame = film.read()
        if not ok:
            return found
        found.append(frame)


@pytest.mark.parametrize("name", ["out.avi", "out.mp4"])
def test_the_rectangle_is_where_the_target_is(tmp_path, name):
    path = overlay_video(a_film(SLIDE), a_track(SLIDE), tmp_path / name)
    frames = frames_of(path)
    assert len(frames) == N
    zoom = 3  # 240 px are enlarged to at least 640
    assert frames[0].shape[1] == zoom * SHAPE[1]
    for i in (0, 30, 79):
        # Compressed colours are washed out; orange is where red exceeds blue.
        red = frames[i][: zoom * SHAPE[0], :, 2].astype(int) - frames[i][: zoom * SHAPE[0], :, 0]
        _, columns = np.nonzero(red > 90)
        assert columns.max() / zoom == pytest.approx(SLIDE[i] + 24, abs=1.5)
    assert list(tmp_path.iterdir()) == [path]


def test_a_long_film_stays_small_and_others_have_colours(tmp_path):
    others = [a_track(np.full(N, 200.0), "reference")]
    frames = frames_of(overlay_video(a_film(SLIDE), a_track(SLIDE), tmp_path / "out.avi", others=others, frames=20))
    assert len(frames) == 20
    assert frames[0].shape[0] == 3 * SHAPE[0] + 2 * 22
    blue = frames[5][..., 0].astype(int) - frames[5][..., 2]
    assert np.count_nonzero(blue > 90) > 200
    assert COLOURS[0] != COLOURS[1]


def test_a_lost_frame_has_no_rectangle(tmp_path):
    frames = frames_of(overlay_video(a_film(SLIDE), a_track(SLIDE, lost=[40]), tmp_path / "out.avi"))
    orange = [np.count_nonzero(f[:192, :, 2].astype(int) - f[:192, :, 0] > 90) for f in frames]
    assert orange[40] < 0.7 * orange[39]
    assert orange[41] > 0.9 * orange[39]


def test_the_rectangle_turns_with_the_target():
    """A positive angle turns x toward y, which is down: clockwise as seen."""
    turned = corners(a_track(SLIDE, angle=0.1), 0)
    upper_left, upper_right = turned[0], turned[1]
    assert upper_right[1] - upper_left[1] == pytest.approx(48 * np.sin(0.1))
    np.testing.assert_allclose(turned.mean(axis=0), (SLIDE[0], 31.5))


def test_an_overlay_in_an_unknown_format(tmp_path):
    with pytest.raises(FrictrackError, match=r'out.gif: expected an overlay ending in .avi or .mp4 but got ".gif"'):
        overlay_video(a_film(SLIDE[:3]), a_track(SLIDE[:3]), tmp_path / "out.gif")
