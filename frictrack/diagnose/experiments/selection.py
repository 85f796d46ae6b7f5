"""Choose runs greedily: each is the one after which the fewest pairs of effects are inseparable, for its cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from frictrack.base.distributions import chi2_isf
from frictrack.base.number_format import format_plain
from frictrack.base.workers import one_thread
from frictrack.diagnose.examination import ALPHA
from frictrack.diagnose.experiments.candidates import ExperimentSetup
from frictrack.diagnose.experiments.evidence import MEASUREMENT_NOISE_RATIO, EvidenceTables, Progress, tabulate_evidence
from frictrack.diagnose.experiments.virtual_runs import RunDesign, VirtualRun
from frictrack.diagnose.model_selection import MIN_CHI2_SEPARATED
from frictrack.diagnose.power import noncentrality
from frictrack.effects import PLANNED_SHARE, Effect
from frictrack.records import Array

MAX_RUNS = 8  # of a plan
MIN_PROGRESS_PAIRS = 0.5  # progress in pairs for which a run is worth filming though it separates none
N_INDEPENDENT_FORMS = 1000  # independent tests in a search of the library, approximately
DEGREES_OF_FREEDOM = 2  # coefficients per test
MAX_CHI2_IDENTICAL = 1.0  # below which two traces count as identical
MIN_VISIBLE_SHARE = 1e-6  # of a trace's square that the law must leave; less is rounding
REFERENCE = -1  # index of the mark at rest among the runs
REFERENCE_INSTRUCTION = "a mark at rest in every picture, given as `reference`"
PLANNED_SIZES = (
    f"sizes: every force {100 * PLANNED_SHARE:g} % of friction (rms), a blow {100 * PLANNED_SHARE:g} % of the "
    f"momentum, a measurement fault {MEASUREMENT_NOISE_RATIO:g} times the noise per frame (rms), 1 lost frame; "
    "effects without a size (presliding, lag): the middle of the scanned range"
)


@cache
def detection_threshold(forms: int = N_INDEPENDENT_FORMS) -> float:
    """Expected rise of chi-squared that is detected in 95 of 100 repeats, in a search of so many independent forms."""
    return noncentrality(float(chi2_isf(ALPHA / 2 / forms, DEGREES_OF_FREEDOM)), DEGREES_OF_FREEDOM)


def separation(evidence: Array) -> Array:
    """Evidence (D, D) between any two effects, whichever is true, from that of each over each (D, D + 1)."""
    return np.minimum(evidence[:, :-1], evidence[:, :-1].T)


def unseparated_pairs(evidence: Array) -> list[tuple[int, int]]:
    """Pairs of effects that are not separated, in order."""
    return [(int(a), int(b)) for a, b in np.argwhere(separation(evidence) < MIN_CHI2_SEPARATED) if a < b]


def undetected(evidence: Array) -> list[int]:
    """Effects that are not detected."""
    return np.flatnonzero(evidence[:, -1] < detection_threshold()).tolist()


def _score(evidence: Array) -> Array:
    """Number of pairs inseparable and effects undetected, and how far these are from their thresholds."""
    far = np.triu(np.maximum(1 - separation(evidence) / MIN_CHI2_SEPARATED, 0.0), 1).sum()
    far += np.maximum(1 - evidence[:, -1] / detection_threshold(), 0.0).sum()
    return np.array([len(unseparated_pairs(evidence)) + len(undetected(evidence)), far])


@dataclass(frozen=True)
class PlanStep:
    """One chosen run (None: the mark at rest), and what is separated and detected once it is filmed."""

    design: RunDesign | None
    evidence: Array
    separated: list[tuple[str, str]]
    detected: list[str]  # effects detected from this run on
    cost: float = 1.0


@dataclass(frozen=True)
class RunPlan:
    """The chosen runs in order, with the tables that they were chosen from."""

    setup: ExperimentSetup
    tables: EvidenceTables
    steps: list[PlanStep]
    excluded: dict[str, str]
    evidence_before: Array  # before the first of them, (D, D + 1)

    @property
    def evidence(self) -> Array:
        """Expected chi-squared with all of them, (D, D + 1)."""
        return self.steps[-1].evidence if self.steps else self.evidence_before

    @property
    def runs(self) -> list[VirtualRun]:
        """The completed and the chosen runs."""
        keys = {e.key for e in self.setup.completed} | {s.design.key for s in self.steps if s.design}
        return [r for r in self.tables.runs if r.design.key in keys]


@one_thread()
def choose_runs(setup: ExperimentSetup, notify: Progress = lambda done, total, what: None) -> RunPlan:
    """Choose runs until no pair is inseparable, nothing helps, or there are `MAX_RUNS` runs.

    Parameters
    ----------
    setup
        The experimental setup.
    notify
        Called with steps done, their total and the current step.

    Returns
    -------
    RunPlan

    Raises
    ------
    FrictrackError
        If every candidate run is too short.

    """
    tables, excluded = tabulate_evidence(setup, notify)
    done = {e.key for e in setup.completed}
    chosen = [i for i, r in enumerate(tables.runs) if r.design.key in done]
    rest = [*(i for i in range(len(tables.runs)) if i not in chosen), REFERENCE]
    evidence = before = tables.evidence(chosen, reference=False)
    steps: list[PlanStep] = []
    while len(steps) < MAX_RUNS and _score(evidence)[0]:
        notify(len(steps), MAX_RUNS, "choosing runs")
        options = {}
        for i in rest:
            cost = _cost(setup, tables, chosen, i)
            if np.isfinite(cost) and (chosen or i != REFERENCE):
                runs = [k for k in (*chosen, i) if k != REFERENCE]
                options[i] = tables.evidence(runs, reference=REFERENCE in (*chosen, i)), cost
        if not options:
            break
        # most pairs separated and effects detected for the cost, then most progress toward that
        best = max(options, key=lambda i: tuple((_score(evidence) - _score(options[i][0])) / options[i][1]))
        found, cost = options[best]
        progress = _score(evidence) - _score(found)
        if progress[0] <= 0 and progress[1] < MIN_PROGRESS_PAIRS:
            break
        separated = sorted(set(unseparated_pairs(evidence)).difference(unseparated_pairs(found)))
        detected = sorted(set(undetected(evidence)).difference(undetected(found)))
        design, names = None if best == REFERENCE else tables.runs[best].design, tables.names
        pairs = [(names[a], names[b]) for a, b in separated]
        steps.append(PlanStep(design, found, pairs, [names[k] for k in detected], cost))
        evidence = found
        chosen.append(best)
        rest.remove(best)
    while steps and not steps[-1].separated and not steps[-1].detected:  # it only came near
        steps.pop()
    notify(MAX_RUNS, MAX_RUNS, "planned")
    return RunPlan(setup, tables, steps, excluded, before)


def _cost(setup: ExperimentSetup, tables: EvidenceTables, chosen: list[int], option: int) -> float:
    """Cost of a run after the last one chosen, or of a mark at rest."""
    if option == REFERENCE:
        return setup.costs.check
    new, *before = (setup.conditions.settings(tables.runs[i].design) for i in (option, *reversed(chosen)) if i >= 0)
    return setup.costs.of_run(new, before[0] if before else None)


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
    setup, names = plan.setup, plan.tables.names
    unseen = undetected(plan.evidence)
    left = [pair for pair in unseparated_pairs(plan.evidence) if not set(pair) & set(unseen)]
    square, everyone = separation(plan.evidence), range(len(names))
    return {
        "assumed": [*setup.assumed, PLANNED_SIZES],
        "law": {f"{e}.{p}": v for e, own in setup.values.items() for p, v in own.items()},
        "noise_um": 1e6 * setup.noise,
        "done": [design.words for design in setup.completed],
        "pairs": len(names) * (len(names) - 1) // 2,
        "pairs_before": len(unseparated_pairs(plan.evidence_before)),
        "runs": [_summarise_step(setup, step) for step in plan.steps],
        "left": [_summarise_pair(plan.tables, a, b, float(square[a, b])) for a, b in left],
        "unseen": [_summarise_unseen(plan.tables, k, plan.evidence[k, -1]) for k in unseen],
        "detection_limits": {name: _limit(plan, k) for k, name in enumerate(names)},
        "not_planned": plan.excluded,
        "evidence": {
            "effects": names,
            "table": [[None if a == b else float(square[a, b]) for b in everyone] for a in everyone],
        },
    }


def _summarise_step(setup: ExperimentSetup, step: PlanStep) -> dict[str, Any]:
    """Entry of one chosen run."""
    settings = None if step.design is None else setup.conditions.settings(step.design).summary()
    return {
        "what": REFERENCE_INSTRUCTION if step.design is None else step.design.words,
        **{key: None if settings is None else settings[key] for key in ("speed", "mass", "incline_deg", "fps")},
        "cost": step.cost,
        "separates": [list(pair) for pair in step.separated],
        "adds": len(step.separated),
        "shows": step.detected,
        "pairs_left": len(unseparated_pairs(step.evidence)),
    }


def _summarise_unseen(tables: EvidenceTables, k: int, chi2: float) -> dict[str, Any]:
    """Entry of an effect that these runs would not detect at its planned size."""
    why = f"at its planned size it raises chi-squared by {chi2:.2g}; detection needs {detection_threshold():.2g}"
    return {"effect": tables.names[k], "why": why, "settle": _direct_check(tables.causes[k].effect)}


def _summarise_pair(tables: EvidenceTables, a: int, b: int, chi2: float) -> dict[str, Any]:
    """Entry of one pair that stays inseparable."""
    if chi2 < MAX_CHI2_IDENTICAL:
        why = "both change every candidate run in the same way"
    else:
        why = f"expected chi-squared difference of their best fits: {chi2:.2g}; separation needs {MIN_CHI2_SEPARATED:g}"
    rivals = [tables.causes[k].effect for k in (a, b)]
    means = settled_by(rivals) or "; ".join(filter(None, map(_direct_check, rivals)))
    return {"effects": [e.name for e in rivals], "expected_chi2": chi2, "why": why, "settle": means}


def settled_by(effects: Sequence[Effect]) -> str:
    """Return what to do instead of a film to separate some effects; "" where none of them says it.

    Examples
    --------
    >>> from frictrack import effects
    >>> settled_by([effects.get("slope"), effects.get("spring")])
    'lay a level on the course, and take the cable off'

    """
    return ", and ".join(effect.settled_by for effect in effects if effect.settled_by)


def _direct_check(effect: Effect) -> str:
    """Instruction for a direct measurement that shows an effect."""
    check = effect.direct_check
    words = check.instruction if check else effect.confirm.split(":")[0].rstrip(".")
    return words[:1].lower() + words[1:]


def _point_in_words(effect: Effect, at: Mapping[str, float]) -> str:
    """Return values of parameters with their units; a number without a unit says in which formula it stands.

    Examples
    --------
    >>> from frictrack import effects
    >>> _point_in_words(effects.get("power_law_viscosity"), {"n": 0.93})
    'n = 0.93 in c s |v|^n'

    """
    units = {name: effect.parameter(name).unit for name in at}
    words = [f"{n} = {format_plain(v, 2)}{'' if units[n] == '1' else f' {units[n]}'}" for n, v in at.items()]
    return ", ".join(words) + (f" in {effect.equation}" if "1" in units.values() else "")


def _limit(plan: RunPlan, k: int) -> dict[str, Any]:
    """Detection limit of an effect, in its own unit and relative to its planned size."""
    cause, size, e = plan.tables.causes[k], float(plan.tables.sizes[k]), float(plan.evidence[k, -1])
    effect = cause.effect
    amplitude = next((p for p in effect.parameters if p.linear or p.role == "depth"), None)
    at = {p.name: cause.setting[p.name] for p in effect.nonlinear if p.scan is not None and not cause.times}
    reason = None
    if amplitude is None:
        reason = "it has no size parameter"
    elif e <= MIN_VISIBLE_SHARE * plan.tables.raw_chi2[:, k].sum():
        reason = "the model absorbs it whatever its size"
    share = None if reason else float(np.sqrt(detection_threshold() / e))
    return {
        "value": None if share is None else share * size,
        "unit": "" if reason or amplitude is None else amplitude.unit,
        "at": at,
        "at_words": _point_in_words(effect, at),
        "share": share,
        "power": 0.95,
        "reason": reason,
    }
