"""Where a local cause truly acts, and how well the stretches named as failing agree with it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from frictrack.blind.detector import SLOW
from frictrack.blind.truth import RunTruth, Truth
from frictrack.records import Array, Mask
from frictrack.simulate.slide import Slide

WIDE = 2.0  # standard deviations on either side over which a patch or a blow acts
LOCAL = ("patch", "collision")


def overlap(truth: Truth, spans: list[dict[str, Any]], smear: Mapping[str, float]) -> float | None:
    """F1 over all frames of where the one hidden cause acts and where the model is said to fail; None for others.

    `smear` (s) is the half width of every run's low-pass, by which a blow is seen wider than it is.
    """
    if len(truth.hidden) != 1 or truth.hidden[0] not in LOCAL:
        return None
    name = truth.hidden[0]
    hit = said = true = 0
    for run in truth.runs:
        slide = truth.slide(run)
        acts = acting(name, run, slide, smear.get(run.name, 0.0))
        told = _told(slide.t, [span["t"] for span in spans if span["run"] == run.name])
        hit, said, true = hit + int((acts & told).sum()), said + int(told.sum()), true + int(acts.sum())
    return 2 * hit / max(said + true, 1)


def acting(name: str, run: RunTruth, slide: Slide, smear: float) -> Mask:
    """Frames in which a patch or a blow acts on a run that moves."""
    own = run.values.get(name)
    if own is None:
        return np.zeros(len(slide.t), dtype=bool)
    if name == "patch":
        inside = np.abs(slide.x - own["x_c"]) <= WIDE * own["w"]
        return np.asarray(inside & (np.abs(slide.v) > SLOW))
    return np.asarray(np.abs(slide.t - own["time"]) <= WIDE * own["width"] + smear)


def _told(t: Array, stretches: list[list[float]]) -> Mask:
    out: Mask = np.zeros(len(t), dtype=bool)
    for first, last in stretches:
        out |= (t >= first - 1e-9) & (t <= last + 1e-9)
    return out
