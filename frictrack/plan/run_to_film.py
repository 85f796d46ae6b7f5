"""Choose the one run to film now, by the information that it is expected to give for its cost.

A diagnosis leaves questions open. Which of several explanations is true: each is taken to be true with the probability
that its BIC gives it, and the others are fitted to all runs including the planned one. Or whether an effect of a tenth
of the friction would be seen. Every question has its evidence now and after each candidate run; a run is worth the
progress toward decisive evidence, weighted by probability, over its cost.

References
----------
Box & Hill (1967), Discrimination among mechanistic models, Technometrics 9, 57-71 (weights by probability).

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Any

import numpy as np

from frictrack import effects, models
from frictrack.costs import DEFAULT_COSTS, Costs, RunSettings
from frictrack.diagnose import MAX_BIC_EQUAL, MIN_CHI2_SEPARATED
from frictrack.diagnose.experiments import (
    EvidenceForecast,
    ModelDiscrimination,
    RunDesign,
    combined_experiments,
    last_settings,
    settings_of,
)
from frictrack.distributions import chi2_isf
from frictrack.effects import PLANNED_SHARE
from frictrack.errors import FrictrackError
from frictrack.fit import Fit
from frictrack.fit.parameters import MIN_RUNS_FOR_SCATTER
from frictrack.fit.stepwise import add_effect, refine_to_end
from frictrack.plan.causes import list_causes
from frictrack.plan.experiment_setup import candidate_runs
from frictrack.plan.explanations import Weighted, list_explanations
from frictrack.plan.normal_matrices import NormalMatrices, reduce_without_rival, sum_runs
from frictrack.plan.selection import detection_threshold, span_of_runs
from frictrack.plan.setup_from_fit import fitted_setup
from frictrack.plan.traces import PlannedRun, effect_trace, planned_size, simulate_runs
from frictrack.records import Array
from frictrack.threads import one_thread

DECISIVE_DELTA_BIC = MIN_CHI2_SEPARATED  # at which a diagnosis no longer lists a rival
SOUGHT_SHARE = 0.10  # of the mean friction: size of an effect that the runs should show
MIN_WEIGHT_RATIO = 0.1  # to the likeliest explanation, from which on a prediction is stated if it is true
MAX_P_SUSPECTED = 0.05  # p-value above which an effect is no suspicion, whatever its delta BIC
MIN_GAIN = 0.05  # share of decisive evidence, over all questions, below which a run is not worth filming


@dataclass(frozen=True)
class Question:
    """One question: whether `true` differs from `rival` (None: from nothing), with its weight and threshold.

    Evidence adds up: `now` is what the runs say already (without a rival: what they are expected to say).
    """

    true: str
    rival: str | None
    weight: float
    decisive: float
    now: float
    discrimination: ModelDiscrimination | None = None

    def progress(self, after: float) -> float:
        """Weighted progress toward decisive evidence."""
        return self.weight * (self._share(after) - self._share(self.now))

    def gain(self, after: float) -> float:
        """Weighted share of decisive evidence that is added, also where little was left to add."""
        return self.weight * float(np.clip((after - self.now) / self.decisive, 0.0, 1.0))

    def _share(self, evidence: float) -> float:
        return float(np.clip(evidence / self.decisive, 0.0, 1.0))

    @property
    def measured(self) -> float:
        """Evidence of the present runs; 0 without a rival, where `now` is only expected."""
        return self.now if self.rival else 0.0

    def forecast(self, option: Option, after: float) -> EvidenceForecast:
        """Forecast the evidence that a run adds to the measured one; the rival is fitted to it by simulation."""
        if self.discrimination is None or option.design is None:
            return EvidenceForecast(after - self.measured)
        return _added_evidence(self.discrimination, option.design, refit=True)

    def prediction(self, added: EvidenceForecast) -> dict[str, Any]:
        """Entry of the JSON `predictions`."""
        low, high = added.interval()
        return {
            "true": self.true,
            "rival": self.rival,
            "now": self.now,
            "expected": added.expected + self.measured,
            "interval": [low + self.measured, None if high is None else high + self.measured],
            "decisive": self.decisive,
        }


@dataclass(frozen=True)
class Option:
    """One candidate run: its words, settings and cost, and the evidence on each question after it."""

    key: str
    words: str
    settings: RunSettings
    cost: float
    after: tuple[float, ...]
    design: RunDesign | None = None

    def value(self, questions: Sequence[Question]) -> tuple[float, float]:
        """Progress over cost; then the plain gain of evidence over cost, where no run makes progress."""
        pairs = list(zip(questions, self.after, strict=True))
        progress = sum(q.progress(e) for q, e in pairs)
        return progress / self.cost, sum(q.weight * (e - q.now) for q, e in pairs) / self.cost


@one_thread()
def next_run(fit: Fit, diagnosis: Mapping[str, Any], costs: Costs = DEFAULT_COSTS) -> dict[str, Any] | None:
    """Choose the run to film now.

    Parameters
    ----------
    fit
        The fit that was diagnosed.
    diagnosis
        Its diagnosis: JSON of `frictrack diagnose`, or `Diagnosis.summary()`.
    costs
        Costs of the next run, and what the set-up can do.

    Returns
    -------
    dict or None
        "what", "key", "settings" (speed m/s with sign, mass kg, incline_deg, fps), "cost", "separates",
        "expected_delta_bic", "expected_interval" (95 %) and "predictions", one for every
        question that the run is expected to answer if a likely explanation is true. None if nothing is
        open, or if no run that the set-up can do helps.

    Examples
    --------
    >>> import frictrack as ft
    >>> runs = ft.samples.runs()[:1]
    >>> fit = ft.fit(["coulomb", "viscous"], runs)
    >>> next_run(fit, ft.diagnose(fit, quick=True).summary()) is None  # one effect is named, without a rival
    True

    """
    questions, options = _open_questions(fit, diagnosis, costs)
    options = [o for o in options if max(o.value(questions)) > 0]
    if not options:
        return None
    best = max(options, key=lambda o: o.value(questions))
    open_now = [(q, e) for q, e in zip(questions, best.after, strict=True) if q.now < q.decisive]
    if sum(q.gain(e) for q, e in open_now) < MIN_GAIN * sum(q.weight for q in questions):
        return None
    likeliest = max(q.weight for q, _ in open_now)
    likely = [(q, e) for q, e in open_now if q.weight >= MIN_WEIGHT_RATIO * likeliest]
    predicted = [(q, q.prediction(q.forecast(best, e))) for q, e in likely]
    separated = [(q, p) for q, p in predicted if p["expected"] >= MIN_CHI2_SEPARATED] or predicted
    weightiest = max(q.weight for q, _ in separated)
    weakest = min((p for q, p in separated if q.weight == weightiest), key=lambda p: p["expected"])
    return {
        "what": best.words,
        "key": best.key,
        "settings": best.settings.summary(),
        "cost": best.cost,
        "separates": list(dict.fromkeys(name for q, _ in separated for name in (q.true, q.rival) if name)),
        "expected_delta_bic": weakest["expected"],
        "expected_interval": weakest["interval"],
        "predictions": [p for _, p in separated],
    }


def _open_questions(fit: Fit, diagnosis: Mapping[str, Any], costs: Costs) -> tuple[list[Question], list[Option]]:
    """Questions that a diagnosis leaves open, and the runs that may answer them."""
    if fit.measured or any(p.turns or p.cut for p in fit.solution.problem.pieces):
        return [], []
    verdict = diagnosis["verdict"]
    if verdict in {"undetermined", "complete"}:
        suspected = _suspected_effects(diagnosis)
        if suspected:
            return _power_questions(fit, list(suspected), costs, suspected)
        questions, options = _power_questions(fit, _unseen_effects(diagnosis), costs)
        return (questions, options) if verdict == "undetermined" else _answerable(questions, options)
    found = list_explanations(fit.solution, diagnosis)
    return _rival_questions(found, costs, further=verdict == "unexplained") if len(found) > 1 else ([], [])


def _answerable(questions: list[Question], options: list[Option]) -> tuple[list[Question], list[Option]]:
    """Questions that at least one of the runs answers."""
    best = [max((o.after[k] for o in options), default=0.0) for k in range(len(questions))]
    kept = [k for k, q in enumerate(questions) if best[k] >= q.decisive]
    return [questions[k] for k in kept], [replace(o, after=tuple(o.after[k] for k in kept)) for o in options]


# --- which explanation is true


def _rival_questions(found: Sequence[Weighted], costs: Costs, *, further: bool) -> tuple[list[Question], list[Option]]:
    """One question for every ordered pair of explanations, weighted by the probability of the first.

    With `further`, evidence that is decisive already must be found once more: the runs are not explained yet.
    """
    pairs = [
        (ModelDiscrimination(a.explanation, b.explanation), a.probability / (len(found) - 1))
        for a, b in permutations(found, 2)
        if a.explanation.fitted_effect.kind not in b.explanation.fitted_effect.special_cases  # which predict the same
    ]
    questions = []
    for d, weight in pairs:
        now = d.truth.gain - d.rival.gain
        decisive = DECISIVE_DELTA_BIC + (now if further and now >= DECISIVE_DELTA_BIC else 0.0)
        questions.append(Question(d.truth.effect, d.rival.effect, weight, decisive, now, d))
    solution = found[0].explanation.solution
    last, options = last_settings(solution), []
    for entry in combined_experiments(solution, costs):
        settings = settings_of(solution, entry.design)
        cost = costs.of_run(settings, last)
        if np.isfinite(cost):
            added = [_added_evidence(d, entry.design).expected for d, _ in pairs]
            after = tuple(q.now + one for q, one in zip(questions, added, strict=True))
            options.append(Option(entry.key, entry.words, settings, cost, after, entry.design))
    return questions, options


def _added_evidence(discrimination: ModelDiscrimination, design: RunDesign, *, refit: bool = False) -> EvidenceForecast:
    """Evidence that a run is expected to add; 0 if a motion cannot be integrated."""
    try:
        after = discrimination.forecast_after(design, refit=refit)
        return after.shifted(-discrimination.expected_delta_bic_now)
    except FrictrackError:
        return EvidenceForecast(0.0)


# --- what the runs could show


def _unseen_effects(diagnosis: Mapping[str, Any]) -> list[str]:
    """Effects that the runs leave open: those of an undetermined verdict; else forces absorbed whatever their size."""
    if diagnosis["verdict"] == "undetermined":
        parts = [part for one in diagnosis["undetermined"] for part in one["what"].split(" and ")]
        return list(dict.fromkeys(part.split(".")[0] for part in parts))
    limits = diagnosis["detection_limits"]
    named = [n for n, limit in limits.items() if limit["value"] is None and n in effects.LIBRARY]
    return [n for n in named if effects.get(n).acts_on == "force" and effects.get(n).sized]


def _suspected_effects(diagnosis: Mapping[str, Any]) -> dict[str, float]:
    """Effects with much evidence that is nearly significant, the best first, and their evidence as chi-squared."""
    likely = [
        c
        for c in diagnosis["candidates"]
        if (c["delta_bic"] or 0.0) > MAX_BIC_EQUAL and c["p"] < MAX_P_SUSPECTED and not c["implausible"]
    ]
    ordered = sorted(likely, key=lambda c: -c["delta_bic"])
    return {c["effect"]: float(chi2_isf(c["p"], 1)) for c in ordered if c["effect"] in effects.LIBRARY}


def _power_questions(
    fit: Fit, names: Sequence[str], costs: Costs, suspected: Mapping[str, float] | None = None
) -> tuple[list[Question], list[Option]]:
    """One question for every effect that the runs cannot show at `SOUGHT_SHARE` of the friction.

    Of `suspected` effects, the evidence is measured; it grows with further runs as that of such an effect would, if the
    friction levels scatter as they do beside the first of them.
    """
    if not names:
        return [], []
    try:
        setup = fitted_setup(fit, costs)
        if suspected:
            beside = refine_to_end(add_effect(fit.solution, effects.get(next(iter(suspected)))))
            setup = replace(setup, scatter=beside.tau_of_other_runs)
        runs = simulate_runs(setup, [*setup.completed, *candidate_runs(setup)])
    except FrictrackError:  # a drive, or a law without Coulomb friction
        return [], []
    count = sum(r.experiment in setup.completed for r in runs)
    tables = {n: t for n in names if (t := _evidence_of_effect(runs, n, setup.scatter)) is not None}
    times = max(1, MIN_RUNS_FOR_SCATTER - count)  # with fewer runs, friction levels are free

    def evidence(name: str, *further: NormalMatrices) -> float:
        together = sum_runs([*tables[name][:count], *further])
        return float(together.unexplained_chi2(scatter_known=not suspected)[0])

    expected = {n: evidence(n) for n in tables}
    # if the runs say less than is expected of such an effect, it is smaller, and further runs say less, too
    scale = {n: suspected[n] / max(one, suspected[n]) if suspected else 1.0 for n, one in expected.items()}
    decisive = detection_threshold(forms=1) if suspected else detection_threshold()
    questions = [Question(n, None, 1.0 / len(scale), decisive, scale[n] * one) for n, one in expected.items()]
    last, options = last_settings(fit.solution), []
    for i, run in enumerate(runs[count:], count):
        settings = setup.settings(run.experiment.design)
        cost = costs.of_run(settings, last)
        if np.isfinite(cost):
            after = tuple(scale[n] * evidence(n, *[t[i]] * times) for n, t in tables.items())
            options.append(Option(run.experiment.key, f"Film {run.experiment.words}", settings, cost, after))
    return questions, options


def _evidence_of_effect(runs: Sequence[PlannedRun], name: str, scatter: float) -> list[NormalMatrices] | None:
    """Products of one effect of `SOUGHT_SHARE` of the friction and the rest of the law, in every run."""
    law = models.of([e for e in runs[0].problem.model.effects if e.name != name])
    setup_span = span_of_runs(list(runs))
    cause = next((c for c in list_causes(law, setup_span)[0] if c.effect.name == name), None)
    if cause is None:
        return None
    size = planned_size(list(runs), cause) * SOUGHT_SHARE / PLANNED_SHARE
    out = []
    for number, run in enumerate(runs):
        trace = effect_trace(run, cause, size, number)[:, None]
        out.append(reduce_without_rival(replace(run, law_columns=_other_columns(run, name)), trace, scatter))
    return out


def _other_columns(run: PlannedRun, name: str) -> Array:
    """Sensitivities of the law without those of one effect."""
    layout = run.problem.layout
    shared = [i for i in run.response.active if i not in layout.levels]
    return run.law_columns[:, [k for k, i in enumerate(shared) if layout.slots[i].effect != name]]
