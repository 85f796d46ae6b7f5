"""Run other trackers on the same frames as their manuals show; needs numpy and OpenCV, others where installed.

Runs in an environment of its own, because pyidi brings another OpenCV than ours:

    python -m venv peers
    peers/bin/pip install opencv-contrib-python scikit-image trackpy pyidi

Every peer follows the rectangle of frame 0 and returns its displacement since then, NaN where it says that it is lost.
All that search only near a place get it from their own last two positions, reach 5 px.
"""

from __future__ import annotations

import importlib
import json
import logging
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Frames = NDArray[np.uint8]
Rectangle = tuple[int, int, int, int]
SEARCH_REACH_PX = 5
LK = {"winSize": (21, 21), "maxLevel": 2}
NOT_FOUND = np.full(2, np.nan)


class Cut:
    """Template of frame 0, and a part of every frame round the place where the last two positions point to."""

    def __init__(self, frames: Frames, rectangle: Rectangle) -> None:
        x, y, self.w, self.h = rectangle
        self.frames, self.corner = frames, np.array([x, y])
        self.template = np.ascontiguousarray(frames[0][y : y + self.h, x : x + self.w])
        self.found = [np.zeros(2), np.zeros(2)]  # displacements

    def around(self, i: int, margin: int) -> tuple[Frames, Array]:
        """Part of frame i, `margin` px wider all round, and the displacement that its middle means."""
        frame = self.frames[i]
        low = np.rint(self.corner + 2 * self.found[-1] - self.found[-2]).astype(int) - margin
        size = np.array([self.w, self.h]) + 2 * margin
        low = np.clip(low, 0, np.array(frame.shape[::-1]) - size)
        part = frame[low[1] : low[1] + size[1], low[0] : low[0] + size[0]]
        return np.ascontiguousarray(part), low + margin - self.corner

    def all(self, step: Callable[[int], Array]) -> Array:
        """Displacements of all frames; a peer that is lost goes on from where it was last."""
        out = np.zeros((len(self.frames), 2))
        for i in range(1, len(out)):
            out[i] = step(i)
            self.found = [self.found[-1], out[i] if np.all(np.isfinite(out[i])) else self.found[-1]]
        return out


def _vertex(scores: Any, i: int) -> float:
    if not 0 < i < len(scores) - 1:
        return 0.0
    left, middle, right = (float(scores[i + k]) for k in (-1, 0, 1))
    return (left - right) / (2 * (left - 2 * middle + right))


def _best(scores: Any) -> Array:
    _, _, _, (i, j) = cv2.minMaxLoc(scores)
    return np.array([i + _vertex(scores[j], i), j + _vertex(scores[:, i], j)])


def match_everywhere(frames: Frames, rectangle: Rectangle) -> Array:
    cut = Cut(frames, rectangle)
    return cut.all(lambda i: _best(cv2.matchTemplate(frames[i], cut.template, cv2.TM_CCOEFF_NORMED)) - cut.corner)


def match_near(frames: Frames, rectangle: Rectangle) -> Array:
    cut = Cut(frames, rectangle)

    def step(i: int) -> Array:
        part, at = cut.around(i, SEARCH_REACH_PX)
        return at - SEARCH_REACH_PX + _best(cv2.matchTemplate(part, cut.template, cv2.TM_CCOEFF_NORMED))

    return cut.all(step)


def phase_correlate(frames: Frames, rectangle: Rectangle) -> Array:
    cut = Cut(frames, rectangle)
    window = cv2.createHanningWindow((cut.w, cut.h), cv2.CV_32F)
    template = cut.template.astype(np.float32)

    def step(i: int) -> Array:
        part, at = cut.around(i, 0)
        return at + np.array(cv2.phaseCorrelate(template, part.astype(np.float32), window)[0])

    return cut.all(step)


def ecc(frames: Frames, rectangle: Rectangle, gauss: int = 5) -> Array:
    cut = Cut(frames, rectangle)
    enough = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-6)

    def step(i: int) -> Array:
        part, at = cut.around(i, SEARCH_REACH_PX)
        warp = np.array([[1, 0, SEARCH_REACH_PX], [0, 1, SEARCH_REACH_PX]], np.float32)
        try:
            _, warp = cv2.findTransformECC(cut.template, part, warp, cv2.MOTION_TRANSLATION, enough, None, gauss)
        except cv2.error:  # its way to say that it does not converge
            return NOT_FOUND
        return at - SEARCH_REACH_PX + warp[:, 2]

    return cut.all(step)


def ecc_sharp(frames: Frames, rectangle: Rectangle) -> Array:
    return ecc(frames, rectangle, gauss=1)


def _corners(frame: Frames, rectangle: Rectangle) -> Any:
    """Corners that lie so far inside the rectangle that their own windows do not see the background."""
    x, y, w, h = rectangle
    inside, edge = np.zeros_like(frame), LK["winSize"][0] // 2
    inside[y + edge : y + h - edge, x + edge : x + w - edge] = 255
    return cv2.goodFeaturesToTrack(frame, 100, 0.01, 5, mask=inside)


