"""Search for the effects that a fitted model lacks.

Each round tests the model, adds the best effect and tests again. The search ends when no misfit is left, or when no
effect reduces it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from frictrack.compare import failing_spans
from frictrack.diagnose.admissible import objection
from frictrack.diagnose.auxiliary_signals import (
    AuxiliarySignals,
    Evidence,
    KnownFindings,
    evidence_curves,
)
from frictrack.diagnose.detection_limits import detection_limit
from frictrack.diagnose.experiments import plan_for_candidates, plan_for_unexplained
from frictrack.diagnose.hypothesis_tests import ALPHA
from frictrack.diagnose.model_selection import MAX_CHI2_NEAR
from frictrack.diagnose.parsimony import explained_shares, nested_models, simplest_candidate, stronger_of_smooth_pair
from frictrack.diagnose.power import Undetermined, find_undetermined
from frictrack.diagnose.repeatability import find_failure_pattern
from frictrack.diagnose.residual_kinds import ResidualKind, residual_kind
from frictrack.diagnose.rounds import RefinedCandidate, Round, find_rivals, refine_fully, run_round
from frictrack.diagnose.simpler_model import find_simpler_model
from frictrack.diagnose.subsampling import subsample_frames
from frictrack.diagnose.unexplained import unexplained_force
from frictrack.diagnose.unsegmented import join_segments
from frictrack.diagnose.verdict import Candidate, Diagnosis, Importance
from frictrack.effects import Effect
from frictrack.errors import FrictrackError
from frictrack.fit import Fit, GroupFits
from frictrack.fit.least_squares import Solution
from frictrack.fit.stepwise import refine_to_end
from frictrack.records import Array
from frictrack.threads import one_thread

MAX_EFFECTS = 4  # that are added
MAX_ROUNDS = 6  # of testing and adding
MIN_SHARE_LISTED, MAX_OTHERS_LISTED = (
    0.01,
    6,
)  # share of the misfit, and number, of further effects in the table of importance
MAX_ERROR_RATIO_ADDED = 0.99  # of held-out errors, for an effect to be worth adding
MAX_ERROR_RATIO_DECISIVE = 0.9  # of held-out errors, for an effect named beside an undetermined model
N_CANDIDATES_HELD_OUT = 3  # with held-out error and rivals

Progress = Callable[[int, int, str], None]


@one_thread()
def diagnose(
    fit: Fit,
    *,
    own: Sequence[Effect] = (),
    auxiliary: AuxiliarySignals | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Diagnosis:
    """Search the effect library for what a fitted model lacks.

    The search is a forward selection. It adds the best effect while one passes the test, and drops effects that a
    later one makes unnecessary. Validation runs are not used.

    Parameters
    ----------
    fit
        One fit of all runs.
    own
        Further effects to try: the user's own, or library effects with bounds, priors or fixed values.
    auxiliary
        Other measurements, by run and name, one value per frame (n,): displacements of further targets in m, and
        "accelerometer" in m/s^2. Those that move with the residual are reported as evidence.
    seed
        Seed of the random draws.
    progress
        Called with the number of rounds done, their total, and the current step.

    Returns
    -------
    Diagnosis
        The verdict, the candidates with their evidence, the detection limits and the next experiment. p-values account
        for the whole search (999 draws).

    Raises
    ------
    FrictrackError
        If `fit` holds one fit per group.

    """
    notify = progress or (lambda done, total, what: None)
    if isinstance(fit, GroupFits):
        raise FrictrackError("expected one fit of all runs to diagnose but got one per group; fit without --per first")
    joined = join_segments(fit)
    if joined is not None:
        joined, remark = subsample_frames(joined)
        found = _search(fit, joined, (own, auxiliary), (np.random.default_rng(seed), notify))
        diagnosis = None if found.last.leaves_misfit else _conclude_search(fit, found, auxiliary, notify)
        if diagnosis is not None and diagnosis.verdict != "unexplained":
            notify(MAX_ROUNDS, MAX_ROUNDS, "diagnosed")
            return replace(diagnosis, remarks=[*diagnosis.remarks, *filter(None, [remark])])
    # the tests work on the displacement, whatever domain or search the fit used
    start = fit.solution if fit.route.is_default else refine_to_end(fit.solution)
    start, remarks = residual_kind(start.problem).prepare(start)
    found = _search(fit, start, (own, auxiliary), (np.random.default_rng(seed), notify))
    diagnosis = _conclude_search(fit, found, auxiliary, notify)
    notify(MAX_ROUNDS, MAX_ROUNDS, "diagnosed")
    return replace(diagnosis, remarks=[*diagnosis.remarks, *filter(None, remarks)])


@dataclass(frozen=True)
class _Search:
    """Result of a search: start, first and last round, effects found, and random generators for the later steps."""

    start: Solution
    first: Round
    last: Round
    found: list[RefinedCandidate]
    generators: list[np.random.Generator]


def _search(
    fit: Fit,
    start: Solution,
    signals: tuple[Sequence[Effect], AuxiliarySignals | None],
    means: tuple[np.random.Generator, Progress],
) -> _Search:
    """Run the rounds of a search from one model; `signals` is (own, auxiliary), `means` is (rng, progress)."""
    (own, auxiliary), (rng, notify) = signals, means
    generators = rng.spawn(2)
    kind = residual_kind(start.problem)
    sensor = kind.accelerometer(start, fit.runs, auxiliary)
    first = last = run_round(start, own, rng, lambda what: notify(0, MAX_ROUNDS, what))
    found: list[RefinedCandidate] = []
    for done in range(1, MAX_ROUNDS + 1):

        def notify_round(what: str, done: int = done) -> None:
            notify(done, MAX_ROUNDS, what)

        if last.passing and len(found) < MAX_EFFECTS:
            best = refine_fully(_choose_candidate(last, sensor))
            found.append(
                replace(best, indistinguishable_from=find_rivals(best, _consistent_with_sensor(last.tried, sensor)))
            )
        else:
            before = [t.effect.name for t in found]
            found = kind.review(first, found, own, notify_round)
            if [t.effect.name for t in found] == before:
                break
        notify_round(f"{', '.join(t.effect.name for t in found)} added, testing again")
        law = found[-1].law if found else start
        last = run_round(kind.before_round(law), own, rng, notify_round)
    found = [replace(t, objection=objection(found[-1].law, t.effect)) for t in found]
    return _Search(start, first, last, found, generators)


def _conclude_search(fit: Fit, search: _Search, auxiliary: AuxiliarySignals | None, notify: Progress) -> Diagnosis:
    """Return the diagnosis of a finished search: verdict, evidence, failure pattern and next experiment."""

    def progress(what: str) -> None:
        notify(MAX_ROUNDS, MAX_ROUNDS, what)

    progress("comparing the effects found")
    start, first, last, found, generators = search.start, search.first, search.last, search.found, search.generators
    concluded = _conclude(fit, first, last, found)
    if concluded.verdict in ("complete", "undetermined"):
        return concluded
    progress("finding where the model fails")
    findings = (
        KnownFindings(concluded.candidates[0].delta_bic, last.solution, concluded.missing) if found else KnownFindings()
    )
    kind = residual_kind(start.problem)
    evidence = kind.auxiliary_evidence(start, fit.runs, generators[0], auxiliary, findings)
    pattern = find_failure_pattern(start, generators[1])
    figures = concluded.figures | pattern.figures | evidence_curves(evidence)
    concluded = replace(concluded, evidence=evidence, repeats=pattern.repeats, figures=figures)
    if found and kind.imitates and not last.leaves_misfit:
        concluded = _compare_with_formulas(concluded, start, last.solution)
    progress("planning the next experiment")
    return replace(concluded, next_experiment=_plan_next(concluded, first, last, found, progress))


def _compare_with_formulas(concluded: Diagnosis, start: Solution, law: Solution) -> Diagnosis:
    """Return the diagnosis after comparing the effects found with a force of one variable that they may imitate."""
    simpler = find_simpler_model(start, law, concluded.repeats)
    if simpler is None or (concluded.verdict == "unexplained" and not simpler["decisive"]):
        return concluded
    if not simpler["decisive"]:
        return replace(concluded, unexplained=simpler)
    repeats = (
        concluded.repeats if concluded.repeats.best else replace(concluded.repeats, words="")
    )  # the formula says it
    return replace(concluded, verdict="unexplained", missing=[], unexplained=simpler, repeats=repeats)


def _consistent_with_sensor(tried: Sequence[RefinedCandidate], sensor: Evidence | None) -> list[RefinedCandidate]:
    """Keep the candidates that agree with the accelerometer, which separates a moving mass from a moving picture."""
    return [t for t in tried if sensor is None or t.effect.acts_on == sensor.acts_on]


def _choose_candidate(tested: Round, sensor: Evidence | None) -> RefinedCandidate:
    """Return the simplest of the best passing candidates.

    Candidates that agree with the accelerometer come first if they explain nearly as much. While much misfit remains,
    one of two simple effects comes before a flexible effect that imitates their sum.
    """
    passing = tested.passing
    near = [t for t in _consistent_with_sensor(passing, sensor) if passing[0].delta_bic - t.delta_bic < MAX_CHI2_NEAR]
    best = simplest_candidate(near or passing)
    return stronger_of_smooth_pair(tested, best) or best


def _conclude(fit: Fit, first: Round, last: Round, found: list[RefinedCandidate]) -> Diagnosis:
    """Return the verdict with the evidence of every candidate, detection limits and importance."""
    heldout = _HeldOutErrors(first.solution)
    listed = _tabulate_candidates(first, found, heldout)
    complete = not first.leaves_misfit and not first.passing
    if complete:
        verdict = "complete"
    elif last.leaves_misfit or not found or not listed[0].helps or any(t.objection for t in found):
        verdict = "unexplained"
    else:
        verdict = "ambiguous" if any(t.indistinguishable_from for t in found) else "missing"
    limits, curves = _limits(first)
    kind = residual_kind(fit.solution.problem)
    noise, misfit = kind.noise(fit)
    undetermined = find_undetermined(fit, first, curves)
    unclear = misfit < 1 or (verdict in ("missing", "ambiguous") and not _is_decisive(listed[0], undetermined))
    if undetermined and (complete or unclear):
        verdict, found = "undetermined", []
    return Diagnosis(
        model=fit.model.names,
        verdict=verdict,
        missing=[t.effect.name for t in found if not t.objection],
        noise_um=1e6 * noise if kind.unit == "um" else None,
        noise_N=noise if kind.unit == "N" else None,
        reduced_chi2=misfit,
        p_lack_of_fit=first.tests.p_lack_of_fit,
        fails_at=[] if complete else _fails_at(fit, found),
        candidates=listed,
        unexplained=unexplained_force(first.solution, last.solution) if verdict == "unexplained" else None,
        detection_limits=limits,
        undetermined=undetermined if verdict in ("complete", "undetermined") else [],
        importance=_importance(first, found, listed, heldout),
        remarks=_remarks(fit, first.excluded),
        figures=curves,
    )


def _is_decisive(best: Candidate, undetermined: Sequence[Undetermined]) -> bool:
    """Whether the best effect lowers the held-out error enough to be named beside an undetermined model."""
    if (
        all(gap.uncertainty is None for gap in undetermined)
        or best.heldout_after is None
        or best.heldout_before is None
    ):
        return True
    return best.heldout_after < MAX_ERROR_RATIO_DECISIVE * best.heldout_before


def _importance(
    first: Round, found: Sequence[RefinedCandidate], listed: Sequence[Candidate], heldout: _HeldOutErrors
) -> list[Importance]:
    """Return the share of the misfit that each added effect, and each plausible other one that passed, explains."""
    alone = explained_shares(first, first.tried)
    unit = residual_kind(first.solution.problem).unit
    excess = max(first.solution.chi2 - first.solution.problem.n_frames, 1e-300)
    out: list[Importance] = []
    chi2, error = first.solution.chi2, None
    for t, law in zip(found, nested_models(found), strict=True):
        share = heldout_error = None
        if law is not None:
            before, heldout_error, _ = heldout(law)
            share, chi2 = float(np.clip((chi2 - law.chi2) / excess, -1.0, 1.0)), law.chi2
            improves = heldout_error < MAX_ERROR_RATIO_ADDED * (before if error is None else error)
            out, error = (_without_stop(out) if improves else out), heldout_error
        out.append(
            Importance(
                t.effect.name,
                alone.get(t.effect.name),
                share,
                heldout_error,
                unit,
                stop=heldout_error is not None and improves,
            )
        )
    names = {t.effect.name for t in found}
    others = [c.effect for c in listed if c.p < ALPHA / 2 and c.effect not in names and not c.implausible]
    shown = [name for name in others if alone.get(name, 0.0) > MIN_SHARE_LISTED][:MAX_OTHERS_LISTED]
    return out + [Importance(name, alone[name], None, None, unit) for name in shown]


def _without_stop(rows: Sequence[Importance]) -> list[Importance]:
    """Return the same rows with `stop` cleared: the last effect worth adding is marked once."""
    return [replace(row, stop=False) for row in rows]


def _tabulate_candidates(first: Round, found: list[RefinedCandidate], heldout: _HeldOutErrors) -> list[Candidate]:
    """Return all candidates with their evidence: those found first, then the others of the first round, best first."""
    chosen = {t.effect.name: t for t in found}
    rivals = {
        t.effect.name: find_rivals(t, first.tried)
        for t in first.passing[:N_CANDIDATES_HELD_OUT]
        if t.effect.name not in chosen
    }
    simulated = {t.effect.name: t for t in first.tried if t.solution is not None}
    out = []
    for k, t in enumerate([*found, *(t for t in first.tried if t.effect.name not in chosen)]):
        name = t.effect.name
        shown = simulated.get(name, t)
        refined = chosen.get(name, t)
        indistinguishable = refined.indistinguishable_from or rivals.get(name, ())
        shown = replace(shown, indistinguishable_from=indistinguishable, objection=refined.objection)
        held = heldout if t.p < ALPHA / 2 and k < N_CANDIDATES_HELD_OUT else None
        out.append(_candidate(shown, held, residual_kind(first.solution.problem)))
    return out


def _plan_next(
    concluded: Diagnosis, first: Round, last: Round, found: list[RefinedCandidate], notify: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Propose experiments where misfit is unexplained or candidates are indistinguishable."""
    if concluded.verdict == "unexplained":
        return plan_for_unexplained(last.solution if concluded.missing or not found else first.solution, notify)
    best = [t.effect.name for t in found[:1]]
    order = sorted(first.passing, key=lambda t: t.effect.name not in best)
    passing = [(t.effect.name, t.law, t.delta_bic) for t in order]
    return plan_for_candidates(first.solution, passing, found[0].indistinguishable_from if best else (), notify)


