"""The search for what is missing: test, add the best, test again, until nothing is left or nothing helps."""

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
    assess_accelerometer,
    assess_auxiliary_signals,
    evidence_curves,
)
from frictrack.diagnose.detection_limits import detection_limit
from frictrack.diagnose.effect_description import describe_effect
from frictrack.diagnose.experiments import plan_for_candidates, plan_for_unexplained
from frictrack.diagnose.hypothesis_tests import ALPHA
from frictrack.diagnose.model_selection import MAX_CHI2_NEAR
from frictrack.diagnose.parsimony import explained_shares, nested_models, simplest_candidate, stronger_of_smooth_pair
from frictrack.diagnose.power import Undetermined, find_undetermined
from frictrack.diagnose.repeatability import find_failure_pattern
from frictrack.diagnose.rounds import RefinedCandidate, Round, find_rivals, refine_fully, review_found, run_round
from frictrack.diagnose.simpler_model import find_simpler_model
from frictrack.diagnose.subsampling import subsample_frames, subsample_pieces
from frictrack.diagnose.unexplained import unexplained_force
from frictrack.diagnose.unsegmented import join_segments
from frictrack.diagnose.verdict import Candidate, Diagnosis, Importance
from frictrack.effects import Effect
from frictrack.errors import FrictrackError
from frictrack.fit import Fit, measured_friction
from frictrack.fit.groups import GroupFits
from frictrack.fit.least_squares import Solution, heldout_rms
from frictrack.fit.stepwise import refine_to_end
from frictrack.fit.uncertainty import Estimates, estimates, linear_estimates
from frictrack.records import Array
from frictrack.threads import one_thread

MAX_EFFECTS = 4  # effects looked for one after the other
MAX_ROUNDS = 6  # of adding and looking again
MIN_SHARE_LISTED, MAX_OTHERS_LISTED = (
    0.01,
    6,
)  # share of the misfit, and number, of further effects in the table of importance
MAX_ERROR_RATIO_ADDED = 0.99  # times the held-out error before, that an effect must reach for the list to go on past it
MAX_ERROR_RATIO_DECISIVE = (
    0.9  # times the held-out error before: what an effect must reach beside a law that is not determined
)
N_CANDIDATES_HELD_OUT = 3  # candidates whose held-out error and rivals are computed

Progress = Callable[[int, int, str], None]


