"""Draw the conclusion of a finished search: first the verdict, then where the model fails and what to do next.

Everything that can change the verdict is in `Conclusion.verdict`, so that it is never revised: held-out errors,
objections, what the runs could have shown, and formulas that explain more than the effects found.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from frictrack.compare import failing_spans
from frictrack.costs import DEFAULT_COSTS, Costs
from frictrack.diagnose.auxiliary_signals import (
    AuxiliarySignals,
    Evidence,
    KnownFindings,
    assess_auxiliary_signals,
    evidence_curves,
)
from frictrack.diagnose.candidate_table import HeldOutErrors, importance_of_effects, tabulate_candidates
from frictrack.diagnose.examination import Examination
from frictrack.diagnose.experiments import plan_for_candidates, plan_for_unexplained
from frictrack.diagnose.finished_search import FinishedSearch
from frictrack.diagnose.held_parameters import held_remarks
from frictrack.diagnose.power import detection_limit, find_undetermined
from frictrack.diagnose.refined_candidates import RefinedCandidate
from frictrack.diagnose.repaired_frames import rests_on_repairs
from frictrack.diagnose.repeatability import Repeatability
from frictrack.diagnose.residual_curves import FailurePattern, find_failure_pattern, residual_series
from frictrack.diagnose.suspect_runs import suspect_run_remarks
from frictrack.diagnose.unexplained import UnexplainedForce, compare_with_formulas, unexplained_force
from frictrack.diagnose.verdict import Candidate, Diagnosis
from frictrack.diagnose.verdict_rule import Grounds, judge
from frictrack.fit import Fit
from frictrack.fit.least_squares import Solution
from frictrack.fit.observations import observation_of
from frictrack.records import Array

NOTHING_TO_EXPLAIN = ("complete", "undetermined")  # verdicts that name no failure


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
        found, search = self._before_formulas, self.search
        if self._compared is not None:
            found = self._judge_formulas(found, self._compared.summary)
        rests = rests_on_repairs(self.fit.runs, found.verdict, search.first, search.last.solution, search.found)
        return replace(found, rests_on_repairs=rests)

    def completed(self, auxiliary: AuxiliarySignals | None, notify: Callable[[str], None]) -> Diagnosis:
        """Return the whole diagnosis: failure pattern, importance, evidence of other signals, next experiments.

        Parameters
        ----------
        auxiliary
            Other measurements; see `diagnose`.
        notify
            Called with the current step.

        """
        notify("finding where the model fails")
        found = replace(
            self.verdict,
            complete=True,
            fails_at=[] if self._nothing_missing else self._fails_at,
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
    def _heldout(self) -> HeldOutErrors:
        return HeldOutErrors(self.search.first.solution)

    @cached_property
    def _pattern(self) -> FailurePattern:
        """What the misfit has in common from run to run."""
        return find_failure_pattern(self.search.start, self.search.generators[1], self._explained)

    @property
    def _explained(self) -> Solution | None:
        """The model with the effects, or with the formula, that explain everything; None if none do."""
        if self.search.found and not self.search.last.leaves_misfit:
            return self.search.last.solution
        first = self._compared.formulas[0] if self._compared is not None and self._is_formula else None
        return None if first is None else first.solution

    @property
    def _is_formula(self) -> bool:
        """Whether a formula explains far more than the effects found."""
        return self._compared is not None and bool(self._compared.summary["decisive"])

    @property
    def _nothing_missing(self) -> bool:
        return not (self.search.first.leaves_misfit or self.search.passing or self.search.found)

    @cached_property
    def _named(self) -> list[RefinedCandidate]:
        """The effects found; none if the runs leave the model itself undetermined."""
        return [] if self._before_formulas.verdict == "undetermined" else self.search.found

    @cached_property
    def _before_formulas(self) -> Diagnosis:
        """The verdict from effects alone, with the evidence of every candidate and detection limits."""
        first, found = self.search.first, self.search.found
        listed = tabulate_candidates(self.search, self._heldout)
        limits, curves = _limits(first)
        observation = observation_of(self.fit.solution.problem)
        noise, misfit = observation.noise(self.fit.solution, self.fit.reduced_chi2)
        grown = found[-1].law if found else None
        gaps = find_undetermined(self.fit, first, curves, grown)
        verdict = judge(
            Grounds(
                something_missing=not self._nothing_missing,
                n_found=len(found),
                misfit_left=self.search.last.leaves_misfit,
                has_objection=any(t.objection for t in found),
                has_rivals=any(t.indistinguishable_from for t in found),
                error_ratio=0.0 if self._nothing_missing else self._error_ratio(listed),
                reduced_chi2=misfit,
                gaps=gaps,
            )
        )
        named = [] if verdict == "undetermined" else found
        names = [t.effect.title for t in named if not t.objection]
        return Diagnosis(
            model=self.fit.model.names,
            verdict=verdict,
            missing=[] if verdict == "unexplained" else names,
            leads=names if verdict == "unexplained" else [],
            noise_um=1e6 * noise if observation.unit == "um" else None,
            noise_N=noise if observation.unit == "N" else None,
            reduced_chi2=misfit,
            p_lack_of_fit=first.tests.p_lack_of_fit,
            fails_at=[],
            candidates=listed,
            unexplained=None,
            detection_limits=limits,
            undetermined=gaps if verdict == "undetermined" else [],
            alternatives=[one.summary() for one in self.search.alternatives] if named else [],
            remarks=[
                *_remarks(self.fit, first.excluded),
                *self.remarks,
                *(held_remarks(self.search.start, grown) if named and grown else []),
            ],
            figures=curves,
            complete=False,
            alpha=2 * first.tests.level,
        )

    def _error_ratio(self, listed: Sequence[Candidate]) -> float:
        """Held-out error with all effects found over that of the model without them; 0 if it was not computed.

        An effect alone need not lower the error where others are missing too.
        """
        found = self.search.found
        if len(found) == 1:
            before, after = listed[0].heldout_before, listed[0].heldout_after
        else:
            before, after, _ = self._heldout(found[-1].law) if found else (None, None, "")
        return 0.0 if before is None or after is None else after / before

    @property
    def _may_be_a_formula(self) -> bool:
        """Whether effects explain everything, so that a formula is the only other explanation."""
        explained = bool(self.search.found) and (not self.search.last.leaves_misfit or self.search.is_beaten)
        return (
            explained
            and self._before_formulas.verdict not in NOTHING_TO_EXPLAIN
            and self.search.start.problem.simulates
        )

    def _judge_formulas(self, found: Diagnosis, formulas: dict[str, Any]) -> Diagnosis:
        """Return the verdict after comparing the effects found with formulas that may describe the cause as well."""
        if found.verdict == "unexplained" and not formulas["decisive"]:
            return found
        if formulas["decisive"]:
            return replace(found, verdict="unexplained", missing=[], leads=[], unexplained=formulas)
        doubtful = formulas["rival"] is not None and found.verdict == "missing"
        return replace(found, verdict="ambiguous" if doubtful else found.verdict, unexplained=formulas)

    @cached_property
    def _compared(self) -> UnexplainedForce | None:
        """Formulas that explain as much as the effects found; None if there are none."""
        if not self._may_be_a_formula:
            return None
        start, rng = self.search.start, self.search.generators[1]

        def repeats() -> Repeatability:
            pattern = self._pattern if not self.search.last.leaves_misfit else find_failure_pattern(start, rng)
            return pattern.repeats

        return compare_with_formulas(self.search.formulas, self.search.last.solution, repeats)

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
        search, found = self.search, self._before_formulas
        if not search.start.problem.simulates:
            return []  # there is no motion that signals could be compared with
        known = KnownFindings()
        if search.found:
            known = KnownFindings(found.candidates[0].delta_bic, search.last.solution, [*found.missing, *found.leads])
        return assess_auxiliary_signals(search.start, self.fit.runs, search.generators[0], auxiliary, known)

    def _with_pattern(self, found: Diagnosis, evidence: list[Evidence]) -> Diagnosis:
        """Return the diagnosis with the failure pattern, the evidence and the force that no effect explains."""
        repeats, unexplained = self._pattern.repeats, found.unexplained
        if found.verdict == "unexplained" and unexplained is not None and not repeats.best:
            repeats = replace(repeats, words="")  # the formula says it
        if found.verdict == "unexplained" and unexplained is None:
            unexplained = unexplained_force(self.search.formulas, self.search.last.solution).summary
        figures = found.figures | self._pattern.figures | evidence_curves(evidence)
        return replace(found, evidence=evidence, repeats=repeats, unexplained=unexplained, figures=figures)

    def _plan_next(self, found: Diagnosis, notify: Callable[[str], None]) -> list[dict[str, Any]]:
        """Propose experiments where misfit is unexplained or candidates are indistinguishable."""
        first, last, effects = self.search.first, self.search.last, self.search.found
        if found.verdict == "unexplained":
            solution = last.solution if found.leads or not effects else first.solution
            return plan_for_unexplained(solution, notify, self.costs)
        best = [t.effect.title for t in effects[:1]]
        order = sorted(self.search.passing, key=lambda t: t.effect.title not in best)
        passing = [(t.effect.title, t.law, t.delta_bic) for t in order]
        rivals = effects[0].indistinguishable_from if best else ()
        compared = self._compared
        formula = compared.as_candidate() if compared is not None and compared.summary["rival"] else None
        if formula is not None and len(effects) == 1:  # a formula in place of several effects is no rival of one
            passing, rivals = [*passing, formula], (formula[0], *rivals)
        return plan_for_candidates(first.solution, passing, rivals, notify, self.costs)


def _limits(first: Examination) -> tuple[dict[str, dict[str, Any]], dict[str, dict[str, Array]]]:
    """Return the detection limit of every scanned effect, and its curve over all settings."""
    limits, curves = {}, {}
    for s in first.tests.scanned:
        limits[s.effect.title], curve = detection_limit(s, first.draws, first.tests.critical)
        if len(s.scans) == 1:
            curve["rise"] = s.scans[0].gains
        curves[s.effect.title] = curve
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
    return _describe_excluded(excluded) + observation_of(fit.solution.problem).remarks(fit)