def _fails_at(fit: Fit, found: list[RefinedCandidate]) -> list[dict[str, Any]]:
    """Return the spans where the missing force acts or, if none is known, where the residual is significant."""
    if found and found[0].effect.acts_on == "force":
        return failing_spans(found[0].law, fit.runs, found[0].effect.name)
    return failing_spans(fit.solution, fit.runs)


class _HeldOutErrors:
    """Held-out errors of models and of the bare model; the latter is computed once per hold-out method."""

    def __init__(self, bare: Solution) -> None:
        self._bare = bare
        self._bare_errors: dict[str, float] = {}
        self._heldout_rms = residual_kind(bare.problem).heldout_rms

    def __call__(self, solution: Solution) -> tuple[float, float, str]:
        """Return the held-out errors of the bare model and of this one, and the hold-out method."""
        after, how = self._heldout_rms(solution)
        if how not in self._bare_errors:
            self._bare_errors[how] = self._heldout_rms(self._bare, how)[0]
        return self._bare_errors[how], after, how


def _candidate(tried: RefinedCandidate, heldout: _HeldOutErrors | None, kind: ResidualKind) -> Candidate:
    """Convert a refined candidate to its entry in the diagnosis."""
    effect, solution = tried.effect, tried.solution
    before = after = how = None
    parameters: dict[str, Any] = {}
    if solution is not None:
        if heldout is not None:
            before, after, how = heldout(solution)
        parameters = {
            name.split(".", 1)[1]: {"value": e.value, "std": e.std, "unit": e.unit}
            for name, e in kind.estimates(solution).parameters.items()
            if name.rsplit(".", 1)[0] == effect.name
        }
    return Candidate(
        effect=effect.name,
        acts_on=effect.acts_on,
        parameters=parameters,
        p=tried.p,
        delta_bic=float(tried.delta_bic),
        heldout_before=before,
        heldout_after=after,
        heldout=how,
        indistinguishable_from=tried.indistinguishable_from,
        implausible=tried.objection,
        words=kind.describe(effect, solution),
        unit=kind.unit,
    )