def lucas_kanade(frames: Frames, rectangle: Rectangle) -> Array:
    """Pyramidal, every frame against frame 0: median of up to 100 corners."""
    cut = Cut(frames, rectangle)
    margin = 12
    first, _ = cut.around(0, margin)
    points = _corners(first, (margin, margin, cut.w, cut.h))

    def step(i: int) -> Array:
        part, at = cut.around(i, margin)
        moved, status, _ = cv2.calcOpticalFlowPyrLK(first, part, points, None, **LK)
        good = status.ravel() == 1
        return at + np.median((moved - points)[good, 0], axis=0) if good.any() else NOT_FOUND

    return cut.all(step)


def lucas_kanade_summed(frames: Frames, rectangle: Rectangle) -> Array:
    """Pyramidal, from frame to frame, summed."""
    points = _corners(frames[0], rectangle)
    out = np.full((len(frames), 2), np.nan)
    out[0] = 0
    for i in range(1, len(frames)):
        moved, status, _ = cv2.calcOpticalFlowPyrLK(frames[i - 1], frames[i], points, None, **LK)
        good = status.ravel() == 1
        if not good.any():
            break
        out[i] = out[i - 1] + np.median((moved - points)[good, 0], axis=0)
        points = moved[good]
    return out


def skimage_phase(frames: Frames, rectangle: Rectangle) -> Array:
    from skimage.registration import phase_cross_correlation  # noqa: PLC0415 - only where installed

    cut = Cut(frames, rectangle)

    def step(i: int) -> Array:
        part, at = cut.around(i, 0)
        shift, _, _ = phase_cross_correlation(cut.template, part, upsample_factor=100, normalization=None)
        return at - shift[::-1]

    return cut.all(step)


def trackpy_dots(frames: Frames, rectangle: Rectangle) -> Array:
    """Dark dots located and linked; mean displacement of those seen in every frame."""
    import trackpy  # noqa: PLC0415 - only where installed

    trackpy.quiet()
    x, y, w, h = rectangle
    located = trackpy.batch(frames, 7, minmass=150, invert=True, processes=1, engine="python")
    linked = trackpy.link(located, 5, memory=2)
    first = linked[(linked.frame == 0) & linked.x.between(x, x + w) & linked.y.between(y, y + h)]
    tracks = linked[linked.particle.isin(first.particle)].pivot(index="frame", columns="particle", values=["x", "y"])
    tracks = tracks.reindex(range(len(frames)))
    moved = tracks - tracks.iloc[0]
    return np.stack([moved[axis].mean(axis=1) for axis in ("x", "y")], axis=1)


def pyidi_lucas_kanade(frames: Frames, rectangle: Rectangle) -> Array:
    from pyidi import LucasKanade, VideoReader  # noqa: PLC0415 - only where installed

    x, y, w, h = rectangle
    with tempfile.TemporaryDirectory() as folder:
        method = LucasKanade(VideoReader(frames, root=folder))
        method.set_points([[y + h // 2, x + w // 2]])
        method.configure(roi_size=(h, w), verbose=0, show_pbar=False)
        return method.get_displacements(autosave=False)[0][:, ::-1]


PEERS: dict[str, tuple[str, Callable[[Frames, Rectangle], Array]]] = {
    "matchTemplate everywhere + parabola": ("cv2", match_everywhere),
    "matchTemplate near + parabola": ("cv2", match_near),
    "phaseCorrelate, Hann": ("cv2", phase_correlate),
    "ECC (gauss 5)": ("cv2", ecc),
    "ECC (gauss 1)": ("cv2", ecc_sharp),
    "PyrLK to frame 0": ("cv2", lucas_kanade),
    "PyrLK summed": ("cv2", lucas_kanade_summed),
    "skimage x100 (normalization=None)": ("skimage", skimage_phase),
    "trackpy, mean of dots": ("trackpy", trackpy_dots),
    "pyidi LucasKanade": ("pyidi", pyidi_lucas_kanade),
}
ONLY_ON = {"trackpy, mean of dots": "dots"}
WARM_UP = 4  # frames that nobody counts: compilation, first use


def run(name: str, frames: Frames, rectangle: Rectangle) -> tuple[Array, float]:
    """Displacements (n, 2) of one peer and the CPU seconds that it took."""
    peer = PEERS[name][1]
    peer(frames[:WARM_UP], rectangle)
    start = time.process_time()
    try:
        found = peer(frames, rectangle)
    except Exception as fault:  # noqa: BLE001 - a peer that breaks off has lost every frame
        print(f"{name}: {fault}")
        found = np.full((len(frames), 2), np.nan)
    return found, time.process_time() - start


def main() -> None:
    """Run the peers of one job on one film and leave what they found in a .npz file."""
    job = json.loads(sys.argv[1])  # file, offset, shape, rectangle, peers, out
    warnings.simplefilter("ignore")
    logging.disable()
    cv2.setNumThreads(1)
    # In memory: what is measured is the tracking; reading is another table.
    mapped = np.memmap(job["file"], np.uint8, "r", offset=job["offset"], shape=tuple(job["shape"]))
    frames, out = np.array(mapped), {}
    for name in job["peers"]:
        library = PEERS[name][0]
        try:
            version = getattr(importlib.import_module(library), "__version__", "")
        except ImportError:
            continue
        found, seconds = run(name, frames, tuple(job["rectangle"]))
        out |= {f"{name}/found": found, f"{name}/seconds": seconds, f"{name}/version": f"{library} {version}"}
    np.savez(Path(job["out"]), **out)


if __name__ == "__main__":
    main()
