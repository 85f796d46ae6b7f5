"""Diagnose a fit: search for missing effects, draw the verdict, then say where the model fails and what to do next.

Everything that can change the verdict is in `Conclusion.verdict`, so that it is never revised: held-out errors,
objections, what the runs could have shown, and formulas that explain more than the effects found.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from frictrack.base.distributions import RNG, accepts_seed
from frictrack.base.errors import FrictrackError
from frictrack.base.workers import one_thread
from frictrack.diagnose.auxiliary_signals import (
    AuxiliarySignals,
    Evidence,
    KnownFindings,
    assess_auxiliary_signals,
    evidence_curves,
)
from frictrack.diagnose.compare import failing_spans
from frictrack.diagnose.data_faults import held_remarks, rests_on_repairs, suspect_run_remarks
from frictrack.diagnose.diagnosis import Diagnosis, HeldOutErrors, importance_of_effects, tabulate_candidates
from frictrack.diagnose.examination import ALPHA, Examination
from frictrack.diagnose.experiments import plan_for_candidates, plan_for_unexplained
from frictrack.diagnose.explanations import MAX_SIZE
from frictrack.diagnose.finished_search import FinishedSearch, RefinedCandidate
from frictrack.diagnose.formulas import shapes_of_functions
from frictrack.diagnose.power import detection_limit, find_undetermined
from frictrack.diagnose.preparation import join_segments, subsample, subsample_frames
from frictrack.diagnose.repeatability import Repeatability
from frictrack.diagnose.residual_curves import FailurePattern, find_failure_pattern, residual_series
from frictrack.diagnose.search import Progress, SearchSettings, search_effects
from frictrack.diagnose.unexplained import UnexplainedForce, compare_with_formulas, unexplained_force
from frictrack.diagnose.verdict import MAX_ERROR_RATIO, NOTHING_TO_EXPLAIN, Grounds, judge
from frictrack.effects import Effect
from frictrack.fit import Fit, GroupFits
from frictrack.fit.least_squares import Solution
from frictrack.fit.observations import Observation, observation_of
from frictrack.fit.stepwise import refine_to_end
from frictrack.records import Array
from frictrack.settings.costs import DEFAULT_COSTS, Costs

UNNAMED = "{} passes its test too, but with it the error of what was held out rises: it is not named"


@accepts_seed
@one_thread()
def diagnose(  # noqa: PLR0913 - one function with named settings, all but the fit optional
    fit: Fit,
    *,
    own: Sequence[Effect] = (),
    functions: Sequence[str] = (),
    auxiliary: AuxiliarySignals | None = None,
    rng: RNG = 0,
    alpha: float = ALPHA,
    costs: Costs = DEFAULT_COSTS,
    progress: Progress | None = None,
    quick: bool = False,
    on_verdict: Callable[[Diagnosis], None] | None = None,
) -> Diagnosis:
    """Search the effect library for what a fitted model lacks.

    The search compares sets of effects, best first: every single effect, then pairs, then sets of three. It ends when a
    set leaves no misfit, or when no larger set explains more. Validation runs are not used.

    Parameters
    ----------
    fit
        One fit of all runs.
    own
        Further effects to try: the user's own, or library effects with bounds, priors or fixed values.
    functions
        Further functions of a dimensionless z for formulas of a force that no effect explains, such as "z^2*exp(-z)":
        tried with z = u/w and z = (u - c)/w over place, time and speed.
    auxiliary
        Other measurements, by run and name, one value per frame (n,): displacements of further targets in m, and
        "accelerometer" in m/s^2. Those that move with the residual are reported as evidence.
    rng
        Random numbers of the draws: a generator, a seed, or None for other numbers in every call.
    alpha
        Significance level: half for lack of fit, half for all candidates together. It bounds the probability that a
        complete model is said to lack something; a `Session` lowers it for models that are tried as alternatives.
    costs
        Costs of the next experiments, and what the set-up can do: they are rated by evidence over cost.
    progress
        Called with the size of the sets that are searched, the largest size, and the current step.
    quick
        Return the verdict and the candidates as soon as they are known, with `complete` False.
    on_verdict
        Called with that incomplete diagnosis as soon as the verdict is known; the verdict is not revised afterwards.

    Returns
    -------
    Diagnosis
        The verdict, the candidates with their evidence, the detection limits and the next experiment. p-values account
        for the whole search (up to 999 draws).

    Raises
    ------
    FrictrackError
        If `fit` holds one fit per group, or `alpha` is not between 0 and 1.

    Examples
    --------
    >>> import frictrack as ft
    >>> ft.diagnose(ft.fit(["coulomb", "viscous"], ft.samples.runs()[1:2])).missing
    ['patch']

    """
    notify = progress or (lambda done, total, what: None)
    if isinstance(fit, GroupFits):
        raise FrictrackError("expected one fit of all runs to diagnose but got one per group; fit without --per first")
    given: object = fit
    if not isinstance(given, Fit):
        raise FrictrackError(f"expected a fit, as ft.fit returns it, but got {type(given).__name__}", usage=True)
    if not 0 < alpha < 1:
        raise FrictrackError(f"expected a significance level between 0 and 1 but got alpha = {alpha}")
    settings = SearchSettings(own, auxiliary, rng, alpha / 2, shapes_of_functions(functions), notify)
    conclusion = replace(_search_and_conclude(fit, settings), costs=costs)
    if on_verdict is not None:
        on_verdict(conclusion.verdict)
    if quick:
        return conclusion.verdict
    diagnosis = conclusion.completed(auxiliary, lambda what: notify(MAX_SIZE, MAX_SIZE, what))
    notify(MAX_SIZE, MAX_SIZE, "diagnosed")
    return diagnosis


def _search_and_conclude(fit: Fit, settings: SearchSettings) -> Conclusion:
    """Search and conclude; a fit in segments is searched in one piece first, if that explains everything."""
    joined = join_segments(fit)
    if joined is not None:
        joined, remark = subsample_frames(joined)
        conclusion = _conclude(fit, joined, [remark], settings)
        if not conclusion.search.last.leaves_misfit and conclusion.verdict.verdict != "unexplained":
            return conclusion
    # the tests work on the displacement, whatever domain or search the fit used
    start = fit.solution if fit.route.is_default else refine_to_end(fit.solution)
    return _conclude(fit, *subsample(start), settings)


def _conclude(fit: Fit, start: Solution, remarks: Sequence[str], settings: SearchSettings) -> Conclusion:
    found = search_effects(fit.runs, start, settings)
    settings.notify(MAX_SIZE, MAX_SIZE, "comparing the effects found")
    return Conclusion(fit, found, tuple(filter(None, [found.cut, *remarks])))


@dataclass(frozen=True, eq=False)
class Conclusion:
    """What follows from a finished search; every part is computed when it is first asked for.

    Parameters
    ----------
    fit
        The fit that is diagnosed.
    search
        The search.
    remarks
        Sentences on how the search was made.
    costs
        Costs of the next experiments.

    """

    fit: Fit
    search: FinishedSearch
    remarks: tuple[str, ...] = ()
    costs: Costs = DEFAULT_COSTS

    @cached_property
    def verdict(self) -> Diagnosis:
        """The diagnosis as far as the verdict needs it, with `complete` False: verdict, candidates, limits."""
        first, grounds, formulas, is_formula = self.search.first, self._grounds, self._formulas, self._is_formula
        rival = formulas is not None and formulas.summary["rival"] is not None
        verdict = judge(replace(grounds, is_formula=is_formula, has_rivals=grounds.has_rivals or rival))
        keeps_unexplained = self._verdict_of_effects == "unexplained" and not is_formula
        named = [] if is_formula else self._plausible_names
        in_um = self._observation.unit == "um"
        noise, misfit = self._noise
        limits, curves = self._limits
        remarks = [*_describe_excluded(first.excluded), *self._observation.remarks(self.fit), *self.remarks]
        if self._named:
            remarks += held_remarks(self.search.start, self._named[-1].law)
            plausible = [t.effect.title for t in self._named if not t.objection]
            remarks += [UNNAMED.format(name) for name in plausible if named and name not in named]
        return Diagnosis(
            model=self.fit.model.names,
            verdict=verdict,
            missing=[] if verdict == "unexplained" else named,
            leads=named if verdict == "unexplained" else [],
            noise_um=1e6 * noise if in_um else None,
            noise_N=None if in_um else noise,
            reduced_chi2=misfit,
            p_lack_of_fit=first.p_lack_of_fit,
            fails_at=[],
            candidates=tabulate_candidates(self.search, self._heldout),
            unexplained=None if keeps_unexplained or formulas is None else formulas.summary,
            detection_limits=limits,
            undetermined=list(grounds.gaps) if verdict == "undetermined" else [],
            alternatives=list(self.search.alternatives) if self._named else [],
            remarks=remarks,
            figures=dict(curves),
            complete=False,
            alpha=2 * first.level,
            rests_on_repairs=rests_on_repairs(self.fit.runs, verdict, self.search),
        )

    def completed(self, auxiliary: AuxiliarySignals | None, notify: Callable[[str], None]) -> Diagnosis:
        """Return the whole diagnosis: failure pattern, importance, evidence of other signals, next experiments.

        `auxiliary`: other measurements; see `diagnose`.
        """
        notify("finding where the model fails")
        found = replace(
            self.verdict,
            complete=True,
            fails_at=self._fails_at if self.search.something_is_missing else [],
            importance=importance_of_effects(self.search, self._named, self.verdict.candidates, self._heldout),
            figures=self.verdict.figures | {"residual": self._residual},
        )
        if found.verdict in NOTHING_TO_EXPLAIN:
            return found
        found = self._with_pattern(found, self._evidence(auxiliary))
        if found.verdict == "unexplained" and self.search.last.leaves_misfit and not self._is_formula:
            notify("looking for a run that disagrees with the others")
            suspects = suspect_run_remarks(self.search.last.solution, self.fit.runs, self.search.generators[0])
            found = replace(found, remarks=[*found.remarks, *suspects])
        notify("planning the next experiment")
        return replace(found, next_experiment=self._plan_next(found, notify))

    @cached_property
    def _grounds(self) -> Grounds:
        """What the verdict rests on, before the effects are compared with formulas."""
        search, found = self.search, self.search.found
        _, curves = self._limits
        # with all effects found: one alone need not lower the error where others are missing too
        before, after, _ = self._heldout(found[-1].law) if found else (1.0, 0.0, "")
        return Grounds(
            something_missing=search.something_is_missing,
            n_found=len(found),
            misfit_left=search.last.leaves_misfit,
            has_objection=any(t.objection for t in found),
            has_rivals=any(t.indistinguishable_from for t in found) or bool(search.alternatives and found),
            error_ratio=after / before,
            reduced_chi2=self._noise[1],
            gaps=find_undetermined(self.fit, search.first, curves, found[-1].law if found else None),
        )

    @cached_property
    def _verdict_of_effects(self) -> str:
        return judge(self._grounds)

    @cached_property
    def _named(self) -> list[RefinedCandidate]:
        """The effects found; none if the runs leave the model itself undetermined."""
        return [] if self._verdict_of_effects == "undetermined" else self.search.found

    @property
    def _plausible_names(self) -> list[str]:
        """The plausible effects found, up to the last that does not raise the error of what was held out."""
        lowest, last = 1.0, 0
        for i, t in enumerate(self._named, start=1):
            bare, error, _ = self._heldout(t.law)
            if error < MAX_ERROR_RATIO * lowest * bare:
                lowest, last = min(error / bare, lowest), i
        return [t.effect.title for t in self._named[:last] if not t.objection]

    @cached_property
    def _formulas(self) -> UnexplainedForce | None:
        """Formulas that explain as much as the effects found; None if there are none.

        They are the only other explanation where effects explain everything, or are far behind one of them.
        """
        search, start = self.search, self.search.start
        is_explained = bool(search.found) and (not search.last.leaves_misfit or search.is_beaten)
        if not (is_explained and self._verdict_of_effects not in NOTHING_TO_EXPLAIN and start.problem.simulates):
            return None

        def repeats() -> Repeatability:
            if not search.last.leaves_misfit:
                return self._pattern.repeats
            return find_failure_pattern(start, search.generators[1], None).repeats

        return compare_with_formulas(search.formulas, search.last.solution, repeats)

    @property
    def _is_formula(self) -> bool:
        """Whether a formula explains far more than the effects found."""
        return self._formulas is not None and bool(self._formulas.summary["decisive"])

    @cached_property
    def _pattern(self) -> FailurePattern:
        """What the misfit has in common from run to run, given what explains everything, if anything does."""
        explained = None
        if self.search.found and not self.search.last.leaves_misfit:
            explained = self.search.last.solution
        elif self._is_formula and self._formulas is not None:
            explained = self._formulas.formulas[0].solution
        return find_failure_pattern(self.search.start, self.search.generators[1], explained)

    @cached_property
    def _observation(self) -> Observation:
        return observation_of(self.fit.solution.problem)

    @cached_property
    def _heldout(self) -> HeldOutErrors:
        return HeldOutErrors(self.search.first.solution)

    @cached_property
    def _noise(self) -> tuple[float, float]:
        return self._observation.noise(self.fit.solution, self.fit.reduced_chi2)

    @cached_property
    def _limits(self) -> tuple[dict[str, dict[str, Any]], dict[str, dict[str, Array]]]:
        return _limits(self.search.first)

    @property
    def _residual(self) -> dict[str, Array]:
        """The residual of the fit, and with the effects found, along the motion of every run."""
        after = self.search.last.solution if self._named else None
        return residual_series(self.search.start, after, [t.effect.name for t in self._named if not t.effect.frees])

    @property
    def _fails_at(self) -> list[dict[str, Any]]:
        """The spans where the missing force acts or, if none is known, where the residual is significant."""
        found = self._named
        if found and found[0].effect.acts_on == "force" and not found[0].effect.frees:
            return failing_spans(found[0].law, self.fit.runs, found[0].effect.name)
        return failing_spans(self.fit.solution, self.fit.runs)

    def _evidence(self, auxiliary: AuxiliarySignals | None) -> list[Evidence]:
        """Other measurements that match the residual."""
        search, known = self.search, KnownFindings()
        if not search.start.problem.simulates:
            return []  # there is no motion that signals could be compared with
        if search.found:
            known = KnownFindings(search.found[0].delta_bic, search.last.solution, self._plausible_names)
        return assess_auxiliary_signals(search.start, self.fit.runs, search.generators[0], auxiliary, known)

    def _with_pattern(self, found: Diagnosis, evidence: list[Evidence]) -> Diagnosis:
        """Return the diagnosis with the failure pattern, the evidence and the force that no effect explains."""
        pattern = None if self.search.start.problem.is_of_points else self._pattern  # it needs a place and a time
        repeats, unexplained = pattern.repeats if pattern else found.repeats, found.unexplained
        if found.verdict == "unexplained" and unexplained is not None and not repeats.best:
            repeats = replace(repeats, words="")  # the formula says it
        if found.verdict == "unexplained" and unexplained is None:
            unexplained = unexplained_force(self.search.formulas, self.search.last.solution).summary
        figures = found.figures | (pattern.figures if pattern else {}) | evidence_curves(evidence)
        return replace(found, evidence=evidence, repeats=repeats, unexplained=unexplained, figures=figures)

    def _plan_next(self, found: Diagnosis, notify: Callable[[str], None]) -> list[dict[str, Any]]:
        """Propose experiments where misfit is unexplained or candidates are indistinguishable."""
        first, last, effects = self.search.first, self.search.last, self.search.found
        if first.solution.problem.is_of_points:
            return []  # runs are planned as motions
        if found.verdict == "unexplained":
            solution = last.solution if found.leads or not effects else first.solution
            return plan_for_unexplained(solution, notify, self.costs)
        best = [t.effect.title for t in effects[:1]]
        order = sorted(self.search.passing, key=lambda t: t.effect.title not in best)
        passing = [(t.effect.title, t.law, t.delta_bic) for t in order]
        rivals = effects[0].indistinguishable_from if best else ()
        compared = self._formulas
        formula = compared.as_candidate() if compared is not None and compared.summary["rival"] else None
        if formula is not None and len(effects) == 1:  # a formula in place of several effects is no rival of one
            passing, rivals = [*passing, formula], (formula[0], *rivals)
        return plan_for_candidates(first.solution, passing, rivals, notify, self.costs)


def _limits(first: Examination) -> tuple[dict[str, dict[str, Any]], dict[str, dict[str, Array]]]:
    """Return the detection limit of every scanned effect, and its curve over all settings."""
    limits, curves = {}, {}
    for s in first.scanned:
        limits[s.effect.title], curve = detection_limit(s, first.draws, first.critical)
        if len(s.scans) == 1:
            curve["rise"] = s.scans[0].gains
        curves[s.effect.title] = curve
    return limits, curves


def _describe_excluded(excluded: Mapping[str, str]) -> list[str]:
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