@one_thread()
def diagnose(
    fit: Fit,
    *,
    own: Sequence[Effect] = (),
    beside: AuxiliarySignals | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Diagnosis:
    """Search the library, and effects of your `own`, for what the fitted model lacks.

    `own` may also hold effects of the library with bounds, priors or fixed values. p-values hold for the whole search
    (999 draws, `seed`). Effects are added one after the other while the best passes; what an added effect makes
    needless is not added. Validation runs are not looked at. `beside` holds what else was seen of the runs: by run and
    name, further targets (m) and the "accelerometer" (m/s^2) at the frames; what goes with the residual is evidence.
    """
    tell = progress or (lambda done, total, what: None)
    if isinstance(fit, GroupFits):
        raise FrictrackError("expected one fit of all runs to diagnose but got one per group; fit without --per first")
    whole = join_segments(fit)
    if whole is not None:
        whole, coarse = subsample_frames(whole)
        found = _search(fit, whole, (own, beside), (np.random.default_rng(seed), tell))
        said = None if found.last.leaves_misfit else _finish(fit, found, beside, tell)
        if said is not None and said.verdict != "unexplained":
            tell(MAX_ROUNDS, MAX_ROUNDS, "diagnosed")
            return replace(said, remarks=[*said.remarks, *filter(None, [coarse])])
    # the tests work on the displacement, whatever domain or search the fit used
    start = fit.solution if fit.route.plain else refine_to_end(fit.solution)
    start, left_out = (measured_friction.weight_by_noise(start)[0], "") if fit.measured else subsample_pieces(start)
    start, coarse = (start, "") if fit.measured else subsample_frames(start)
    found = _search(fit, start, (own, beside), (np.random.default_rng(seed), tell))
    said = _finish(fit, found, beside, tell)
    tell(MAX_ROUNDS, MAX_ROUNDS, "diagnosed")
    return replace(said, remarks=[*said.remarks, *filter(None, [left_out, coarse])])


@dataclass(frozen=True)
class _Search:
    """A search from one law to its end: the first and the last test, what was found, and further random numbers."""

    start: Solution
    first: Round
    last: Round
    found: list[RefinedCandidate]
    again: list[np.random.Generator]


def _search(
    fit: Fit,
    start: Solution,
    known: tuple[Sequence[Effect], AuxiliarySignals | None],
    how: tuple[np.random.Generator, Progress],
) -> _Search:
    """Search from one law; `known` holds own effects and what else was seen, `how` what draws and who is informed."""
    (own, beside), (rng, tell) = known, how
    again = rng.spawn(2)
    felt = None if fit.measured else assess_accelerometer(start, fit.runs, beside or {})
    first = last = run_round(start, own, rng, lambda what: tell(0, MAX_ROUNDS, what))
    found: list[RefinedCandidate] = []
    for done in range(1, MAX_ROUNDS + 1):

        def told(what: str, done: int = done) -> None:
            tell(done, MAX_ROUNDS, what)

        if last.passing and len(found) < MAX_EFFECTS:
            best = refine_fully(_preferred(last, felt))
            found.append(replace(best, indistinguishable_from=find_rivals(best, _possible(last.tried, felt))))
        elif fit.measured:
            break
        else:
            before = [t.effect.name for t in found]
            found = review_found(start, found, own, told)
            if [t.effect.name for t in found] == before:
                break
        told(f"{', '.join(t.effect.name for t in found)} added, testing again")
        law = found[-1].law if found else start
        last = run_round(measured_friction.weight_by_noise(law)[0] if fit.measured else law, own, rng, told)
    found = [replace(t, objection=objection(found[-1].law, t.effect)) for t in found]
    return _Search(start, first, last, found, again)


def _finish(fit: Fit, search: _Search, beside: AuxiliarySignals | None, tell: Progress) -> Diagnosis:
    """The verdict of a search, and where it fails."""

    def progress(what: str) -> None:
        tell(MAX_ROUNDS, MAX_ROUNDS, what)

    progress("weighing what was found")
    start, first, last, found, again = search.start, search.first, search.last, search.found, search.again
    concluded = _conclude(fit, first, last, found)
    if concluded.verdict in ("complete", "undetermined"):
        return concluded
    progress("looking at where the law fails")
    known = (
        KnownFindings(concluded.candidates[0].delta_bic, last.solution, concluded.missing) if found else KnownFindings()
    )
    seen = [] if fit.measured else assess_auxiliary_signals(start, fit.runs, again[0], beside, known)
    where = find_failure_pattern(start, again[1])
    figures = concluded.figures | where.figures | evidence_curves(seen)
    concluded = replace(concluded, evidence=seen, repeats=where.repeats, figures=figures)
    if found and not fit.measured and not last.leaves_misfit:
        concluded = _compare_with_formulas(concluded, start, last.solution)
    progress("planning the next experiment")
    return replace(concluded, next_experiment=_next(concluded, first, last, found, progress))


def _compare_with_formulas(concluded: Diagnosis, start: Solution, law: Solution) -> Diagnosis:
    """The verdict after a look at forces of one variable, where effects were found that may only imitate one."""
    plain = find_simpler_model(start, law, concluded.repeats)
    if plain is None or (concluded.verdict == "unexplained" and not plain["decisive"]):
        return concluded
    if not plain["decisive"]:
        return replace(concluded, unexplained=plain)
    along = concluded.repeats if concluded.repeats.best else replace(concluded.repeats, words="")  # the formula says it
    return replace(concluded, verdict="unexplained", missing=[], unexplained=plain, repeats=along)


def _possible(tried: Sequence[RefinedCandidate], felt: Evidence | None) -> list[RefinedCandidate]:
    """What an accelerometer leaves possible: it tells a mass that moves from a picture that does."""
    return [t for t in tried if felt is None or t.effect.acts_on == felt.acts_on]


def _preferred(last: Round, felt: Evidence | None) -> RefinedCandidate:
    """The simplest of the best of what passes; what an accelerometer feels goes first where it explains nearly as well.

    While much is missing, one of two plain effects goes before a flexible one that imitates their sum.
    """
    passing = last.passing
    near = [t for t in _possible(passing, felt) if passing[0].delta_bic - t.delta_bic < MAX_CHI2_NEAR]
    best = simplest_candidate(near or passing)
    return stronger_of_smooth_pair(last, best) or best


def _conclude(fit: Fit, first: Round, last: Round, found: list[RefinedCandidate]) -> Diagnosis:
    hold = _HeldOutErrors(first.solution)
    listed = _listed(first, found, hold)
    clean = not first.leaves_misfit and not first.passing
    if clean:
        verdict = "complete"
    elif last.leaves_misfit or not found or not listed[0].helps or any(t.objection for t in found):
        verdict = "unexplained"
    else:
        verdict = "ambiguous" if any(t.indistinguishable_from for t in found) else "missing"
    limits, curves = _limits(first)
    noise, misfit = _noise(fit)
    gaps = find_undetermined(fit, first, curves)
    vague = misfit < 1 or (verdict in ("missing", "ambiguous") and not _is_decisive(listed[0], gaps))
    if gaps and (clean or vague):
        verdict, found = "undetermined", []
    return Diagnosis(
        model=fit.model.names,
        verdict=verdict,
        missing=[t.effect.name for t in found if not t.objection],
        noise_um=None if fit.measured else 1e6 * noise,
        noise_N=noise if fit.measured else None,
        reduced_chi2=misfit,
        p_lack_of_fit=first.tests.p_lack_of_fit,
        fails_at=[] if clean else _fails_at(fit, found),
        candidates=listed,
        unexplained=unexplained_force(first.solution, last.solution) if verdict == "unexplained" else None,
        detection_limits=limits,
        undetermined=gaps if verdict in ("complete", "undetermined") else [],
        importance=_importance(first, found, listed, hold),
        remarks=_remarks(fit, first.barred),
        figures=curves,
    )


def _is_decisive(best: Candidate, gaps: Sequence[Undetermined]) -> bool:
    """Whether an effect is worth naming although the law itself is not determined: the held-out error falls clearly."""
    if all(gap.uncertainty is None for gap in gaps) or best.heldout_after is None or best.heldout_before is None:
        return True
    return best.heldout_after < MAX_ERROR_RATIO_DECISIVE * best.heldout_before


def _importance(
    first: Round, found: Sequence[RefinedCandidate], listed: Sequence[Candidate], hold: _HeldOutErrors
) -> list[Importance]:
    """What every effect that was added, and the plausible others that passed, explain of the misfit."""
    alone = explained_shares(first, first.tried)
    unit = "um" if first.solution.problem.simulates else "N"
    excess = max(first.solution.chi2 - first.solution.problem.n_frames, 1e-300)
    out: list[Importance] = []
    chi2, error = first.solution.chi2, None
    for t, law in zip(found, nested_models(found), strict=True):
        share = held = None
        if law is not None:
            before, held, _ = hold(law)
            share, chi2 = float(np.clip((chi2 - law.chi2) / excess, -1.0, 1.0)), law.chi2
            worth = held < MAX_ERROR_RATIO_ADDED * (before if error is None else error)
            out, error = (_stopped(out) if worth else out), held
        out.append(
            Importance(t.effect.name, alone.get(t.effect.name), share, held, unit, stop=held is not None and worth)
        )
    names = {t.effect.name for t in found}
    others = [c.effect for c in listed if c.p < ALPHA / 2 and c.effect not in names and not c.implausible]
    shown = [name for name in others if alone.get(name, 0.0) > MIN_SHARE_LISTED][:MAX_OTHERS_LISTED]
    return out + [Importance(name, alone[name], None, None, unit) for name in shown]


def _stopped(rows: Sequence[Importance]) -> list[Importance]:
    """The same rows, none of which is the last that is worth adding."""
    return [replace(row, stop=False) for row in rows]


def _noise(fit: Fit) -> tuple[float, float]:
    """Noise of a frame, m, or N where friction was measured; and the reduced chi-squared beside it."""
    if not fit.measured:
        noise = float(np.sqrt(np.mean(np.concatenate([r.piece.noise for r in fit.solution.responses]) ** 2)))
        return noise, fit.reduced_chi2
    noise = measured_friction.weight_by_noise(fit.solution)[1].rms
    left = np.concatenate([r.piece.coloured(r.r) for r in fit.solution.responses])
    return noise, float(np.sum(left**2) / noise**2 / max(len(left) - len(fit.solution.p), 1))


def _listed(first: Round, found: list[RefinedCandidate], hold: _HeldOutErrors) -> list[Candidate]:
    """Every candidate with its evidence: those found first, then the others of the first round, best first."""
    chosen = {t.effect.name: t for t in found}
    alike = {
        t.effect.name: find_rivals(t, first.tried)
        for t in first.passing[:N_CANDIDATES_HELD_OUT]
        if t.effect.name not in chosen
    }
    there = {t.effect.name: t for t in first.tried if t.solution is not None}
    out = []
    for k, t in enumerate([*found, *(t for t in first.tried if t.effect.name not in chosen)]):
        name = t.effect.name
        shown = there.get(name, t)
        own = chosen.get(name, t)
        others = own.indistinguishable_from or alike.get(name, ())
        shown = replace(shown, indistinguishable_from=others, objection=own.objection)
        out.append(_candidate(shown, hold if t.p < ALPHA / 2 and k < N_CANDIDATES_HELD_OUT else None))
    return out


def _next(
    concluded: Diagnosis, first: Round, last: Round, found: list[RefinedCandidate], told: Callable[[str], None]
) -> list[dict[str, Any]]:
    """What to film or measure next, where something is unexplained, or candidates are not told apart well enough."""
    if concluded.verdict == "unexplained":
        return plan_for_unexplained(last.solution if concluded.missing or not found else first.solution, told)
    best = [t.effect.name for t in found[:1]]
    order = sorted(first.passing, key=lambda t: t.effect.name not in best)
    passing = [(t.effect.name, t.law, t.delta_bic) for t in order]
    return plan_for_candidates(first.solution, passing, found[0].indistinguishable_from if best else (), told)


def _fails_at(fit: Fit, found: list[RefinedCandidate]) -> list[dict[str, Any]]:
    """Where the model fails: where the missing force acts, or, if none is known, where the residual stands out."""
    if found and found[0].effect.acts_on == "force":
        return failing_spans(found[0].law, fit.runs, found[0].effect.name)
    return failing_spans(fit.solution, fit.runs)


class _HeldOutErrors:
    """Held-out errors beside those of the bare law, which are computed once for each way to hold out."""

    def __init__(self, bare: Solution) -> None:
        self._bare = bare
        self._known: dict[str, float] = {}
        self._how = heldout_rms if bare.problem.simulates else measured_friction.heldout_rms

    def __call__(self, solution: Solution) -> tuple[float, float, str]:
        """Error of the bare law, of this one, and how they were held out."""
        after, how = self._how(solution)
        if how not in self._known:
            self._known[how] = self._how(self._bare, how)[0]
        return self._known[how], after, how


def _candidate(tried: RefinedCandidate, hold: _HeldOutErrors | None) -> Candidate:
    effect, solution = tried.effect, tried.solution
    before = after = how = None
    parameters: dict[str, Any] = {}
    if solution is not None:
        if hold is not None:
            before, after, how = hold(solution)
        parameters = {
            name.split(".", 1)[1]: {"value": e.value, "std": e.std, "unit": e.unit}
            for name, e in _known(solution).parameters.items()
            if name.rsplit(".", 1)[0] == effect.name
        }
    measured = solution is not None and not solution.problem.simulates
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
        words=describe_effect(effect, None if measured else solution),
        unit="N" if measured else "um",
    )


