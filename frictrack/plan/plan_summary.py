"""A plan in words and numbers: the runs in order, what each adds, what stays open and what settles it."""

from __future__ import annotations

from typing import Any

import numpy as np

from frictrack.diagnose.experiments.advice_text import OTHER_MEASUREMENTS
from frictrack.diagnose.experiments.direct_checks import CHECK_BY_EFFECT
from frictrack.effects import Effect
from frictrack.plan.causes import FRAMES, PICTURE, SHARE
from frictrack.plan.selection import PARTED, Chosen, Step, pairs, threshold
from frictrack.records import Array

ALIKE = 1.0  # expected chi-squared below which two traces are one
ABSORBED = 1e-6  # of what a cause leaves in the picture: less is rounding
REFERENCE = "a mark at rest in every picture, given as `reference`"
SIZES = (
    f"every force at {100 * SHARE:g} % of friction (rms), a blow at {100 * SHARE:g} % of the momentum, a fault of the "
    f"picture at {PICTURE:g} times the noise of a frame (rms), {FRAMES:g} lost frame; what has no size (presliding, "
    "lag) in the middle of what is looked for"
)


def summary(chosen: Chosen) -> dict[str, Any]:
    """JSON of `frictrack plan`, without the files."""
    stand = chosen.stand
    unseen = _unseen(chosen)
    return {
        "assumed": [*stand.assumed, SIZES],
        "law": {f"{e}.{p}": v for e, own in stand.values.items() for p, v in own.items()},
        "noise_um": 1e6 * stand.noise,
        "done": [entry.words for entry in stand.done],
        "pairs": len(chosen.tables.names) * (len(chosen.tables.names) - 1) // 2,
        "pairs_before": chosen.before,
        "runs": [_run(chosen, step) for step in chosen.steps],
        "left": [_left(chosen, a, b) for a, b in pairs(chosen.evidence) if not {a, b} & unseen.keys()],
        "unseen": [unseen[k] for k in sorted(unseen)],
        "detection_limits": {name: _limit(chosen, k) for k, name in enumerate(chosen.tables.names)},
        "not_planned": chosen.left_out,
        "evidence": {"effects": chosen.tables.names, "table": _table(chosen)},
    }


def _table(chosen: Chosen) -> list[list[float | None]]:
    """Expected chi-squared between any two causes, whichever is true; None on the diagonal."""
    e = chosen.evidence[:, :-1]
    square = np.minimum(e, e.T)
    return [[None if a == b else float(square[a, b]) for b in range(len(e))] for a in range(len(e))]


def _run(chosen: Chosen, step: Step) -> dict[str, Any]:
    entry = step.entry
    what = REFERENCE if entry is None else entry.words
    film = None if entry is None else entry.film
    return {
        "what": what,
        "speed": None if film is None else film.start[1],
        "mass": None if film is None else chosen.stand.mass * film.mass,
        "incline_deg": None if film is None else float(np.rad2deg(film.tilt)),
        "fps": None if film is None else chosen.stand.fps * film.rate,
        "separates": [list(pair) for pair in step.parted],
        "adds": len(step.parted),
        "shows": step.shown,
        "pairs_left": step.left,
    }


def _unseen(chosen: Chosen) -> dict[int, dict[str, Any]]:
    """Causes that these runs would not show at their stated size."""
    out, enough = {}, threshold()
    for k, (name, e) in enumerate(zip(chosen.tables.names, chosen.evidence[:, -1], strict=True)):
        if e < enough:
            effect = chosen.tables.causes[k].effect
            why = f"at its stated size it changes chi-squared by {e:.2g} beside the law; {enough:.2g} would show it"
            out[k] = {"effect": name, "why": why, "settle": _settles(effect)}
    return out


def _left(chosen: Chosen, a: int, b: int) -> dict[str, Any]:
    names, causes = chosen.tables.names, chosen.tables.causes
    e = min(chosen.evidence[a, b], chosen.evidence[b, a])
    if e < ALIKE:
        why = "every run of the menu is moved in the same way by both"
    else:
        why = f"their best fits differ by an expected chi-squared of {e:.2g}; {PARTED:g} part them"
    kinds = frozenset({names[a], names[b]})
    means = OTHER_MEASUREMENTS.get(kinds) or "; ".join(filter(None, (_settles(causes[k].effect) for k in (a, b))))
    return {"effects": [names[a], names[b]], "expected_chi2": float(e), "why": why, "settle": means}


def _settles(effect: Effect) -> str:
    """What beside a film shows a cause."""
    check = CHECK_BY_EFFECT.get(effect.kind)
    words = check.words if check else effect.confirm.split(":")[0].rstrip(".")
    return words[:1].lower() + words[1:]


def _limit(chosen: Chosen, k: int) -> dict[str, Any]:
    """Smallest size of a cause that these runs show, in its own unit and as a share of what it was planned at."""
    cause, size, e = chosen.tables.causes[k], float(chosen.tables.sizes[k]), float(chosen.evidence[k, -1])
    amplitude = next((p for p in cause.effect.parameters if p.linear or p.role == "depth"), None)
    shown: Array = np.sum([r for r in chosen.tables.shown], axis=0)
    at = {p.name: cause.setting[p.name] for p in cause.effect.nonlinear if p.scan is not None and not cause.event}
    where = {"at": at, "at_words": ", ".join(f"{n} {v:.2g} {cause.effect.parameter(n).unit}" for n, v in at.items())}
    if amplitude is None or e <= ABSORBED * shown[k]:
        reason = "it has no size of its own" if amplitude is None else "the law absorbs it whatever its size"
        return {"value": None, "unit": "", **where, "share": None, "power": 0.95, "reason": reason}
    factor = float(np.sqrt(threshold() / e))
    return {"value": factor * size, "unit": amplitude.unit, **where, "share": factor, "power": 0.95, "reason": None}
