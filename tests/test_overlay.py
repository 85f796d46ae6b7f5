"""What one looks at: the contact sheet."""

from __future__ import annotations

import cv2
import numpy as np
from film import Film, block_film

from frictrack.tracking import contact_sheet, target_line, track

SIZE, SHAPE = (36, 48), (64, 240)  # of the block and the picture, px
N = 80
SLIDE = 40 + 150 * (1 - np.exp(-np.arange(N) / 40))


def a_film(x, change=None, **given):
    """The block film, drawn once; `change(i, frame)` may spoil frames."""
    source = block_film(np.asarray(x), size=SIZE, shape=SHAPE, **given)
    frames = [source.frame(i) for i in range(len(source))]
    if change:
        frames = [change(i, frame.copy()) for i, frame in enumerate(frames)]
    return Film(lambda i: frames[i], len(frames), frames[0].shape)


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
