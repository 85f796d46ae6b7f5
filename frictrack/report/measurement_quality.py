"""What the measurement says of itself, in words: films, time bases, smoothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from frictrack.number_format import format_number, format_range
from frictrack.results import Results, RunResults

MIN_LOCKING_SIGMAS, MIN_BACKWARD_SIGMAS, MIN_BLUR_PX = (
    0.2,
    0.5,
    1.0,
)  # of sigma, of sigma, px: below that nothing is said


def measurement(runs: Sequence[RunResults]) -> list[Markup]:
    """How well the films were measured, and the worst that they say of it, in sentences."""
    known = [run for run in runs if run.quality]
    if not known:
        return []
    sentences = [
        Markup("<b>{}</b>: {}.").format(run.name, "; ".join(found)) for run in known if (found := _self_checks(run))
    ]
    calm = Markup("No film speaks against its own measurement.")
    return [_precision([run.quality for run in known]), *(sentences or [calm])]


def _precision(found: Sequence[Mapping[str, Any]]) -> Markup:
    """Noise of the target and of something fixed, over all films."""
    px, um, floor = ([q[k] for q in found if q[k] is not None] for k in ("sigma_px", "sigma_um", "noise_floor_px"))
    sentence = (
        Markup("One frame tells the position to {} px").format(format_range(px))
        if px
        else Markup("No position is known")
    )
    sentence += Markup(" ({} µm)").format(format_range(um)) if um else Markup("")
    sentence += (
        Markup("; something fixed in the same pictures is seen to rest within {} px").format(format_range(floor))
        if (floor)
        else Markup("; no picture shows something fixed to compare with")
    )
    return sentence + Markup(".")


def _self_checks(run: RunResults) -> list[str]:
    """What one film has against its own measurement."""
    q = run.quality
    lost, locking, sigma = q["frames"] - q["found"], q["peak_locking_px"], q["sigma_px"]
    judged = (
        (lost, f"the target is lost in {lost} of {q['frames']} frames"),
        (q["shake_px"], f"the camera shook by {_px(q['shake_px'])} at {format_number(q['shake_Hz'])} Hz, subtracted"),
        (
            locking and sigma and locking > 3 * q["peak_locking_std_px"] and locking > MIN_LOCKING_SIGMAS * sigma,
            f"positions are drawn toward a place between the pixels by {_px(locking)}",
        ),
        (
            q["forward_backward_sigmas"] and q["forward_backward_sigmas"] > MIN_BACKWARD_SIGMAS,
            f"tracked backward, positions differ by {_px(q['forward_backward_px'])}",
        ),
        (q["blur_px"] and q["blur_px"] > MIN_BLUR_PX, f"it moves {_px(q['blur_px'])} while a frame is exposed"),
    )
    timing = [f"{r['what']}: {r['value']}, {r['verdict']}" for r in q["timebase"] if not _is_good(r["verdict"])]
    sentence = [note for note in run.displacement.notes if "told by the motion" in note]
    return [sentences for wrong, sentences in judged if wrong] + timing + sentence


def _is_good(verdict: str) -> bool:
    return verdict in ("used", "agrees", "none", "speed of showing") or "of the frame interval" in verdict


def _px(value: float | None) -> str:
    return f"{format_number(value, 2)} px"


def smoothing(results: Results) -> list[Markup]:
    """How each displacement was smoothed, what lies above a plain cut-off, and the noise that rests show."""
    sentences = [Markup("{}: {}.").format(run.name, run.filtered.reason) for run in results.runs]
    for run in results.runs:
        warnings = run.cutoff.warnings if run.cutoff else ()
        if warnings:
            sentences.append(Markup("{}: {}; {}.").format(run.name, "; ".join(warnings), _consequence(run)))
        if run.happenings.noise_at_rest > 0:
            rest, moving = 1e6 * run.happenings.noise_at_rest, 1e6 * _noise(run)
            sentence = "{}: at rest the displacement scatters by {} µm, over the whole record by {} µm."
            sentences.append(Markup(sentence).format(run.name, format_number(rest, 2), format_number(moving, 2)))
    return sentences


def _consequence(run: RunResults) -> str:
    if run.filtered.asked:
        return "leave the cut-off out and it is followed"
    return "it is followed apart, only the force domain has to do without it"


def _noise(run: RunResults) -> float:
    sigma = run.filtered.sigma_x
    return float(np.median(sigma[np.isfinite(sigma)]))
