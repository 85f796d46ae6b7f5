"""Summarise a plan: the runs in order, what each one separates, what stays inseparable and how to settle it."""

from __future__ import annotations

from typing import Any

import numpy as np

from frictrack.diagnose.experiments import settled_by
from frictrack.effects import PLANNED_SHARE, Effect
from frictrack.plan.causes import MEASUREMENT_NOISE_RATIO
from frictrack.plan.selection import MIN_CHI2_SEPARATED, PlanStep, RunPlan, detection_threshold, unseparated_pairs
from frictrack.records import Array

MAX_CHI2_IDENTICAL = 1.0  # below which two traces count as identical
MIN_VISIBLE_SHARE = 1e-6  # of a trace's square that must remain beside the law; less is rounding
REFERENCE_INSTRUCTION = "a mark at rest in every picture, given as `reference`"
PLANNED_SIZES = (
    f"sizes: every force {100 * PLANNED_SHARE:g} % of friction (rms), a blow {100 * PLANNED_SHARE:g} % of the "
    f"momentum, a measurement fault {MEASUREMENT_NOISE_RATIO:g} times the noise per frame (rms), 1 lost frame; "
    "effects without a size (presliding, lag): the middle of the scanned range"
)


def summarise_plan(plan: RunPlan) -> dict[str, Any]:
    """Return the JSON of `frictrack plan`, without paths.

    Parameters
    ----------
    plan
        The runs chosen.

    Returns
    -------
    dict
        Assumptions, chosen runs, pairs left, undetected effects, detection limits and the table of evidence.

    """
    setup = plan.setup
    unseen = _unseen(plan)
    return {
        "assumed": [*setup.assumed, PLANNED_SIZES],
        "law": {f"{e}.{p}": v for e, own in setup.values.items() for p, v in own.items()},
        "noise_um": 1e6 * setup.noise,
        "done": [experiment.words for experiment in setup.completed],
        "pairs": len(plan.tables.names) * (len(plan.tables.names) - 1) // 2,
        "pairs_before": plan.n_pairs_before,
        "runs": [_run(plan, step) for step in plan.steps],
        "left": [_left(plan, a, b) for a, b in unseparated_pairs(plan.evidence) if not {a, b} & unseen.keys()],
        "unseen": [unseen[k] for k in sorted(unseen)],
        "detection_limits": {name: _limit(plan, k) for k, name in enumerate(plan.tables.names)},
        "not_planned": plan.excluded,
        "evidence": {"effects": plan.tables.names, "table": _table(plan)},
    }


def _table(plan: RunPlan) -> list[list[float | None]]:
    """Expected chi-squared between any two effects, whichever is true; None on the diagonal."""
    e = plan.evidence[:, :-1]
    square = np.minimum(e, e.T)
    return [[None if a == b else float(square[a, b]) for b in range(len(e))] for a in range(len(e))]


def _run(plan: RunPlan, step: PlanStep) -> dict[str, Any]:
    """Entry of one chosen run."""
    experiment = step.experiment
    what = REFERENCE_INSTRUCTION if experiment is None else experiment.words
    design = None if experiment is None else experiment.design
    return {
        "what": what,
        "speed": None if design is None else design.start[1],
        "mass": None if design is None else plan.setup.mass * design.mass,
        "incline_deg": None if design is None else float(np.rad2deg(design.tilt)),
        "fps": None if design is None else plan.setup.fps * design.rate,
        "cost": step.cost,
        "separates": [list(pair) for pair in step.separated],
        "adds": len(step.separated),
        "shows": step.detected,
        "pairs_left": step.n_pairs_left,
    }


def _unseen(plan: RunPlan) -> dict[int, dict[str, Any]]:
    """Effects that these runs would not detect at their planned size."""
    out, needed = {}, detection_threshold()
    for k, (name, e) in enumerate(zip(plan.tables.names, plan.evidence[:, -1], strict=True)):
        if e < needed:
            effect = plan.tables.causes[k].effect
            why = f"at its planned size it raises chi-squared by {e:.2g}; detection needs {needed:.2g}"
            out[k] = {"effect": name, "why": why, "settle": _direct_check(effect)}
    return out


def _left(plan: RunPlan, a: int, b: int) -> dict[str, Any]:
    """Entry of one pair that stays inseparable."""
    names, causes = plan.tables.names, plan.tables.causes
    e = min(plan.evidence[a, b], plan.evidence[b, a])
    if e < MAX_CHI2_IDENTICAL:
        why = "both change every candidate run in the same way"
    else:
        why = f"expected chi-squared difference of their best fits: {e:.2g}; separation needs {MIN_CHI2_SEPARATED:g}"
    rivals = [causes[k].effect for k in (a, b)]
    means = settled_by(rivals) or "; ".join(filter(None, map(_direct_check, rivals)))
    return {"effects": [names[a], names[b]], "expected_chi2": float(e), "why": why, "settle": means}


def _direct_check(effect: Effect) -> str:
    """Instruction for a direct measurement that shows an effect."""
    check = effect.direct_check
    words = check.instruction if check else effect.confirm.split(":")[0].rstrip(".")
    return words[:1].lower() + words[1:]


def _limit(plan: RunPlan, k: int) -> dict[str, Any]:
    """Detection limit of an effect, in its own unit and relative to its planned size."""
    cause, size, e = plan.tables.causes[k], float(plan.tables.sizes[k]), float(plan.evidence[k, -1])
    amplitude = next((p for p in cause.effect.parameters if p.linear or p.role == "depth"), None)
    whole: Array = np.sum([r for r in plan.tables.raw_chi2], axis=0)
    at = {p.name: cause.setting[p.name] for p in cause.effect.nonlinear if p.scan is not None and not cause.is_event}
    where = {"at": at, "at_words": ", ".join(f"{n} {v:.2g} {cause.effect.parameter(n).unit}" for n, v in at.items())}
    if amplitude is None or e <= MIN_VISIBLE_SHARE * whole[k]:
        reason = "it has no size parameter" if amplitude is None else "the model absorbs it whatever its size"
        return {"value": None, "unit": "", **where, "share": None, "power": 0.95, "reason": reason}
    factor = float(np.sqrt(detection_threshold() / e))
    return {"value": factor * size, "unit": amplitude.unit, **where, "share": factor, "power": 0.95, "reason": None}
