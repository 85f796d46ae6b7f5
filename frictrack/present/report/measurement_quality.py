"""Describe the quality of the measurement in sentences: films, time bases, smoothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from frictrack.base.number_format import format_number, format_range
from frictrack.results import Results, RunResults

MIN_LOCKING_SIGMAS = 0.2  # peak locking over the noise of a frame; less is not reported
MIN_BACKWARD_SIGMAS = 0.5  # difference of backward tracking over the noise of a frame; less is not reported
MIN_BLUR_PX = 1.0  # less is not reported
GOOD_VERDICTS = ("used", "agrees", "none", "speed of showing")


def measurement(runs: Sequence[RunResults]) -> list[Markup]:
    """Describe the noise of the films and the failed self-checks of their measurement.

    Parameters
    ----------
    runs : sequence of RunResults
        All runs of the study.

    Returns
    -------
    list of Markup
        Sentences; none if no run has a film.

    """
    filmed = [run for run in runs if run.quality]
    if not filmed:
        return []
    failed = [
        Markup("<b>{}</b>: {}.").format(run.name, "; ".join(found)) for run in filmed if (found := failed_checks(run))
    ]
    passed = Markup("All measurement self-checks passed.")
    return [_precision([run.quality for run in filmed]), *(failed or [passed])]


def _precision(found: Sequence[Mapping[str, Any]]) -> Markup:
    """Describe the noise of the target and of a fixed reference, over all films."""
    px, um, floor = ([q[k] for q in found if q[k] is not None] for k in ("sigma_px", "sigma_um", "noise_floor_px"))
    sentence = (
        Markup("Position standard deviation per frame: {} px").format(format_range(px))
        if px
        else Markup("The position standard deviation is not known")
    )
    sentence += Markup(" ({} µm)").format(format_range(um)) if um else Markup("")
    sentence += (
        Markup("; standard deviation of a fixed reference: {} px").format(format_range(floor))
        if floor
        else Markup("; no fixed reference was found in the pictures")
    )
    return sentence + Markup(".")


def failed_checks(run: RunResults) -> list[str]:
    """Describe the self-checks that one film fails."""
    q = run.quality
    lost, locking, sigma = q["frames"] - q["found"], q["peak_locking_px"], q["sigma_px"]
    checks = (
        (lost, f"the target was lost in {lost} of {q['frames']} frames"),
        (q["shake_px"], f"camera shake of {_px(q['shake_px'])} at {format_number(q['shake_Hz'])} Hz was subtracted"),
        (
            locking and sigma and locking > 3 * q["peak_locking_std_px"] and locking > MIN_LOCKING_SIGMAS * sigma,
            f"peak locking shifts positions by {_px(locking)}",
        ),
        (
            q["forward_backward_sigmas"] and q["forward_backward_sigmas"] > MIN_BACKWARD_SIGMAS,
            f"positions tracked backward differ by {_px(q['forward_backward_px'])}",
        ),
        (
            q["blur_px"] and q["blur_px"] > MIN_BLUR_PX,
            f"the target moves {_px(q['blur_px'])} during the exposure of a frame",
        ),
    )
    timing = [f"{r['what']}: {r['value']}, {r['verdict']}" for r in q["timebase"] if not is_good(r["verdict"])]
    scale = [note for note in run.displacement.notes if "by the motion" in note or "from the motion" in note]
    return [text for failed, text in checks if failed] + timing + scale


def is_good(verdict: str) -> bool:
    """Return whether the verdict of a check of the time base is nothing to worry about."""
    return verdict in GOOD_VERDICTS or "of the frame interval" in verdict


def _px(value: float | None) -> str:
    return f"{format_number(value, 2)} px"


def smoothing(results: Results) -> list[Markup]:
    """Describe how each displacement was smoothed, signals above the cut-off, and the noise at rest.

    Parameters
    ----------
    results : Results
        The study.

    Returns
    -------
    list of Markup
        Sentences.

    """
    sentences = [Markup("{}: {}.").format(run.name, run.filtered.reason) for run in results.runs]
    for run in results.runs:
        warnings = run.cutoff.warnings if run.cutoff else ()
        if warnings:
            sentences.append(Markup("{}: {}; {}.").format(run.name, "; ".join(warnings), _consequence(run)))
        if run.events.noise_at_rest > 0:
            rest, moving = 1e6 * run.events.noise_at_rest, 1e6 * _noise(run)
            sentence = "{}: noise of the displacement {} µm at rest, {} µm over the whole record."
            sentences.append(Markup(sentence).format(run.name, format_number(rest, 2), format_number(moving, 2)))
    return sentences


def _consequence(run: RunResults) -> str:
    if run.filtered.asked:
        return "remove the cut-off from the study file to keep this signal"
    return "the displacement domain keeps this signal, the force domain does not"


def _noise(run: RunResults) -> float:
    sigma = run.filtered.sigma_x
    return float(np.median(sigma[np.isfinite(sigma)]))
