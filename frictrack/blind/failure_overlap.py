"""Where a local cause truly acts, and how well the stretches named as failing agree with it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from frictrack.blind.ideal_detector import MIN_SPEED
from frictrack.blind.truth import RunTruth, Truth, effect_named
from frictrack.effects import Effect
from frictrack.records import Array, Mask
from frictrack.simulate import Trajectory


def overlap(truth: Truth, spans: list[dict[str, Any]], low_pass_half_width: Mapping[str, float]) -> float | None:
    """F1 over all frames of where the one hidden cause acts and where the model is said to fail; None for others.

    `low_pass_half_width` (s) is the half width of every run's low-pass, by which a blow is seen wider than it is.
    """
    if len(truth.hidden) != 1 or effect_named(truth.hidden[0]).acts_within is None:
        return None
    effect = effect_named(truth.hidden[0])
    n_both = n_reported = n_true = 0
    for run in truth.runs:
        slide = truth.slide(run)
        acts = acting(effect, run, slide, low_pass_half_width.get(run.name, 0.0))
        reported = _frames_within(slide.t, [span["t"] for span in spans if span["run"] == run.name])
        n_both, n_reported, n_true = (
            n_both + int((acts & reported).sum()),
            n_reported + int(reported.sum()),
            n_true + int(acts.sum()),
        )
    return 2 * n_both / max(n_reported + n_true, 1)


def acting(effect: Effect, run: RunTruth, slide: Trajectory, low_pass_half_width: float) -> Mask:
    """Return the frames of a moving run in which a local effect acts, (n,)."""
    own = run.values.get(effect.name)
    if own is None or effect.acts_within is None:
        return np.zeros(len(slide.t), dtype=bool)
    acts = effect.acts_within(slide.t, slide.x, own, low_pass_half_width)
    return np.asarray(acts & (np.abs(slide.v) > MIN_SPEED))


def _frames_within(t: Array, stretches: list[list[float]]) -> Mask:
    out: Mask = np.zeros(len(t), dtype=bool)
    for first, last in stretches:
        out |= (t >= first - 1e-9) & (t <= last + 1e-9)
    return out