def _limits(first: Round) -> tuple[dict[str, dict[str, Any]], dict[str, dict[str, Array]]]:
    """Return the detection limit of every scanned effect, and its curve over all settings."""
    limits, curves = {}, {}
    for s in first.tests.scanned:
        limits[s.effect.name], curve = detection_limit(s, first.draws, first.tests.critical)
        if len(s.scans) == 1:
            curve["rise"] = s.scans[0].gains
        curves[s.effect.name] = curve
    return limits, curves


def _describe_excluded(excluded: dict[str, str]) -> list[str]:
    """Say in one sentence which effects could not be tried, grouped by reason."""
    by_reason: dict[str, list[str]] = {}
    for name, why in excluded.items():
        by_reason.setdefault(why.removeprefix(f"{name} "), []).append(name)
    reasons = [f"{' and '.join(names)} {_plural(why, len(names))}" for why, names in by_reason.items()]
    return [f"not tried: {'; '.join(reasons)}"] if reasons else []


def _plural(why: str, count: int) -> str:
    """Put the reason of one effect into the plural: "needs" becomes "need"."""
    verb, _, rest = why.partition(" ")
    return why if count == 1 else f"{verb.removesuffix('s')} {rest}"


def _remarks(fit: Fit, excluded: dict[str, str]) -> list[str]:
    """Return the remarks of a diagnosis: effects not tried, and what these runs cannot separate."""
    return _describe_excluded(excluded) + residual_kind(fit.solution.problem).remarks(fit)