def _known(solution: Solution) -> Estimates:
    """Parameters with deviations, of a measured friction from blocks of its residual."""
    if measured_friction.is_measured_friction(solution.problem):
        return linear_estimates(solution, measured_friction.block_covariance(solution))
    return estimates(solution, profile=False)


def _limits(first: Round) -> tuple[dict[str, dict[str, Any]], dict[str, dict[str, Array]]]:
    limits, curves = {}, {}
    for s in first.tests.scanned:
        limits[s.effect.name], curve = detection_limit(s, first.draws, first.tests.critical)
        if len(s.scans) == 1:
            curve["rise"] = s.scans[0].rises
        curves[s.effect.name] = curve
    return limits, curves


def _untried(barred: dict[str, str]) -> list[str]:
    """Why effects could not be tried, those for the same reason together: one sentence, or none."""
    alike: dict[str, list[str]] = {}
    for name, why in barred.items():
        alike.setdefault(why.removeprefix(f"{name} "), []).append(name)
    said = [f"{' and '.join(names)} {_plural(why, len(names))}" for why, names in alike.items()]
    return [f"not tried: {'; '.join(said)}"] if said else []


def _plural(why: str, count: int) -> str:
    """The reason of one effect as that of several: needs, need; follows, follow."""
    verb, _, rest = why.partition(" ")
    return why if count == 1 else f"{verb.removesuffix('s')} {rest}"


def _remarks(fit: Fit, barred: dict[str, str]) -> list[str]:
    out = _untried(barred)
    if fit.measured:
        return out + measured_friction.remarks(
            fit.solution, fit.runs, measured_friction.weight_by_noise(fit.solution)[1]
        )
    if len(fit.runs) == 1:
        out.append("one run alone: slope, a cable and Coulomb friction cannot be told apart")
    if any(run.has_incline for run in fit.runs):
        out.append(
            "on an incline Coulomb friction and gravity act alike while the mass slides one way: with a nominal scale, "
            "mass or angle only changes of the force along the run mean anything"
        )
    out.append(
        "a constant error of scale, frame rate or mass is absorbed exactly: "
        "forces go with mass and scale, and with fps^2"
    )
    return out
