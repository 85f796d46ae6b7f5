"""Compare the spans where a model is said to fail with the frames where a local hidden effect acts."""

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
    """F1 score over all frames of where the hidden effect acts and where the model is said to fail.

    Parameters
    ----------
    truth
        Truth of the study.
    spans
        `fails_at` of the diagnosis: run and first and last time t (s) of each span.
    low_pass_half_width
        Half width of the low-pass of each run, s: it widens a collision by that much.

    Returns
    -------
    float or None
        0 to 1; None unless exactly one local effect, such as a patch or a collision, is hidden.

    """
    if len(truth.hidden) != 1 or effect_named(truth.hidden[0]).acts_within is None:
        return None
    effect = effect_named(truth.hidden[0])
    n_both = n_reported = n_true = 0
    for run in truth.runs:
        trajectory = truth.trajectory(run)
        acts = acting(effect, run, trajectory, low_pass_half_width.get(run.name, 0.0))
        reported = _frames_within(trajectory.t, [span["t"] for span in spans if span["run"] == run.name])
        n_both, n_reported, n_true = (
            n_both + int((acts & reported).sum()),
            n_reported + int(reported.sum()),
            n_true + int(acts.sum()),
        )
    return 2 * n_both / max(n_reported + n_true, 1)


def acting(effect: Effect, run: RunTruth, trajectory: Trajectory, low_pass_half_width: float) -> Mask:
    """Frames (n,) of a run in which a local effect acts while the mass moves."""
    values = run.values.get(effect.name)
    if values is None or effect.acts_within is None:
        return np.zeros(len(trajectory.t), dtype=bool)
    acts = effect.acts_within(trajectory.t, trajectory.x, values, low_pass_half_width)
    return np.asarray(acts & (np.abs(trajectory.v) > MIN_SPEED))


def _frames_within(t: Array, spans: list[list[float]]) -> Mask:
    """Frames at times t (n,) within any of the spans."""
    out: Mask = np.zeros(len(t), dtype=bool)
    for first, last in spans:
        out |= (t >= first - 1e-9) & (t <= last + 1e-9)
    return out
