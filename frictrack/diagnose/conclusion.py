"""Diagnose a fit: search for missing effects, draw the verdict, then say where the model fails and what to do next.

Everything that can change the verdict is in `Conclusion.verdict`, so that it is never revised: held-out errors,
objections, what the runs could have shown, and formulas that explain more than the effects found.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np

from frictrack.base.arguments import checked
from frictrack.base.distributions import RNG
from frictrack.base.errors import FrictrackError
from frictrack.base.number_format import format_plain, join_words
from frictrack.base.workers import one_thread
from frictrack.diagnose.auxiliary_signals import (
    AuxiliarySignals,
    Evidence,
    KnownFindings,
    assess_auxiliary_signals,
    evidence_curves,
)
from frictrack.diagnose.compare import failing_spans
from frictrack.diagnose.data_faults import doubted_mass, remarks_on_named, rests_on_repairs, suspect_run_remarks
from frictrack.diagnose.diagnosis import Candidate, Diagnosis, Importance
from frictrack.diagnose.effect_description import describe_effect
from frictrack.diagnose.examination import ALPHA
from frictrack.diagnose.experiments import plan_for_candidates, plan_for_unexplained
from frictrack.diagnose.explanations import MAX_SIZE
from frictrack.diagnose.formula_terms import shapes_of_functions
from frictrack.diagnose.formulas import UnexplainedForce, are_left_out, compare_with_formulas, unexplained_force
from frictrack.diagnose.friction_levels import chosen_levels, describe_levels
from frictrack.diagnose.model_selection import leaves_only_noise
from frictrack.diagnose.power import detection_limits, find_undetermined
from frictrack.diagnose.repeatability import Repeatability
from frictrack.diagnose.residual_curves import FailurePattern, find_failure_pattern, residual_series
from frictrack.diagnose.search import (
    FinishedSearch,
    Progress,
    RefinedCandidate,
    SearchSettings,
    join_segments,
    search_effects,
    subsample,
    subsample_frames,
)
from frictrack.diagnose.verdict import MAX_ERROR_RATIO, NOTHING_TO_EXPLAIN, Grounds, judge
from frictrack.effects import Effect
from frictrack.fit import Fit, GroupFits
from frictrack.fit.least_squares import Solution, heldout_rms
from frictrack.fit.observations import Observation, observation_of
from frictrack.fit.stepwise import refine_to_end
from frictrack.fit.uncertainty import negative_force_remark
from frictrack.records import Array
from frictrack.settings.costs import DEFAULT_COSTS, Costs

UNNAMED = "{} passes its test too, but with it the error of what was held out rises: it is not named"
MIN_SHARE_LISTED = 0.01  # of the misfit, of further effects in the table of importance
MAX_OTHERS_LISTED = 6  # further effects in the table of importance
WITHOUT_MEMORY = (
    "formulas were added to the fitted model alone, not to the effects found: these have memory, with which every fit "
    "takes long; add them to the model to have formulas of what they leave"
)


@checked
@one_thread()
def diagnose(  # noqa: PLR0913 - one function with named settings, all but the fit optional
    fit: Fit | GroupFits,
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


def unsearched(fit: Fit, alpha: float) -> Diagnosis:
    """Return the diagnosis of a fit for which nothing is searched, as its runs have to be put right first."""
    observation = observation_of(fit.solution.problem)
    noise, misfit = observation.noise(fit.solution, fit.reduced_chi2)
    in_um = observation.unit == "um"
    return Diagnosis(
        model=fit.model.names,
        verdict="undetermined",
        missing=[],
        noise_um=1e6 * noise if in_um else None,
        noise_N=None if in_um else noise,
        reduced_chi2=misfit,
        p_lack_of_fit=np.nan,
        fails_at=[],
        candidates=[],
        unexplained=None,
        detection_limits={},
        remarks=[],
        figures={},
        alpha=alpha,
    )


def _search_and_conclude(fit: Fit, settings: SearchSettings) -> Conclusion:
    """Search and conclude; a fit in segments is searched in one piece first, if that explains everything."""

    def conclude(start: Solution, remarks: Sequence[str]) -> Conclusion:
        found = search_effects(fit.runs, start, settings)
        settings.notify(MAX_SIZE, MAX_SIZE, "comparing the effects found")
        return Conclusion(fit, found, tuple(filter(None, [found.cut, *remarks])))

    joined = join_segments(fit)
    if joined is not None:
        joined, remark = subsample_frames(joined)
        conclusion = conclude(joined, [remark])
        if not conclusion.search.last.leaves_misfit and conclusion.verdict.verdict != "unexplained":
            return conclusion
    # the tests work on the displacement, whatever domain or search the fit used
    return conclude(*subsample(fit.solution if fit.route.is_default else refine_to_end(fit.solution)))


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
        search, grounds, formulas, is_formula = self.search, self._grounds, self._formulas, self._is_formula
        rival = formulas is not None and formulas.summary["rival"] is not None
        verdict = judge(replace(grounds, is_formula=is_formula, has_rivals=grounds.has_rivals or rival))
        keeps_unexplained = self._verdict_of_effects == "unexplained" and not is_formula
        named = list(formulas.effects) if is_formula and formulas is not None else self._plausible_names
        in_um = self._observation.unit == "um"
        noise, misfit = self._noise
        limits, curves = self._limits
        remarks = [*_describe_excluded(search.first.excluded), *self._observation.remarks(self.fit), *self.remarks]
        if self._named:
            causes = [t for t in self._named if self._may_be_cause(t)]
            remarks += remarks_on_named(search.start, self._named[-1].law, causes, self.fit.runs)
            plausible = [t.effect.title for t in causes]
            remarks += _describe_misfit_left(search)
            sizes = {
                f"{t.effect.name}.{name}": (size["value"], size["std"])
                for t, candidate in zip(self._named, self._candidates, strict=False)
                for name, size in candidate.parameters.items()
            }
            remarks += negative_force_remark(self._named[-1].law, sizes)
            remarks += [UNNAMED.format(name) for name in plausible if named and name not in named and not is_formula]
        found = Diagnosis(
            model=self.fit.model.names,
            verdict=verdict,
            missing=[] if verdict == "unexplained" else named,
            leads=named if verdict == "unexplained" else [],
            noise_um=1e6 * noise if in_um else None,
            noise_N=None if in_um else noise,
            reduced_chi2=misfit,
            p_lack_of_fit=max(search.first.p_lack_of_fit, search.first.least_p),
            fails_at=[],
            candidates=self._candidates,
            unexplained=None if keeps_unexplained or formulas is None else formulas.summary,
            detection_limits=limits,
            undetermined=[*grounds.doubted, *grounds.gaps] if verdict == "undetermined" else [],
            alternatives=self._alternatives if self._named else [],
            remarks=remarks,
            figures=dict(curves),
            complete=False,
            alpha=2 * search.first.level,
            rests_on_repairs=rests_on_repairs(self.fit.runs, verdict, search),
        )
        law = formulas.formulas[0].solution if is_formula and formulas is not None else search.last.solution
        return found if verdict == "unexplained" and not is_formula else self._with_levels(found, law)

    def completed(self, auxiliary: AuxiliarySignals | None, notify: Callable[[str], None]) -> Diagnosis:
        """Return the whole diagnosis: failure pattern, importance, evidence of other signals, next experiments.

        `auxiliary`: other measurements; see `diagnose`.
        """
        notify("finding where the model fails")
        # the residual of the fit, and with the effects found, along the motion of every run
        after = self.search.last.solution if self._named else None
        effects = [t.effect.name for t in self._named if not t.effect.frees]
        found = replace(
            self.verdict,
            complete=True,
            fails_at=self._fails_at if self.search.something_is_missing else [],
            importance=self._importance,
            figures=self.verdict.figures | {"residual": residual_series(self.search.start, after, effects)},
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
        # with all effects found: one alone need not lower the error where others are missing too
        before, after, _ = self._heldout(found[-1].law) if found else (1.0, 0.0, "")
        grounds = Grounds(
            something_missing=search.something_is_missing,
            n_found=len(found),
            misfit_left=search.last.leaves_misfit,
            has_objection=any(t.objection for t in found),
            has_rivals=any(t.indistinguishable_from for t in found[: self._n_worth_adding]) or bool(self._alternatives),
            error_ratio=after / before,
            reduced_chi2=self._noise[1],
            doubted=doubted_mass(self.fit, search),
        )
        if grounds.is_clear:
            return grounds
        gaps = find_undetermined(self.fit, search.first, self._limits[1], found[-1].law if found else None)
        return replace(grounds, gaps=gaps)

    @cached_property
    def _verdict_of_effects(self) -> str:
        return judge(self._grounds)

    @cached_property
    def _named(self) -> list[RefinedCandidate]:
        """The effects found; none if the runs leave the model itself undetermined."""
        return [] if self._verdict_of_effects == "undetermined" else self.search.found

    @cached_property
    def _n_worth_adding(self) -> int:
        """How many effects are worth adding: up to the last that does not raise the error of what was held out."""
        lowest, last = 1.0, 0
        for i, t in enumerate(self.search.found, start=1):
            bare, error, _ = self._heldout(t.law)
            if error < MAX_ERROR_RATIO * lowest * bare:
                lowest, last = min(error / bare, lowest), i
        return last

    @property
    def _alternatives(self) -> list[dict[str, Any]]:
        """Other sets that explain as much; one with all effects worth adding stands in place of none of them."""
        worth_adding = {t.effect.title for t in self.search.found[: self._n_worth_adding]}
        return [one for one in self.search.alternatives if not worth_adding <= set(one["effects"])]

    @property
    def _plausible_names(self) -> list[str]:
        """The plausible effects among those worth adding."""
        return [t.effect.title for t in self._named[: self._n_worth_adding] if self._may_be_cause(t)]

    def _may_be_cause(self, t: RefinedCandidate) -> bool:
        """Whether an effect has no objection; an error of a camera is no lead for tables that it does not explain."""
        is_seen = not self.search.last.leaves_misfit or any(run.pixel_pitch is not None for run in self.fit.runs)
        return not t.objection and (is_seen or not t.effect.of_camera)

    @property
    def _importance(self) -> list[Importance]:
        """The share of the misfit that each named effect, and each plausible other one that passed, explains."""
        alone = {t.effect.title: t.share for t in self.search.tried}
        first, unit, out = self.search.first, self._observation.unit, list[Importance]()
        excess = max(first.solution.chi2 - first.solution.problem.n_frames, 1e-300)
        chi2 = [first.solution.chi2, *(t.law.chi2 for t in self._named)]
        for i, t in enumerate(self._named):
            share, error = float(np.clip((chi2[i] - chi2[i + 1]) / excess, -1.0, 1.0)), self._heldout(t.law)[1]
            name = t.effect.title
            out.append(Importance(name, alone.get(name), share, error, unit, stop=i + 1 == self._n_worth_adding))
        names = {t.effect.title for t in self._named}
        others = [
            c.effect for c in self._candidates if c.p < first.level and c.effect not in names and not c.implausible
        ]
        shown = [name for name in others if (alone.get(name) or 0.0) > MIN_SHARE_LISTED][:MAX_OTHERS_LISTED]
        return out + [Importance(name, alone[name], None, None, unit) for name in shown]

    @cached_property
    def _candidates(self) -> list[Candidate]:
        """All candidates with their evidence: those found first, then the others alone, best first."""
        search, found = self.search, {t.effect.title for t in self.search.found}
        return [self._candidate(t) for t in [*search.found, *(t for t in search.tried if t.effect.title not in found)]]

    def _candidate(self, t: RefinedCandidate) -> Candidate:
        known: dict[str, Any] = {"parameters": {}}
        if t.solution is not None:
            known["parameters"] = {
                name.split(".", 1)[1]: {"value": e.value, "std": e.std, "unit": e.unit}
                for name, e in self._observation.estimates_of_candidate(t.solution).parameters.items()
                if name.rsplit(".", 1)[0] == t.effect.name
            }
            if t.p < self.search.first.level:
                names = ("heldout_before", "heldout_after", "heldout")
                known |= dict(zip(names, self._heldout(t.solution), strict=True))
        simulated = t.solution if self.search.start.problem.simulates else None
        return Candidate(
            effect=t.effect.title,
            acts_on=t.effect.acts_on,
            p=t.p,
            delta_bic=float(t.delta_bic),
            indistinguishable_from=t.indistinguishable_from,
            implausible=t.objection,
            words=describe_effect(t.effect, simulated),
            unit=self._observation.unit,
            passes=t.passes and not t.objection,
            **known,
        )

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
            pattern = find_failure_pattern(start, search.generators[1]) if search.last.leaves_misfit else self._pattern
            return pattern.repeats

        return compare_with_formulas(search.formulas, search.last.solution, repeats, search.rivals)

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
    def _heldout(self) -> Callable[[Solution], tuple[float, float, str]]:
        """Held-out errors of the bare model and, held out in the same way, of another, and how; each computed once."""
        of_models: dict[int, tuple[float, str]] = {}  # by identity: the search keeps the models alive
        of_bare = cache(lambda how: heldout_rms(self.search.first.solution, how)[0])

        def errors(solution: Solution) -> tuple[float, float, str]:
            if id(solution) not in of_models:
                of_models[id(solution)] = heldout_rms(solution)
            after, how = of_models[id(solution)]
            return of_bare(how), after, how

        return errors

    @cached_property
    def _noise(self) -> tuple[float, float]:
        return self._observation.noise(self.fit.solution, self.fit.reduced_chi2)

    @cached_property
    def _limits(self) -> tuple[dict[str, dict[str, Any]], dict[str, dict[str, Array]]]:
        return detection_limits(self.search.first)

    @property
    def _fails_at(self) -> list[dict[str, Any]]:
        """The spans where the missing force acts or, if none is known, where the residual is significant."""
        found = self._named
        if found and found[0].effect.acts_on == "force" and not found[0].effect.frees:
            return failing_spans(found[0].law, self.fit.runs, found[0].effect.name)
        return failing_spans(self.fit.solution, self.fit.runs)

    def _evidence(self, auxiliary: AuxiliarySignals | None) -> list[Evidence]:
        """Other measurements that match the residual."""
        search = self.search
        if not search.start.problem.simulates:
            return []  # there is no motion that signals could be compared with
        known = [KnownFindings(t.delta_bic, search.last.solution, self._plausible_names) for t in search.found[:1]]
        return assess_auxiliary_signals(search.start, self.fit.runs, search.generators[0], auxiliary, *known)

    def _with_pattern(self, found: Diagnosis, evidence: list[Evidence]) -> Diagnosis:
        """Return the diagnosis with the failure pattern, the evidence and the force that no effect explains."""
        pattern = None if self.search.start.problem.is_of_points else self._pattern  # it needs a place and a time
        repeats, unexplained = pattern.repeats if pattern else found.repeats, found.unexplained
        if found.verdict == "unexplained" and unexplained is not None and not repeats.best:
            repeats = replace(repeats, words="")  # the formula says it
        if found.verdict == "unexplained" and unexplained is None:
            formulas, extended = self.search.formulas, self.search.last.solution
            force = unexplained_force(formulas, extended)
            unexplained = force.summary
            if force.formulas and leaves_only_noise(force.formulas[0].solution):
                found = self._with_levels(found, force.formulas[0].solution)
            if are_left_out(formulas, extended):
                found = replace(found, remarks=[*found.remarks, WITHOUT_MEMORY])
        figures = found.figures | (pattern.figures if pattern else {}) | evidence_curves(evidence)
        return replace(found, evidence=evidence, repeats=repeats, unexplained=unexplained, figures=figures)

    def _with_levels(self, found: Diagnosis, law: Solution) -> Diagnosis:
        """Return the diagnosis with what the friction levels multiply in the law that explains the runs."""
        models = law.problem.model, self.fit.model
        remarks = filter(None, [*found.remarks, describe_levels(*models)])
        return replace(found, levels=chosen_levels(*models), remarks=list(remarks))

    def _plan_next(self, found: Diagnosis, notify: Callable[[str], None]) -> list[dict[str, Any]]:
        """Propose experiments where misfit is unexplained or candidates are indistinguishable."""
        first, last, effects = self.search.first, self.search.last, self.search.found
        if first.solution.problem.is_of_points:
            return []  # runs are planned as motions
        if found.verdict == "unexplained":
            solution = last.solution if (found.leads and not self._is_formula) or not effects else first.solution
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


def _describe_misfit_left(search: FinishedSearch) -> list[str]:
    """Say that effects leave a misfit which may be chance."""
    p = search.last.p_lack_of_fit
    if search.last.leaves_misfit or p >= search.first.level:
        return []
    return [f"with these effects a misfit is left that may be chance (p = {format_plain(p, 1)}); more runs tell"]


def _describe_excluded(excluded: Mapping[str, str]) -> list[str]:
    """Say in one sentence which effects could not be tried, grouped by reason."""
    by_reason: dict[str, list[str]] = {}
    for name, why in excluded.items():
        by_reason.setdefault(why.removeprefix(f"{name} "), []).append(name)
    reasons = [f"{join_words(names)} {_plural(why, len(names))}" for why, names in by_reason.items()]
    return [f"not tried: {'; '.join(reasons)}"] if reasons else []


def _plural(why: str, count: int) -> str:
    """Put the reason of one effect into the plural: "needs" becomes "need"."""
    verb, _, rest = why.partition(" ")
    return why if count == 1 else f"{verb.removesuffix('s')} {rest}"
